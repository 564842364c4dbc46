"""The files of a run: logs, checkpoints, snapshots, trackers; and where a run resumes."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

import sndjax

from ..config.run_settings import check_settings, run_settings
from ..config.schema import Config
from ..storage.array_trees import CheckpointError
from ..storage.checkpoints import Checkpoints
from ..storage.episodes import Episode
from ..storage.run_directory import FollowerDirectory, RunDirectory
from ..storage.run_logs import LOGS, RunLogs, check_logs
from ..storage.trackers import Tracker
from ..system.errors import ConfigError
from .placement import SingleDevice
from .rollouts import RolloutInfo
from .snapshots import SnapshotWriter

CHECKPOINT_SECONDS = 300  # the longest time between two checkpoints
SNAPSHOT_SECONDS = 300  # the shortest time between two snapshots for TensorBoard


class RunLogger:
    """The files of a run; if there are several hosts, the first one writes for all.

    Attributes:
      done: the number of iterations that are in the files.
      messages: lines to print as soon as there is a display.
      say: a function that prints a line.
    """

    def __init__(
        self,
        config: Config,
        directory: RunDirectory | FollowerDirectory,
        placement: SingleDevice,
    ):
        """Find the checkpoint to resume from, if the run was started before.

        Args:
          config: the configuration of the run.
          directory: the directory of the run.
          placement: the devices and hosts of the run.

        Raises:
          ConfigError: no checkpoint can be used, there are logs without a checkpoint, or the hosts
            find different checkpoints.
        """
        self.config, self.placement = config, placement
        self.path, self.shared = directory.path, directory.shared
        self.checkpoints = Checkpoints(self.shared, placement.is_leader)
        self.done = 0
        self.manifest: dict[str, Any] = {}  # of the checkpoint that the run resumes from
        self.messages: list[str] = []
        self.say: Callable[[str], None] = self.messages.append
        self.found = self.find_checkpoint() if directory.resumed else None
        placement.assert_equal_on_hosts(self.done, "resume from different iterations")
        self.last_save, self.last_snapshot = time.monotonic(), -float("inf")

    def find_checkpoint(self) -> int | None:
        """Return the iteration to resume from; None if the run has no checkpoint yet.

        Raises:
          ConfigError: no checkpoint can be used, or there are logs without a checkpoint.
        """
        try:
            found, self.manifest, messages = self.checkpoints.find(self.check_manifest)
        except CheckpointError as error:
            raise self.no_checkpoint_error(error) from None
        self.messages += messages
        log = self.shared / LOGS[0]
        if found is None and log.exists() and log.stat().st_size:
            raise self.no_checkpoint_error("there are logs and no checkpoint")
        self.done = found or 0
        return found

    def no_checkpoint_error(self, why: object) -> ConfigError:
        """Return the error that there is nothing to resume."""
        return ConfigError(f"resume={self.shared}: there is nothing to resume: {why}")

    def check_manifest(self, manifest: dict[str, Any]) -> None:
        """Raise ValueError unless a checkpoint belongs to this configuration and these logs."""
        check_settings(self.config, manifest["settings"])
        check_logs(self.shared, self.config.seeds, manifest["logs"])

    def open_tracker(self) -> None:
        """Open the tracker.

        Raises:
          ConfigError: the tracker is not installed, or cannot be opened.
        """
        self.tracker = Tracker(self.config, self.path, self.placement.is_leader)

    def open_logs(self, agent: sndjax.AgentSpec, rooms: bool) -> None:
        """Open the logs, and remove the lines after the checkpoint.

        Args:
          agent: the agent whose novelty the snapshots show.
          rooms: whether episodes count rooms.
        """
        self.placement.barrier("before the first line is written")
        marks = self.manifest.get("logs", {}) if self.placement.is_leader else {}
        self.snapshots = SnapshotWriter(agent)
        self.logs = RunLogs(self.path, self.config.seeds, rooms, marks)
        self.tracker.queue_lines(self.logs.read_back())

    def log(
        self,
        info: RolloutInfo,
        metrics: dict[str, list[float]],
        ended: list[list[Episode]],
        times: dict[str, Any],
    ) -> list[dict[str, Any]]:
        """Log one iteration, and return its lines, one for every seed.

        Args:
          info: the data of the rollout, for its number of transitions.
          metrics: the metrics of the update by name, a value for every seed.
          ended: the episodes that ended, a list for every seed.
          times: seconds and rates, the same for every seed.
        """
        self.done += 1
        logs, config = self.logs, self.config
        step = self.done * config.rows
        valid = np.asarray(info.valid).sum((1, 2)).tolist()
        clock = logs.log_times({"iteration": self.done} | times)
        lines = []
        for i in range(config.num_seeds):
            logs.transitions[i] += valid[i]
            entry = {
                "iteration": self.done,
                "step": step,
                "transitions": logs.transitions[i],
                "frames": step * int(config.env.options.get("frame_skip", 1)),
                **{name: value[i] for name, value in metrics.items()},
            }
            lines.append(logs.log_iteration(i, ended[i], entry, clock))
        logs.flush()
        self.tracker.queue_lines(lines)
        return lines

    def checkpoint_due(self, late: bool) -> bool:
        """Return True if a checkpoint is due on any host.

        Args:
          late: whether this host needs a checkpoint now, in any case.
        """
        late |= time.monotonic() - self.last_save > CHECKPOINT_SECONDS
        return self.done % self.config.checkpoint_every == 0 or self.placement.any_host(late)

    def save(self, state: sndjax.TrainState, beside: dict[str, Any]) -> None:
        """Start an asynchronous checkpoint write. The logs are fsynced first.

        Args:
          state: the states of all seeds.
          beside: further trees of arrays by name.

        Raises:
          OSError: the logs or the previous checkpoint could not be written.
        """
        self.flush()
        if self.checkpoints.newest == self.done:
            return
        if self.done < self.config.iterations:  # a finished run: after its last checkpoint
            self.logs.summarize(self.done * self.config.rows)
        manifest = self.logs.manifest() | {"settings": run_settings(self.config)}
        self.checkpoints.save(self.done, self.placement.to_host(state), manifest, beside)
        self.last_save = time.monotonic()

    def flush(self) -> None:
        """Wait for the pending checkpoint write, then send the tracker all metrics up to it.

        Raises:
          OSError: the checkpoint could not be written.
        """
        self.checkpoints.wait()
        if trouble := self.tracker.send(self.checkpoints.newest):
            self.say(trouble)

    def write_snapshot(
        self, state: sndjax.TrainState, batch: sndjax.Experience, int_reward: np.ndarray
    ) -> None:
        """Write a snapshot for TensorBoard if the last one is older than `SNAPSHOT_SECONDS`.

        An error of the user's module does not end the run: it ends the snapshots.

        Args:
          state: the states of all seeds.
          batch: the last rollout of all seeds.
          int_reward: its intrinsic rewards, [S, T, N].

        Raises:
          OSError: the disk cannot be written.
        """
        now = time.monotonic()
        if now - self.last_snapshot < SNAPSHOT_SECONDS or self.placement.hosts > 1:
            return
        seeds, writer = self.config.seeds, self.logs.tensorboard
        try:
            self.snapshots.write(writer, seeds, state, batch, int_reward)
            self.last_snapshot = now
        except OSError:
            raise  # the disk: the next write to the logs would fail too
        except Exception as error:  # the user's module may raise any exception
            self.last_snapshot = float("inf")
            self.say(f"TensorBoard gets no more snapshots: {error!r}")

    def close(self, finished: bool) -> None:
        """Close the files."""
        self.checkpoints.join()
        self.tracker.close(finished)
        self.logs.close()
