"""Policy and module trained on two devices at once against one after the other."""

import os
import subprocess
import sys

from helpers.processes import ROOT

SCRIPT = """
import jax, numpy as np
from jax.sharding import Mesh, PartitionSpec
from helpers.agents import batch_for, equal, made
from helpers.rollouts import KINDS
import sndjax

jax.config.update("jax_num_cpu_devices", 2)
kind = KINDS[2]
for name in ("snd_vic", "snd_byol"):
    agent, state, alone = made(name, kind)
    mesh = Mesh(np.array(jax.devices()), ("two",))
    step = sndjax.make_train_step(agent, beside="two")
    spec = PartitionSpec()
    both = jax.jit(jax.shard_map(step, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False))
    other = state
    for seed in range(2):
        batch = batch_for(kind, seed)
        state, metrics, reward = alone(state, batch)
        other, found, rewards = both(other, batch)
    equal(other, state, rtol=1e-4, atol=1e-7)
    equal(rewards, reward, rtol=1e-4)
    equal(found, metrics, rtol=1e-4, atol=1e-7)
    print(name)
"""


def test_train_step_beside_equals_one_after_the_other():
    places = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT],
        env=os.environ | {"PYTHONPATH": places},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["snd_vic", "snd_byol"]
