"""Test `on_nan` and `replay`: numbers in a run that are not finite, and where they come from."""

import re

import numpy as np
import pytest
from helpers.processes import CAR, lines, tree_of

from experiments.config.compose import load_config
from experiments.replay import main as replay
from experiments.run import main

BROKEN = """
import jax.numpy as jnp
import sndjax

def broken(num_actions, size):
    \"\"\"Random network distillation that goes wrong in its third iteration.\"\"\"
    module = sndjax.rnd(num_actions, size)

    def init(key, example):
        params, state = module.init(key, example)
        return params, (state, jnp.zeros(()))

    def reward(params, state, rollout, key):
        value, inner = module.reward(params, state[0], rollout, key)
        return value, (inner, state[1] + 1)

    def loss(params, state, batch, rollout, key):
        total, metrics = module.loss(params, state[0], batch, rollout, key)
        return jnp.where(state[1] == 3, jnp.log(-1.0 - total**2), total), metrics

    return sndjax.IntrinsicModule(init, reward, loss, lambda params, state: state)
"""


@pytest.fixture
def broken(tmp_path):
    code = tmp_path / "bonus.py"
    code.write_text(BROKEN)
    return f"algo.module={code}:broken"


def test_replay_number_not_finite_names_the_operation(broken, tmp_path, capfd):
    path = tmp_path / "run"
    command = [*CAR, broken, "algo.minibatch_size=64", "total_steps=1024", f"run_dir={path}"]
    assert main(command) == 1
    err = capfd.readouterr().err
    assert len(err.splitlines()) == 1
    assert "iteration 3, seed 0: module_loss is nan" in err
    assert "the last good checkpoint is that of iteration 2" in err
    assert [e["iteration"] for e in lines(path)] == [1, 2]
    assert tree_of(path, load_config(command))[0] == 2
    dump = path / "wrong-3"
    assert f"sndjax replay {dump}" in err
    assert replay([str(dump)]) == 2
    assert f"repeat {broken} on the command line, if you trust it" in capfd.readouterr().err
    assert replay([str(dump), broken]) == 0
    out = capfd.readouterr().out
    assert "after the update, seed 0: module_loss is nan" in out
    assert "not finite:" not in out  # the inputs are finite
    assert re.search(r"comes out of: .*nan.* in log.*bonus.py, line 19", out)
    file = max(dump.rglob("*"), key=lambda p: p.stat().st_size)
    file.write_bytes(file.read_bytes()[:-1] + b"x")
    assert replay([str(dump), broken]) == 2
    assert "is damaged" in capfd.readouterr().err


@pytest.mark.parametrize(("mode", "nulls"), [("skip", 6), ("ignore", 1)])
def test_run_number_not_finite_can_be_skipped_or_ignored(mode, nulls, broken, tmp_path):
    path = tmp_path / "run"
    command = [*CAR, broken, "algo.minibatch_size=64", "total_steps=1024", f"run_dir={path}"]
    assert main([*command, f"on_nan={mode}"]) == 0
    entries = lines(path)
    assert [e["iteration"] for e in entries] == list(range(1, 9))
    assert sum(e["module_loss"] is None for e in entries) == nulls
    if mode == "skip":
        # The counter of the module is restored too, so every later iteration is the third again.
        assert [e["skipped"] for e in entries] == [0, 0] + [1] * 6
        assert all(np.isfinite(x).all() for x in tree_of(path, load_config(command))[1])


def test_run_number_not_finite_at_the_start_leaves_a_dump_without_code(tmp_path, capfd):
    path = tmp_path / "run"
    command = [*CAR, "algo=ppo", "ppo.value_weight=3e38", "total_steps=256", f"run_dir={path}"]
    assert main(command) == 1
    assert "iteration 1, seed 0: grad_norm is" in capfd.readouterr().err
    assert replay([str(path / "wrong-1")]) == 0
    assert "after the update, seed 0: grad_norm is" in capfd.readouterr().out


def test_replay_directory_without_dump_is_refused(tmp_path, capfd):
    for place in (tmp_path, tmp_path / "none"):
        assert replay([str(place)]) == 2
        assert "is no dump of a run" in capfd.readouterr().err
