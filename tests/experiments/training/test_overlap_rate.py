"""Measure, on two devices of a CPU, that collecting and learning do not wait for each other."""

import json
import os
import subprocess
import sys

import pytest
from helpers.processes import ROOT

SLOW = ["env=gymnasium", "env.id=examples.slow_environment:Slow-v0", "algo=snd_vic"]
SLOW += ["env.options.seconds=0.01", "network=wide", "num_envs=4", "rollout_length=16"]
SLOW += ["ppo.minibatch_size=16", "algo.minibatch_size=16", "ppo.epochs=45"]


def measured(*arguments):
    """Return the figures of a benchmark in a process with two devices."""
    flags = "--xla_force_host_platform_device_count=2"
    command = [sys.executable, "-m", "experiments.bench", *SLOW, "--whole", *arguments]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "XLA_FLAGS": flags}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.exhaustive  # half a minute; tests/experiments/training/test_overlap.py is exact
def test_bench_overlap_of_an_environment_that_sleeps_has_the_rate_of_the_slower_part():
    tries = []
    for _ in range(5):  # other work on this machine may disturb one measurement
        found = measured("overlap=1")
        parts = [found[f"{part}_alone_seconds"] for part in ("collecting", "learning")]
        assert min(parts) > 0.25 * max(parts)  # in turn they would reach 0.8
        tries.append(found["of_the_slower"])
        if tries[-1] >= 0.9:
            break
    assert max(tries) >= 0.9, tries
