"""Start runs as a user does, in separate processes, and read the files that they write."""

import bisect
import json
import os
import struct
import subprocess
import sys
from pathlib import Path

import jax
from tensorboardX.proto.event_pb2 import Event

from experiments.config.compose import load_config
from experiments.storage.checkpoints import Checkpoints
from experiments.training.experiment import build_experiment

ROOT = Path(__file__).parents[2]
SMALL = ["num_envs=8", "rollout_length=16", "ppo.minibatch_size=64", "ppo.epochs=1"]
CAR = ["env=MountainCar", "num_envs=4", "rollout_length=32", "ppo.minibatch_size=64"]


def start(arguments, cwd, out=subprocess.PIPE):
    """Start `python -m experiments.run` in a directory."""
    command = [sys.executable, "-m", "experiments.run", *arguments]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.Popen(
        command, cwd=cwd, env=environment, text=True, stdout=out, stderr=subprocess.PIPE
    )


def run(arguments, cwd):
    """Run `experiments.run` to its end; return its exit status, stdout and stderr."""
    with start(arguments, cwd) as process:
        out, err = process.communicate(timeout=300)
    return process.returncode, out, err


def lines(path):
    """Return the lines of a run's metrics.jsonl."""
    return [json.loads(line) for line in (path / "metrics.jsonl").read_text().splitlines()]


def times(path):
    """Return the lines of a run's times.jsonl."""
    return [json.loads(line) for line in (path / "times.jsonl").read_text().splitlines()]


def tree_of(path, config=None):
    """Return the newest checkpoint of a run: its iteration, and its leaves as plain arrays."""
    config = config or load_config([f"resume={path}"])
    like = build_experiment(config, probe=True).run_shapes().train
    checkpoints = Checkpoints(path)
    iteration, _, said = checkpoints.find(lambda manifest: None)
    assert not said
    state = checkpoints.load(iteration, like)
    return iteration, jax.tree.leaves(state._replace(key=jax.random.key_data(state.key)))


def events(path):
    """Return the events of the only TensorBoard file in a directory."""
    (file,) = path.iterdir()
    data, at, found = file.read_bytes(), 0, []
    while at < len(data):
        (length,) = struct.unpack_from("<Q", data, at)
        found.append(Event.FromString(data[at + 12 : at + 12 + length]))
        at += 12 + length + 4
    return found


def check_nothing_lost(path, iterations, seeds=1):
    """Check that every log has every iteration once, and that the logs agree with each other."""
    entries = lines(path)
    assert [(e["iteration"], e["seed"]) for e in entries] == [
        (i, s) for i in range(1, iterations + 1) for s in range(seeds)
    ]
    rows = [row.split(",") for row in (path / "episodes.csv").read_text().splitlines()[1:]]
    for seed in range(seeds):
        steps = [int(row[1]) for row in rows if int(row[0]) == seed]
        own = [e for e in entries if e["seed"] == seed]
        assert steps == sorted(steps)
        for entry in own:
            assert entry["episodes"] == bisect.bisect_right(steps, entry["step"])
            assert entry["transitions"] <= entry["step"]
        board = events(path / "tensorboard" / f"seed_{seed}")[2:]
        logged = [event for event in board if "entropy" in {v.tag for v in event.summary.value}]
        assert [event.step for event in logged] == [e["step"] for e in own]
    summary = json.loads((path / "summary.json").read_text())["seeds"]
    assert sum(seed["episodes"] for seed in summary) == len(rows)
