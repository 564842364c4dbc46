"""TensorBoard events: a view of metrics.jsonl, one file a seed, made anew when a run goes on."""

import shutil
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event, SessionLog
from tensorboardX.proto.summary_pb2 import Summary


class TensorBoardWriter:
    """One event file per seed. Written in this thread, so that a full disk is noticed."""

    def __init__(self, path: Path, seeds: list[int]):
        """Remove what an earlier process wrote; `add` brings its lines back."""
        shutil.rmtree(path, ignore_errors=True)
        self.writers = {}
        for seed in seeds:
            place = path / f"seed_{seed}"
            place.mkdir(parents=True)
            self.writers[seed] = EventsWriter(str(place / "events"))
            # A TensorBoard that is looking on forgets what it has read of the removed file.
            start = SessionLog(status=SessionLog.START)
            self.writers[seed].write_event(Event(step=0, wall_time=time.time(), session_log=start))

    def add(self, line: dict[str, Any], when: float) -> None:
        """A line of metrics.jsonl: every fractional figure is a scalar at `step`."""
        values = [
            Summary.Value(tag=key, simple_value=value)
            for key, value in line.items()
            if isinstance(value, float)
        ]
        event = Event(step=line["step"], wall_time=when, summary=Summary(value=values))
        self.writers[line["seed"]].write_event(event)

    def add_snapshot(
        self, seed: int, step: int, image: np.ndarray | None, figures: dict[str, float]
    ) -> None:
        """What is looked at now and then: an image, and figures that no log holds."""
        values = [Summary.Value(tag=key, simple_value=value) for key, value in figures.items()]
        if image is not None:
            height, width, colours = image.shape
            _, png = cv2.imencode(".png", image)
            shown = Summary.Image(
                height=height, width=width, colorspace=colours, encoded_image_string=png.tobytes()
            )
            values.append(Summary.Value(tag="most_novel", image=shown))
        if values:
            event = Event(step=step, wall_time=time.time(), summary=Summary(value=values))
            self.writers[seed].write_event(event)

    def flush(self) -> None:
        """Hand what was written to the system."""
        for writer in self.writers.values():
            writer.flush()

    def close(self) -> None:
        """Close the files."""
        for writer in self.writers.values():
            with suppress(OSError):  # of a full disk; `flush` has said it
                writer.close()
