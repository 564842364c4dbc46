"""Rollouts collected while the last one is learned from: whose they are, and what is left of them.

The oracle is a plain loop: collect, learn, and keep the policies of earlier iterations.
"""

import signal
import subprocess
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.agents import equal
from helpers.processes import lines, start

import sndjax
from experiments.config.compose import load_config
from experiments.run import main
from experiments.system.display import Progress
from experiments.system.interrupts import Interrupts
from experiments.training.experiment import build_experiment
from experiments.training.fused_iterations import make_iterations
from experiments.training.iterations import HostIterations, Watch
from experiments.training.learners import SlicedLearner, WholeLearner

SIZES = ["num_envs=4", "rollout_length=16", "ppo.minibatch_size=32", "ppo.epochs=2"]
SIZES += ["algo.minibatch_size=32", "num_seeds=2"]
STEPS = 64  # in an iteration
CART = ["env=gymnasium", "env.id=CartPole-v1", "algo=snd_vic", *SIZES]
TASKS = {
    "vectors": CART,
    "recurrent": [*CART, "network.memory=gru", "ppo.normalize_observations=true"],
    "jax": ["env=gymnax", "env.id=CartPole-v1", "algo=rnd", *SIZES],
    "baseline": ["env=gymnasium", "env.id=CartPole-v1", "algo=ppo", *SIZES[:4], "num_seeds=2"],
}


def run_iterations(arguments, count, learner=None):
    """Run iterations of a configuration, and return the last state and all results."""
    config = load_config([*arguments, f"total_steps={count * STEPS}"])
    experiment = build_experiment(config)
    collector, watch = experiment.make_collector(), Watch(Progress("", 1, 0), Interrupts(), 1)
    chosen = learner and learner(experiment)
    iterations = HostIterations(experiment, collector, watch, 0, chosen)
    state, results = experiment.init_run(), []
    for _ in range(count):
        state, found, _ = iterations.run(state, 1)
        results += found
    collector.close()
    watch.progress.close()
    return state, results


def loop(arguments, count, overlap):
    """Run the same by a plain loop, and return the state, the rewards and the rollouts' done."""
    experiment = build_experiment(load_config(arguments))
    collector = experiment.make_collector()
    step = jax.jit(experiment.make_train_step())
    train = experiment.init_states()
    first = sndjax.Actor(train.policy, train.observations, train.key)
    actors, rewards, dones = [], [], []
    for k in range(count):
        own = sndjax.Actor(train.policy, train.observations, train.key)
        # What would collect the rollout after the next one.
        actors.append(own._replace(key=jax.vmap(lambda key: jax.random.fold_in(key, 4))(own.key)))
        actor = own if not overlap else first if k == 0 else actors[k - 1]
        batch, info = collector.collect(actor)
        train, _, reward = step(train, batch)
        rewards.append(np.asarray(reward))
        dones.append(np.array(info.game_over))
    collector.close()
    return train, np.stack(rewards), np.stack(dones)


@pytest.mark.parametrize(
    ("task", "learner"),
    [
        ("vectors", WholeLearner),
        ("recurrent", SlicedLearner),
        pytest.param("baseline", SlicedLearner, marks=pytest.mark.exhaustive),
        pytest.param("recurrent", WholeLearner, marks=pytest.mark.exhaustive),
        pytest.param("vectors", SlicedLearner, marks=pytest.mark.exhaustive),
    ],
)
def test_HostIterations_overlap_learns_what_a_loop_one_policy_behind_learns(task, learner):
    arguments = [*TASKS[task], "overlap=1"]
    state, results = run_iterations(arguments, 5, learner)
    train, rewards, dones = loop(arguments, 5, overlap=True)
    equal(state.train, train, rtol=0)
    np.testing.assert_array_equal([r.int_reward for r in results], rewards)
    np.testing.assert_array_equal([r.info.game_over for r in results], dones)
    assert [r.metrics["policy_lag"] for r in results] == [[0, 0], *4 * [[1, 1]]]
    plain, _, _ = loop(TASKS[task], 5, overlap=False)
    with pytest.raises(AssertionError):  # the policies of an iteration ago do other things
        equal(plain.policy, train.policy, rtol=0)


def test_HostIterations_module_beside_the_next_rollout_equals_one_after_the_other():
    started = []

    class Watched(SlicedLearner):
        def advance(self, share):
            before = self.taken
            super().advance(share)
            started.append((share, self.taken - before))

    state, results = run_iterations(CART, 4, Watched)
    train, rewards, dones = loop(CART, 4, overlap=False)
    equal(state.train, train, rtol=0)
    np.testing.assert_array_equal([r.int_reward for r in results], rewards)
    np.testing.assert_array_equal([r.info.game_over for r in results], dones)
    # Two steps of the module's optimizer in each rollout but the first, at different times.
    assert sum(steps for _, steps in started) == 2 * 3
    assert {share for share, steps in started if steps} == {0.25, 0.6875}
    assert all("policy_lag" not in r.metrics for r in results)


