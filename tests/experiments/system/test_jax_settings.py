"""Test that wrong environment variables of jax are refused in one line, by each kind of command."""

import os
import subprocess
import sys

import jax
import pytest
from helpers.processes import CAR, ROOT

from experiments.run import main

pytestmark = pytest.mark.skipif(
    jax.default_backend() != "cpu", reason="the platforms that are refused here may exist"
)
TRAIN = ["run", *CAR, "algo=ppo", "total_steps=128", "run_dir=run"]
EVALUATE = ["evaluate", "{run}", "episodes=1"]
BENCH = ["fixed_rollout", *CAR, "algo=rnd", "algo.minibatch_size=64"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    path = tmp_path_factory.mktemp("trained") / "run"
    assert main([*CAR, "algo=ppo", "total_steps=128", f"run_dir={path}"]) == 0
    return path


@pytest.mark.parametrize("arguments", [TRAIN, EVALUATE, BENCH], ids=lambda x: x[0])
@pytest.mark.parametrize(
    ("variable", "value"),
    [("JAX_PLATFORMS", "cuda"), ("JAX_PLATFORMS", "cqu"), ("JAX_DEFAULT_PRNG_IMPL", "threefly")],
)
def test_command_under_a_wrong_variable_is_one_line_and_status_2(
    arguments, variable, value, trained, tmp_path
):
    given = [argument.format(run=trained) for argument in arguments]
    process = subprocess.run(
        [sys.executable, "-m", "experiments.cli", *given],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT), variable: value},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert process.returncode == 2, process.stderr
    (line,) = process.stderr.splitlines()
    assert line.startswith(f"sndjax: {variable}={value}: ")
    assert f"unset {variable}" in line or "unset it" in line
    assert not any(tmp_path.iterdir())


def test_evaluate_other_error_keeps_its_traceback(monkeypatch):
    """An error that has nothing to do with jax's variables is not hidden."""
    from experiments.config.tool_options import exit_status

    monkeypatch.setenv("JAX_PLATFORMS", "cpu")

    def fail():
        raise RuntimeError("something else")

    with pytest.raises(RuntimeError, match="something else"):
        exit_status(fail)
