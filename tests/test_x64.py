"""With JAX_ENABLE_X64=1 everything stays float32, as the README says."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

CODE = """
import sys

import jax
import jax.numpy as jnp
import numpy as np
from helpers.rollouts import KINDS, experience

import sndjax
from sndjax.grid import OBJECTIVES, SIGNALS

assert jax.config.jax_enable_x64
jax.config.update("jax_disable_most_optimizations", True)  # it is compiled to run once
kind = next(k for k in KINDS if k.name == sys.argv[1])
cells = [(o, "distillation") for o in OBJECTIVES] + [("vicreg", s) for s in SIGNALS]
if kind.name != "vector":
    cells = [("st_dim", "noveld")]
wide = (jnp.float64, jnp.int64, jnp.uint64)
batch = experience(kind, np.random.default_rng(0))
double = lambda x: x.astype(jnp.float64) if x.dtype == jnp.float32 else x
batch = jax.tree.map(double, batch)  # as a caller's arrays are with x64, if nothing is done
frames, rows = batch.rollout.frames, sndjax.gather_transitions(batch.rollout, jnp.arange(16))


def check(cell, tree):
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        assert leaf.dtype not in wide, (*cell, jax.tree_util.keystr(path), leaf.dtype)


for objective, signal in cells:
    module = sndjax.make_module(objective, signal, kind.actions, kind.size, preprocess="mean")
    params, state = jax.jit(module.init)(jax.random.key(0), frames[0])
    read = jax.jit(module.reward)(params, state, batch.rollout, jax.random.key(1))
    loss = lambda p: module.loss(p, state, rows, batch.rollout, jax.random.key(2))
    graded = jax.eval_shape(jax.grad(loss, has_aux=True), params)
    check((objective, signal), (params, state, read, graded))
    print(objective, signal)
agent = sndjax.AgentSpec(
    network=sndjax.ActorCritic(kind.size, kind.actions, 2),
    ppo=sndjax.Hyperparameters(minibatch_size=16, epochs=1),
    intrinsic=sndjax.IntrinsicConfig(module, minibatch_size=16, reward_scale="running_std"),
    unbounded=(True,) * kind.shape[0] if kind.name == "vector" else (),
)
state = sndjax.init_train_state(agent, jax.random.key(0), frames[0])
after = jax.jit(sndjax.make_train_step(agent))(state, batch)
actor = sndjax.Actor(state.policy, state.observations, state.key)
acted, _ = sndjax.act(agent, actor, sndjax.ActorMemory(frames[:1]), frames[0], jnp.ones(4, bool), 0)
check(("train_step", "act"), (after, acted))
"""


@pytest.mark.parametrize("kind", ["vector", pytest.param("procgen", marks=pytest.mark.exhaustive)])
def test_train_step_with_x64_enabled_keeps_float32_in_every_cell(kind):
    tests = Path(__file__).parent
    path = os.pathsep.join([str(tests), str(tests.parent)])
    variables = os.environ | {"JAX_ENABLE_X64": "1", "PYTHONPATH": path, "JAX_PLATFORMS": "cpu"}
    line = [sys.executable, "-c", CODE, kind]
    done = subprocess.run(line, capture_output=True, text=True, env=variables, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert len(done.stdout.splitlines()) == (16 if kind == "vector" else 1)
