"""Read what was sent to the trackers from the stores of MLflow and Weights & Biases."""

import json
import os
import signal

import pytest
from helpers.processes import CAR, lines, run, start

from experiments.config.compose import load_config
from experiments.storage.run_directory import TRACKER_STATE
from experiments.storage.trackers import Tracker
from experiments.system.errors import ConfigError

MINE = [*CAR, "algo=snd_vic", "algo.minibatch_size=64", "tracker=mlflow", "group=swept"]


def stored(tmp_path):
    """Return status, parameters and the history of the entropy of each MLflow run, by name."""
    from mlflow import MlflowClient

    client = MlflowClient(tracking_uri=(tmp_path / "mlruns").as_uri())
    experiment = client.get_experiment_by_name("swept")
    assert experiment is not None
    found = {}
    for one in client.search_runs([experiment.experiment_id]):
        history = client.get_metric_history(one.info.run_id, "entropy")
        steps = sorted((metric.step, metric.value) for metric in history)
        found[one.info.run_name] = (one.info.status, one.data.params, steps)
    return found


@pytest.mark.survival
def test_trackers_mlflow_killed_run_has_every_line_once(tmp_path, monkeypatch):
    pytest.importorskip("mlflow")
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    path = tmp_path / "run"
    more = ["num_seeds=2", "total_steps=4000", "checkpoint_every=3", f"run_dir={path}"]
    with start([*MINE, *more], tmp_path) as process:
        for line in process.stdout:
            if line.startswith("step 1,5"):
                break
        os.kill(process.pid, signal.SIGKILL)
    status, _, err = run([*MINE, *more, "resume=auto"], tmp_path)
    assert status == 0, err
    for seed in (0, 1):
        state, params, steps = stored(tmp_path)[f"MountainCar/snd_vic/{seed}"]
        assert state == "FINISHED"
        assert params["seed"] == str(seed)
        assert params["algo.name"] == "snd_vic"
        own = [(x["step"], x["entropy"]) for x in lines(path) if x["seed"] == seed]
        assert steps == own


def test_trackers_wandb_offline_has_one_run_per_seed(tmp_path, monkeypatch):
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_DIR", str(tmp_path))
    arguments = [*CAR, "algo=ppo", "tracker=wandb", "num_seeds=2", "total_steps=256"]
    status, _, err = run([*arguments, f"run_dir={tmp_path / 'run'}"], tmp_path)
    assert status == 0, err
    found = sorted(tmp_path.glob("wandb/offline-run-*/run-*.wandb"))
    assert len(found) == 2
    assert {path.stem[-1] for path in found} == {"0", "1"}
    told = json.loads((tmp_path / "run" / TRACKER_STATE).read_text())
    assert told["told"] == {"0": 2, "1": 2}


class Broken:
    def log(self, seed, lines):
        raise RuntimeError("it is down")

    def close(self, finished):
        raise RuntimeError("it is still down")


def test_trackers_failing_tracker_is_dropped_and_the_run_continues(tmp_path):
    config = load_config(["env=MountainCar", "algo=ppo"])
    tracker = Tracker(config, tmp_path)
    tracker.service = Broken()
    line = {"iteration": 1, "seed": 0, "step": 4, "entropy": 1.0}
    tracker.queue_lines([line])
    assert "it is down" in tracker.send(1)
    tracker.queue_lines([line])
    assert tracker.send(2) == ""
    tracker.close(finished=True)
    tracker.broken = False
    tracker.close(finished=True)


def test_trackers_reopened_before_the_first_line_is_the_same_run(tmp_path, monkeypatch):
    pytest.importorskip("mlflow")
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    monkeypatch.chdir(tmp_path)
    config = load_config(["env=MountainCar", "algo=ppo", "tracker=mlflow", "group=swept"])
    for _ in range(3):
        Tracker(config, tmp_path)
    from mlflow import MlflowClient

    client = MlflowClient(tracking_uri=(tmp_path / "mlruns").as_uri())
    assert len(client.search_runs([client.get_experiment_by_name("swept").experiment_id])) == 1


class Kept(list):
    def log(self, seed, lines):
        self.extend((seed, line["iteration"]) for line in lines)


def test_trackers_line_is_sent_after_its_checkpoint(tmp_path):
    tracker = Tracker(load_config(["env=MountainCar", "algo=ppo"]), tmp_path)
    tracker.service = kept = Kept()
    tracker.queue_lines([{"iteration": i, "seed": 0, "step": i} for i in (1, 2, 3)])
    tracker.send(None)
    assert kept == []
    tracker.send(2)
    assert kept == [(0, 1), (0, 2)]
    tracker.send(3)
    assert kept == [(0, 1), (0, 2), (0, 3)]


def test_trackers_not_installed_is_refused(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "wandb", None)
    with pytest.raises(ConfigError, match=r"pip install '\.\[wandb\]'"):
        Tracker(load_config(["env=MountainCar", "algo=ppo", "tracker=wandb"]), tmp_path)