def test_HostIterations_overlap_collects_while_a_learner_is_slow_to_start():
    """XLA waits on the host for conditions on a GPU; here the start of a program sleeps."""
    times = {"began": [], "started": [], "collected": []}

    class Slow(WholeLearner):
        def begin(self, train, batch):
            times["began"].append(time.monotonic())
            time.sleep(1)
            super().begin(train, batch)
            times["started"].append(time.monotonic())

    collect = HostIterations.collect

    def watched(self, *arguments):
        found = collect(self, *arguments)
        times["collected"].append(time.monotonic())
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(HostIterations, "collect", watched)
        run_iterations([*CART, "overlap=1"], 3, Slow)
    for began, started, collected in zip(
        times["began"][1:-1], times["started"][1:-1], times["collected"][2:], strict=True
    ):
        assert began < collected < started


@pytest.mark.parametrize(("base", "options"), [(WholeLearner, ["overlap=1"]), (SlicedLearner, [])])
def test_HostIterations_error_of_the_learner_is_raised_and_not_what_follows_from_it(base, options):
    class Broken(base):
        def begin(self, train, batch):
            raise ValueError("the first")

    with pytest.raises(ValueError, match="the first"):
        run_iterations([*CART, *options], 2, Broken)


def test_make_iterations_overlap_learns_what_a_loop_one_policy_behind_learns():
    arguments = [*TASKS["jax"], "overlap=1"]
    experiment = build_experiment(load_config(arguments))
    program = jax.jit(make_iterations(experiment, 4))
    state, rows, _ = program(experiment.init_run(), jnp.int32(4))
    train, rewards, dones = loop(arguments, 4, overlap=True)
    equal(state.train, train, rtol=0)
    np.testing.assert_array_equal(rows.int_reward, rewards)
    np.testing.assert_array_equal(rows.done, dones)
    np.testing.assert_array_equal(rows.metrics["policy_lag"], [[0, 0], *3 * [[1, 1]]])


def test_run_overlap_resumed_acts_with_the_policy_that_would_have_acted(tmp_path):
    """Environments begin again, and the first rollout is still that of the older policy."""
    command, whole = [*CART, "overlap=1", "checkpoint_every=3"], tmp_path / "run"
    assert main([*command, f"total_steps={3 * STEPS}", f"run_dir={whole}"]) == 0
    assert main([f"resume={whole}", f"total_steps={5 * STEPS}"]) == 0
    lags = [line["policy_lag"] for line in lines(whole) if line["seed"] == 0]
    assert lags == [0, 1, 1, 1, 1]


def test_run_overlap_of_a_resumed_run_cannot_change(tmp_path, capsys):
    assert main([*CART, f"total_steps={STEPS}", f"run_dir={tmp_path / 'run'}"]) == 0
    arguments = [f"resume={tmp_path / 'run'}", "overlap=1", f"total_steps={2 * STEPS}"]
    assert main(arguments) == 2
    assert "the run has overlap=0, not 1" in capsys.readouterr().err


def test_run_overlap_in_several_processes_is_refused(capsys):
    assert main([*CART, "overlap=1", "distributed=true", "run_dir=nowhere"]) == 2
    assert "overlap=1 is for a run in one process" in capsys.readouterr().err


@pytest.mark.parametrize("overlap", [0, 1])
def test_run_environment_that_fails_loses_no_rollout_that_was_whole(overlap, tmp_path, capsys):
    failing = ["env=gymnasium", "env.id=helpers.failing_task:Failing-v0", "algo=rnd", *SIZES]
    path = tmp_path / "run"  # it fails in the third rollout of 16 steps
    assert main([*failing, f"overlap={overlap}", "total_steps=640", f"run_dir={path}"]) == 1
    assert "the simulator is gone" in capsys.readouterr().err
    assert [line["iteration"] for line in lines(path) if line["seed"] == 0] == [1, 2]
    assert sorted(int(p.name) for p in (path / "checkpoints").iterdir())[-1] == 2


def test_run_overlap_stopped_by_a_signal_keeps_the_rollout_it_learns_from(tmp_path):
    slow = ["env=gymnasium", "env.id=examples.slow_environment:Slow-v0", "algo=rnd", *SIZES]
    slow += ["env.options.seconds=0.01", f"total_steps={6 * STEPS}", "overlap=1"]
    path = tmp_path / "run"
    with start([*slow, f"run_dir={path}"], tmp_path, subprocess.DEVNULL) as process:
        while not (path / "metrics.jsonl").exists() or len(lines(path)) < 4:
            assert process.poll() is None, process.communicate()
        time.sleep(0.5)  # into the rollout, which takes 1.3 s
        seen = len(lines(path)) // 2
        process.send_signal(signal.SIGTERM)
        _, err = process.communicate(timeout=60)
    assert process.returncode == 143, err
    done = len(lines(path)) // 2
    assert done > seen  # the rollout it learned from when the signal came is not lost
    assert sorted(int(p.name) for p in (path / "checkpoints").iterdir())[-1] == done
    with start([f"resume={path}", slow[1]], tmp_path, subprocess.DEVNULL) as process:
        _, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    assert [line["policy_lag"] for line in lines(path)] == [0, 0, *10 * [1]]
