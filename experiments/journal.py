"""What a run writes down: logs, checkpoints, pictures, trackers; and where it stands in them."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

import sndjax
from experiments.checkpoint import Checkpoints, Damaged
from experiments.collect import Track
from experiments.devices import OneDevice
from experiments.directory import Directory, Elsewhere
from experiments.glimpses import Glimpses
from experiments.options import Config, ConfigError
from experiments.process import rss_mb
from experiments.records import LOGS, Records, check_logs
from experiments.stored import check_settings, settings
from experiments.trackers import Tracker

CHECKPOINT_SECONDS = 300  # a checkpoint at least this often
LOOK_SECONDS = 300  # between two looks at the features


class Journal:
    """The files of a run. `done` iterations are in them; of several hosts one writes for all."""

    def __init__(self, config: Config, directory: Directory | Elsewhere, layout: OneDevice):
        """Find where the run stands, if it was begun.

        Raises:
          ConfigError: no checkpoint can be used, or there are logs without any.
        """
        self.config, self.layout = config, layout
        self.path, self.shared = directory.path, directory.shared
        self.checkpoints = Checkpoints(self.shared, layout.leads)
        self.done = 0  # iterations
        self.manifest: dict[str, Any] = {}  # of the checkpoint that the run goes on from
        self.said: list[str] = []  # before there was a display
        self.say: Callable[[str], None] = self.said.append
        self.found = self.find() if directory.resumed else None
        layout.agree(self.done, "find the run at another iteration")
        self.saved, self.looked = time.monotonic(), -float("inf")

    def find(self) -> int | None:
        """The iteration to go on from, if the run had got so far as to have a first checkpoint."""
        try:
            found, self.manifest, said = self.checkpoints.find(self.check)
        except Damaged as error:
            raise self.nothing(error) from None
        self.said += said
        log = self.shared / LOGS[0]
        if found is None and log.exists() and log.stat().st_size:
            raise self.nothing("there are logs and no checkpoint")
        self.done = found or 0
        return found

    def nothing(self, why: object) -> ConfigError:
        """There is nothing to go on from."""
        return ConfigError(f"resume={self.shared}: nothing to go on from: {why}")

    def check(self, manifest: dict[str, Any]) -> None:
        """Raise ValueError unless a checkpoint belongs to this configuration and these logs."""
        check_settings(self.config, manifest["settings"])
        check_logs(self.shared, self.config.seeds, manifest["logs"])

    def load(self, like: Any) -> Any:
        """The states of the checkpoint that the run goes on from; None where it begins."""
        if self.found is None:
            return None
        try:
            return self.layout.states(self.checkpoints.load(self.found, like))
        except Damaged as error:
            raise self.nothing(error) from None

    def track(self) -> None:
        """Open the tracker, which may refuse."""
        self.tracker = Tracker(self.config, self.path, self.layout.leads)

    def open(self, agent: sndjax.Agent, rooms: bool) -> None:
        """Open the logs; what is beyond the checkpoint is cut off.

        Args:
          agent: whose novelty is looked at.
          rooms: whether episodes count rooms.
        """
        self.layout.meet("before the first line is written")
        marks = self.manifest.get("logs", {}) if self.layout.leads else {}
        self.glimpses = Glimpses(agent)
        self.records = Records(self.path, self.config.seeds, rooms, marks)
        self.tracker.take_in(self.records.past())

    def log(
        self,
        track: Track,
        metrics: dict[str, list[float]],
        ended: list[list[Any]],
        times: dict[str, Any],
    ) -> list[dict[str, Any]]:
        """One more iteration is done: a line for every seed."""
        self.done += 1
        records, config = self.records, self.config
        step = self.done * config.rows
        valid = np.asarray(track.valid).sum((1, 2)).tolist()
        lines = []
        for i in range(config.num_seeds):
            records.transitions[i] += valid[i]
            entry = {
                "iteration": self.done,
                "step": step,
                "transitions": records.transitions[i],
                "frames": step * int(config.env.options.get("frame_skip", 1)),
                **{name: value[i] for name, value in metrics.items()},
                **times,
                "wall_seconds": records.wall_seconds,
                "rss_mb": rss_mb(),
            }
            lines.append(records.take_in(i, ended[i], entry))
        records.flush()
        self.tracker.take_in(lines)
        return lines

    def due(self, late: bool) -> bool:
        """Whether it is time for a checkpoint; on all hosts if it is on one."""
        late |= time.monotonic() - self.saved > CHECKPOINT_SECONDS
        return self.done % self.config.checkpoint_every == 0 or self.layout.any(late)

    def save(self, state: sndjax.TrainState) -> None:
        """Begin to write a checkpoint; what it says of the logs is on the disk before it is."""
        self.settle()
        if self.checkpoints.newest == self.done:
            return
        if self.done < self.config.iterations:  # of a whole run it says so once all is safe
            self.records.summarize(self.done * self.config.rows)
        manifest = self.records.manifest() | {"settings": settings(self.config)}
        self.checkpoints.save(self.done, self.layout.whole(state), manifest)
        self.saved = time.monotonic()

    def settle(self) -> None:
        """Wait until the newest checkpoint is on the disk, and tell the tracker what it covers."""
        self.checkpoints.wait()
        if trouble := self.tracker.tell(self.checkpoints.newest):
            self.say(trouble)

    def standing(self, like: Any) -> Any:
        """The states of the newest checkpoint."""
        assert self.checkpoints.newest is not None
        return self.layout.states(self.checkpoints.load(self.checkpoints.newest, like))

    def look(
        self, state: sndjax.TrainState, batch: sndjax.Experience, int_reward: np.ndarray
    ) -> None:
        """Let TensorBoard have a look, now and then; no run ends over a picture."""
        now = time.monotonic()
        if now - self.looked < LOOK_SECONDS or self.layout.hosts > 1:
            return
        seeds, boards = self.config.seeds, self.records.boards
        try:
            self.glimpses.look(boards, seeds, state, batch, int_reward)
            self.looked = now
        except OSError:
            raise  # the disk: the logs are next
        except Exception as error:  # a module of the user's own may raise anything
            self.looked = float("inf")
            self.say(f"TensorBoard gets no more pictures: {error!r}")

    def close(self, finished: bool) -> None:
        """Close the files."""
        self.checkpoints.join()
        self.tracker.close(finished)
        self.records.close()
