"""Weights & Biases and MLflow: copies of metrics.jsonl, on this machine by default.

An iteration is sent to a tracker once, after its checkpoint is on the disk. Lines that are cut off
the logs when a run is resumed were therefore never sent.
"""

import hashlib
import json
import os
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

from ..config.run_settings import run_settings
from ..config.schema import Config
from ..system.errors import ConfigError
from ..system.files import write_atomically
from .run_directory import TRACKER_STATE

COUNTERS = ("seed", "step", "iteration")
Lines = list[dict[str, Any]]


class Tracker:
    """One run of the tracker per seed, opened again by its id when a run is resumed."""

    def __init__(self, config: Config, path: Path, leads: bool = True):
        """Open the tracker on the leading host.

        Args:
          config: the configuration of the run.
          path: the run directory.
          leads: whether this host leads; other hosts send nothing.

        Raises:
          ConfigError: the package is not installed, or the tracker cannot be opened.
        """
        self.config, self.path = config, path
        try:
            before = json.loads((path / TRACKER_STATE).read_text())
        except (OSError, ValueError):
            before = {}
        mine = before.get("tracker") == config.tracker
        self.ids: dict[str, str] = before.get("ids", {}) if mine else {}
        past = before.get("told", {}) if mine else {}
        self.sent = {seed: int(past.get(str(seed), 0)) for seed in config.seeds}
        self.lines: Lines = []
        self.broken = False
        kinds: dict[str, Callable[[], Any]] = {
            "none": lambda: None,
            "mlflow": lambda: MLflow(config, self.ids),
            "wandb": lambda: WandB(config, path, self.ids),
        }
        try:
            self.service = kinds[config.tracker if leads else "none"]()
        except ImportError:
            hint = f"pip install '.[{config.tracker}]'"
            raise ConfigError(f"tracker={config.tracker} is not installed: {hint}") from None
        except Exception as error:  # a service may raise any exception
            raise ConfigError(f"tracker={config.tracker}: {error}") from None
        if self.service is not None:
            self.save_state()

    def save_state(self) -> None:
        """Write to the disk which lines were sent, and the ids of the tracker's runs."""
        entry = {"tracker": self.config.tracker, "told": self.sent, "ids": self.ids}
        write_atomically(self.path / TRACKER_STATE, json.dumps(entry) + "\n")

    def queue_lines(self, lines: Iterable[dict[str, Any]]) -> None:
        """Keep lines of metrics.jsonl until they are sent."""
        if self.service is not None and not self.broken:
            self.lines += [line for line in lines if line["iteration"] > self.sent[line["seed"]]]

    def send(self, iteration: int | None) -> str:
        """Send the lines up to an iteration whose checkpoint is on the disk.

        Returns:
          The reason why the tracker gets no more lines, or "".
        """
        ready = [line for line in self.lines if line["iteration"] <= (iteration or 0)]
        for seed in self.config.seeds:
            own = [line for line in ready if line["seed"] == seed]
            if not own:
                continue
            try:
                self.service.log(seed, own)
            except Exception as error:  # an error of the tracker must not end the run
                self.broken, self.lines = True, []
                return f"tracker={self.config.tracker} is no longer sent metrics: {error}"
            self.sent[seed] = own[-1]["iteration"]
            self.save_state()
        self.lines = self.lines[len(ready) :]
        return ""

    def close(self, finished: bool) -> None:
        """End the tracker's runs; errors on close are ignored."""
        if self.service is not None and not self.broken:
            with suppress(Exception):
                self.service.close(finished)


def numeric_metrics(line: dict[str, Any]) -> dict[str, float]:
    """Return the numeric metrics of a log line.

    >>> numeric_metrics({"seed": 0, "step": 8, "iteration": 1, "score": None, "entropy": 0.5})
    {'entropy': 0.5}
    """
    return {k: v for k, v in line.items() if k not in COUNTERS and v is not None}


def run_title(config: Config, seed: int) -> str:
    """Return the name of a seed's run."""
    return f"{config.env.name}/{config.algo.name}/{seed}"


def experiment_name(config: Config) -> str:
    """Return the name of the experiment or group that the runs belong to."""
    return Path(config.group).name if config.group else "sndjax"


class MLflow:
    """The MLflow service, which stores runs in ./mlruns or at MLFLOW_TRACKING_URI."""

    def __init__(self, config: Config, ids: dict[str, str]):
        """Open a run for every seed, and store new run ids in `ids`.

        Raises:
          ValueError: the experiment does not exist and could not be created.
        """
        os.environ.setdefault("MLFLOW_ALLOW_FILE_STORE", "true")
        from mlflow import MlflowClient
        from mlflow.entities import Metric, Param
        from mlflow.exceptions import MlflowException

        self.metric, self.ids = Metric, ids
        place = os.environ.get("MLFLOW_TRACKING_URI", Path("mlruns").resolve().as_uri())
        self.client = client = MlflowClient(tracking_uri=place)
        with suppress(MlflowException):  # it exists, or another job has just created it
            client.create_experiment(experiment_name(config))
        found = client.get_experiment_by_name(experiment_name(config))
        if found is None:
            raise ValueError(f"no experiment {experiment_name(config)} at {place}")
        params = [Param(k, str(v)) for k, v in run_settings(config).items() if k != "seed"]
        for seed in config.seeds:
            if str(seed) in ids:
                self.client.update_run(ids[str(seed)], status="RUNNING")
                continue
            run = self.client.create_run(found.experiment_id, run_name=run_title(config, seed))
            ids[str(seed)] = run.info.run_id
            own = [*params, Param("seed", str(seed))]
            self.client.log_batch(run.info.run_id, params=own)

    def log(self, seed: int, lines: Lines) -> None:
        """Log the lines of a seed, in batches of 1000 metrics, which is MLflow's limit."""
        now = time.time_ns() // 10**6
        metrics = [
            self.metric(key, float(value), now, line["step"])
            for line in lines
            for key, value in numeric_metrics(line).items()
        ]
        for begin in range(0, len(metrics), 1000):
            self.client.log_batch(self.ids[str(seed)], metrics[begin : begin + 1000])

    def close(self, finished: bool) -> None:
        """End the runs."""
        for run in self.ids.values():
            self.client.set_terminated(run, "FINISHED" if finished else "KILLED")


class WandB:
    """The Weights & Biases service, in ./wandb, or online with WANDB_MODE=online and a login."""

    def __init__(self, config: Config, path: Path, ids: dict[str, str]):
        """Open a run for every seed, and store new run ids in `ids`.

        Args:
          config: the configuration of the run.
          path: the run directory, from which new ids are made.
          ids: the id of each seed's run, by seed; new ids are added.
        """
        import wandb

        digest = hashlib.sha1(str(path.resolve()).encode()).hexdigest()[:12]
        mode: Any = os.environ.get("WANDB_MODE", "offline")
        self.runs = {}
        for seed in config.seeds:
            own = ids.setdefault(str(seed), f"{digest}-{seed}")
            self.runs[seed] = wandb.init(
                project="sndjax",
                group=experiment_name(config),
                name=run_title(config, seed),
                id=own,
                resume="allow",
                mode=mode,
                config=run_settings(config) | {"seed": seed},
                reinit="create_new",
                settings=wandb.Settings(silent=True, console="off"),
            )

    def log(self, seed: int, lines: Lines) -> None:
        """Log the lines of a seed."""
        for line in lines:
            self.runs[seed].log(numeric_metrics(line), step=line["step"])

    def close(self, finished: bool) -> None:
        """End the runs."""
        for run in self.runs.values():
            run.finish(exit_code=0 if finished else 1)
