"""TensorBoard events: a copy of metrics.jsonl, one file per seed, rewritten on resume."""

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
    """One event file per seed, written in this thread, so that a full disk is noticed."""

    def __init__(self, path: Path, seeds: list[int]):
        """Remove the files of an earlier process and open new ones; `add` restores the lines."""
        shutil.rmtree(path, ignore_errors=True)
        self.writers = {}
        for seed in seeds:
            place = path / f"seed_{seed}"
            place.mkdir(parents=True)
            self.writers[seed] = EventsWriter(str(place / "events"))
            # A running TensorBoard then forgets what it has read from the removed file.
            start = SessionLog(status=SessionLog.START)
            self.writers[seed].write_event(Event(step=0, wall_time=time.time(), session_log=start))

    def add(self, line: dict[str, Any], when: float) -> None:
        """Add a line of metrics.jsonl: floats are scalars at `step`, with the time `when`."""
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
        """Add an image, and metrics that no log holds.

        Args:
          seed: the seed of the agent.
          step: the step at which they are shown.
          image: the most novel frame, uint8 [H, W, C], or None.
          figures: the metrics by name.
        """
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
        """Flush all event files to the system."""
        for writer in self.writers.values():
            writer.flush()

    def close(self) -> None:
        """Close the files."""
        for writer in self.writers.values():
            with suppress(OSError):  # the disk is full; `flush` has already raised this error
                writer.close()
