"""What a run writes: logs, checkpoints, snapshots, trackers; and how far it was written."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

import sndjax

from ..config.saved import check_settings, run_settings
from ..config.schema import Config
from ..storage.checkpoints import CheckpointError, Checkpoints
from ..storage.episodes import Episode
from ..storage.run_directory import FollowerDirectory, RunDirectory
from ..storage.run_logs import LOGS, RunLogs, check_logs
from ..storage.trackers import Tracker
from ..system.errors import ConfigError
from ..system.process import rss_mb
from .placement import SingleDevice
from .rollouts import RolloutInfo
from .snapshots import SnapshotWriter

CHECKPOINT_SECONDS = 300  # a checkpoint at least this often
SNAPSHOT_SECONDS = 300  # between two snapshots for TensorBoard


class RunLogger:
    """The files of a run; of several hosts one writes for all.

    Attributes:
      done: iterations that are in the files.
      messages: lines to print once there is a display.
      say: prints a line.
    """

    def __init__(
        self,
        config: Config,
        directory: RunDirectory | FollowerDirectory,
        placement: SingleDevice,
    ):
        """Find the checkpoint to resume from, if the run was begun before.

        Raises:
          ConfigError: no checkpoint can be used, or there are logs without any.
        """
        self.config, self.placement = config, placement
        self.path, self.shared = directory.path, directory.shared
        self.checkpoints = Checkpoints(self.shared, placement.is_leader)
        self.done = 0
        self.manifest: dict[str, Any] = {}  # of the checkpoint that the run resumes from
        self.messages: list[str] = []
        self.say: Callable[[str], None] = self.messages.append
        self.found = self.find_checkpoint() if directory.resumed else None
        placement.assert_equal_on_hosts(self.done, "find the run at another iteration")
        self.last_save, self.last_snapshot = time.monotonic(), -float("inf")

    def find_checkpoint(self) -> int | None:
        """Return the iteration to resume from; None if the run has no checkpoint yet."""
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

    def load(self, like: Any) -> Any:
        """Return the states of the checkpoint that the run resumes from; None for a new run."""
        if self.found is None:
            return None
        try:
            return self.placement.put_states(self.checkpoints.load(self.found, like))
        except CheckpointError as error:
            raise self.no_checkpoint_error(error) from None

    def open_tracker(self) -> None:
        """Open the tracker; it may raise ConfigError."""
        self.tracker = Tracker(self.config, self.path, self.placement.is_leader)

    def open_logs(self, agent: sndjax.AgentSpec, rooms: bool) -> None:
        """Open the logs, and cut off what is beyond the checkpoint.

        Args:
          agent: whose novelty the snapshots show.
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
          info: the rollout, for its count of transitions.
          metrics: of the update, a value for every seed.
          ended: the episodes that ended, a list for every seed.
          times: seconds and rates, the same for every seed.
        """
        self.done += 1
        logs, config = self.logs, self.config
        step = self.done * config.rows
        valid = np.asarray(info.valid).sum((1, 2)).tolist()
        lines = []
        for i in range(config.num_seeds):
            logs.transitions[i] += valid[i]
            entry = {
                "iteration": self.done,
                "step": step,
                "transitions": logs.transitions[i],
                "frames": step * int(config.env.options.get("frame_skip", 1)),
                **{name: value[i] for name, value in metrics.items()},
                **times,
                "wall_seconds": logs.wall_seconds,
                "rss_mb": rss_mb(),
            }
            lines.append(logs.log_iteration(i, ended[i], entry))
        logs.flush()
        self.tracker.queue_lines(lines)
        return lines

    def checkpoint_due(self, late: bool) -> bool:
        """Return True if it is time for a checkpoint; on all hosts if it is on one."""
        late |= time.monotonic() - self.last_save > CHECKPOINT_SECONDS
        return self.done % self.config.checkpoint_every == 0 or self.placement.any_host(late)

    def save(self, state: sndjax.TrainState) -> None:
        """Start an asynchronous checkpoint write. The logs are fsynced first."""
        self.flush()
        if self.checkpoints.newest == self.done:
            return
        if self.done < self.config.iterations:  # a whole run is summarised once all is safe
            self.logs.summarize(self.done * self.config.rows)
        manifest = self.logs.manifest() | {"settings": run_settings(self.config)}
        self.checkpoints.save(self.done, self.placement.to_host(state), manifest)
        self.last_save = time.monotonic()

    def flush(self) -> None:
        """Wait for the pending checkpoint write, then send the tracker all metrics up to it."""
        self.checkpoints.wait()
        if trouble := self.tracker.send(self.checkpoints.newest):
            self.say(trouble)

    def load_newest(self, like: Any) -> Any:
        """Return the states of the newest checkpoint."""
        assert self.checkpoints.newest is not None
        return self.placement.put_states(self.checkpoints.load(self.checkpoints.newest, like))

    def write_snapshot(
        self, state: sndjax.TrainState, batch: sndjax.Experience, int_reward: np.ndarray
    ) -> None:
        """Write a snapshot for TensorBoard if the last is old; no run ends because of one.

        Args:
          state: of all seeds.
          batch: the last rollout of all seeds.
          int_reward: its intrinsic rewards, [S, T, N].
        """
        now = time.monotonic()
        if now - self.last_snapshot < SNAPSHOT_SECONDS or self.placement.hosts > 1:
            return
        seeds, writer = self.config.seeds, self.logs.tensorboard
        try:
            self.snapshots.write(writer, seeds, state, batch, int_reward)
            self.last_snapshot = now
        except OSError:
            raise  # the disk: the logs are next
        except Exception as error:  # a module of the user's own may raise anything
            self.last_snapshot = float("inf")
            self.say(f"TensorBoard gets no more snapshots: {error!r}")

    def close(self, finished: bool) -> None:
        """Close the files."""
        self.checkpoints.join()
        self.tracker.close(finished)
        self.logs.close()
