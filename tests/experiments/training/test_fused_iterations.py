"""Iterations in one program: equal to one step after another, however they are divided."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.agents import equal
from helpers.processes import ROOT, lines, run, start

import sndjax
from experiments.config.compose import load_config
from experiments.run import main
from experiments.training.experiment import RunState, build_experiment
from experiments.training.fused_iterations import make_iterations
from experiments.training.scan_collector import make_jax_collect

TASK = Path(__file__).parents[2] / "helpers" / "jax_task.py"
OWN = ["env=jax", f"env.id={TASK}:make", "num_envs=4", "rollout_length=16"]
OWN += ["ppo.minibatch_size=32", "ppo.epochs=2", "algo.minibatch_size=32"]
STEPS = 64  # in an iteration


def started(*arguments):
    """Return an experiment and its state at the start."""
    experiment = build_experiment(load_config([*OWN, *arguments]))
    return experiment, experiment.init_run()


@pytest.fixture(params=[False, True], ids=["plain", "optimized"])
def rounding(request):
    """Return the tolerances of comparing two programs, with XLA's optimizations and without.

    XLA fuses the same operations otherwise in another program, and some sums end in another bit.
    """
    jax.config.update("jax_disable_most_optimizations", not request.param)
    yield {"rtol": 1e-4, "atol": 1e-6} if request.param else {"rtol": 0, "atol": 0}
    jax.config.update("jax_disable_most_optimizations", True)


@pytest.mark.parametrize("seeds", [1, 2])
def test_make_iterations_fused_equals_collect_and_train_step(seeds, rounding):
    experiment, state = started("algo=snd_vic", f"num_seeds={seeds}")
    fused, rows, batch = jax.jit(make_iterations(experiment, 5))(state, jnp.int32(3))
    collect = jax.jit(
        jax.vmap(make_jax_collect(experiment.pool.environment, experiment.agent, experiment.config))
        if seeds > 1
        else experiment.make_collector().program
    )
    train_step = jax.jit(experiment.make_train_step())
    train, live, _ = state
    for i in range(3):
        actor = sndjax.Actor(train.policy, train.observations, train.key)
        wanted_batch, live, _ = collect(actor, live)
        train, metrics, int_reward = train_step(train, wanted_batch)
        np.testing.assert_allclose(rows.int_reward[i], int_reward, **rounding)
        np.testing.assert_array_equal(rows.reward[i], wanted_batch.reward)
        for name, value in metrics.items():
            np.testing.assert_allclose(rows.metrics[name][i], value, rtol=1e-4, atol=1e-6)
    equal(batch, wanted_batch, **rounding)
    equal(fused, RunState(train, live, ()), **rounding)


def test_make_iterations_two_calls_equal_one(rounding):
    experiment, state = started("algo=rnd")
    program = jax.jit(make_iterations(experiment, 5))
    whole, rows, _ = program(state, jnp.int32(5))
    first, some, _ = program(state, jnp.int32(2))
    second, others, _ = program(first, jnp.int32(3))
    equal(second, whole, rtol=0)
    for name in ("int_reward", "valid", "done", "score"):
        joined = np.concatenate([getattr(some, name)[:2], getattr(others, name)[:3]])
        np.testing.assert_array_equal(joined, getattr(rows, name))


def files(path):
    """Return the logs of a run that do not depend on the clock, as bytes."""
    return [(path / name).read_bytes() for name in ("metrics.jsonl", "episodes.csv")]


@pytest.mark.parametrize(
    "algo",
    [
        ["algo=snd_vic", "num_seeds=2"],
        # Episodic memory, running scales, stacks, random numbers in the loss.
        ["algo=grid", "algo.objective=contrastive", "algo.signal=ngu", "env.stack=3"],
        # A recurrent state within episodes, statistics of external rewards.
        ["algo=rnd", "network.memory=gru", "combine=sum", "ppo.normalize_rewards=true"],
        ["algo=snd_vic", "num_seeds=2", "overlap=1"],
    ],
    ids=["two_seeds", "episodic", "recurrent", "overlap"],
)
def test_run_resumed_from_a_checkpoint_has_the_bytes_of_one_that_was_not_stopped(algo, tmp_path):
    command = [*OWN, *algo, "checkpoint_every=5"]
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert main([*command, f"total_steps={20 * STEPS}", f"run_dir={whole}"]) == 0
    more = ["iterations_per_call=3", f"run_dir={parts}"]
    assert main([*command, *more, f"total_steps={10 * STEPS}"]) == 0
    own = f"env.id={TASK}:make"
    assert main([f"resume={parts}", own, f"total_steps={20 * STEPS}"]) == 0
    assert len(lines(whole)) == 20 * (2 if "num_seeds=2" in algo else 1)
    assert files(parts) == files(whole)


def kill_while_running(command, path, moment):
    """Start a run, and kill it some seconds after its log has grown."""
    size = lambda: (path / "metrics.jsonl").stat().st_size if path.exists() else 0
    with start(command, path.parent, subprocess.DEVNULL) as process:
        try:
            before = size() if (path / "metrics.jsonl").exists() else 0
            while not (path / "metrics.jsonl").exists() or size() == before:
                assert process.poll() is None, process.communicate()
                time.sleep(0.01)
            time.sleep(moment)
        finally:
            process.kill()
            process.communicate()


@pytest.mark.parametrize("kills", [2, pytest.param(50, marks=pytest.mark.survival)])
def test_run_killed_at_random_moments_has_the_bytes_of_one_that_was_not(kills, tmp_path):
    draw = np.random.default_rng(kills)
    path, whole = tmp_path / "run", tmp_path / "whole"
    command = [*OWN, "algo=snd_vic", "checkpoint_every=7", "iterations_per_call=3"]
    long = [*command, f"total_steps={10**8}", f"run_dir={path}", "resume=auto"]
    for _ in range(kills):
        kill_while_running(long, path, draw.uniform(0, 1.5))
    newest = max(int(p.name) for p in (path / "checkpoints").glob("[0-9]*"))
    # A signal lets it end in order; what was logged by then must be that of an untouched run.
    process = start(long, tmp_path, subprocess.DEVNULL)
    while len((path / "metrics.jsonl").read_bytes().splitlines()) < newest + 10:
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=60)
    done = len(lines(path))
    status, _, err = run([*command, f"total_steps={done * STEPS}", f"run_dir={whole}"], tmp_path)
    assert status == 0, err
    print(f"{kills} kills, {done} lines, the same bytes as without them")
    assert files(path) == files(whole)


def test_run_reward_that_is_not_finite_stops_with_a_dump_of_that_iteration(tmp_path, capfd):
    path = tmp_path / "run"
    # Episodes last at most 20 rows, and one that reaches time 19 is met within some iterations.
    wrong = ["env.options.wrong_at=19", "env.options.cells=12", "iterations_per_call=8"]
    assert main([*OWN, *wrong, "algo=rnd", f"total_steps={64 * STEPS}", f"run_dir={path}"]) == 1
    err = capfd.readouterr().err
    done = len(lines(path))
    assert f"iteration {done + 1}, seed 0: ext_reward is nan" in err
    assert f"the last good checkpoint is that of iteration {done}" in err
    assert (path / f"wrong-{done + 1}").is_dir()
    assert (path / "checkpoints" / str(done)).is_dir()
    command = [str(path / f"wrong-{done + 1}"), f"env.id={TASK}:make"]
    from experiments.replay import main as replay

    assert replay(command) == 0
    assert "ext_reward is nan" in capfd.readouterr().out


def metrics_of(path):
    return [json.loads(line) for line in (path / "metrics.jsonl").read_text().splitlines()]


def assert_close(mine, theirs):
    """Check that the lines of two runs are equal up to the order of summation."""
    assert len(mine) == len(theirs) > 0
    for a, b in zip(mine, theirs, strict=True):
        assert a.keys() == b.keys()
        for key, value in b.items():
            if isinstance(value, float):
                np.testing.assert_allclose(a[key], value, 1e-3, 1e-5, err_msg=key)
            else:
                assert a[key] == value, key


def run_with(path, environment, *arguments):
    command = [sys.executable, "-m", "experiments.run", *OWN, *arguments, f"run_dir={path}"]
    done = subprocess.run(
        [*command, f"total_steps={6 * STEPS}"],
        env=os.environ | {"PYTHONPATH": str(ROOT)} | environment,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("arguments", "environment"),
    [
        (["algo=snd_vic", "cores=2"], {}),  # policy and module side by side
        (["algo=snd_vic", "num_seeds=2", "cores=2"], {}),  # a seed on each
        (
            ["algo=snd_vic", "num_seeds=2"],
            {"XLA_FLAGS": "--xla_force_host_platform_device_count=4"},
        ),
        pytest.param(
            ["algo=snd_vic", "num_seeds=2", "network.memory=gru"],
            {"XLA_FLAGS": "--xla_force_host_platform_device_count=4"},
            marks=pytest.mark.exhaustive,
        ),
    ],
    ids=["side_by_side", "seeds", "mesh", "recurrent_mesh"],
)
def test_run_on_several_devices_equals_the_run_on_one(arguments, environment, tmp_path):
    run_with(tmp_path / "one", {}, *[x for x in arguments if "cores" not in x], "cores=1")
    run_with(tmp_path / "several", environment, *arguments)
    assert_close(metrics_of(tmp_path / "several"), metrics_of(tmp_path / "one"))


def test_run_bad_environment_is_refused_with_one_line(tmp_path):
    status, _, err = run(["env=gymnax", "env.id=DeepSee", "algo=ppo"], tmp_path)
    assert status == 2
    assert err.count("\n") == 1
    assert "Traceback" not in err


@pytest.mark.survival
def test_run_two_processes_train_together(tmp_path):
    with socket.socket() as free:
        free.bind(("localhost", 0))
        place = f"localhost:{free.getsockname()[1]}"
    own = {"JAX_COORDINATOR_ADDRESS": place, "JAX_NUM_PROCESSES": "2"}
    command = [*OWN, "algo=rnd", f"total_steps={6 * STEPS}", f"run_dir={tmp_path / 'both'}"]
    processes = [
        subprocess.Popen(
            [sys.executable, "-m", "experiments.run", *command, "distributed=true"],
            env=os.environ | {"PYTHONPATH": str(ROOT), "JAX_PROCESS_ID": str(k)} | own,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        for k in range(2)
    ]
    for process in processes:
        _, err = process.communicate(timeout=120)
        assert process.returncode == 0, err
    run_with(tmp_path / "one", {}, "algo=rnd", "cores=1")
    assert_close(metrics_of(tmp_path / "both"), metrics_of(tmp_path / "one"))
