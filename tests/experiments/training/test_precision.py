"""Check that `precision=` reaches every program of a run, and that runs learn with it."""

import jax
import pytest
from helpers.processes import lines

import sndjax
from experiments.config.compose import load_config
from experiments.run import main
from experiments.system.jax_settings import PRECISIONS, at_precision
from experiments.training.experiment import build_experiment
from experiments.training.recorder import first_memory, make_recorder
from sndjax.products import matmul

CART = ["env=gymnasium", "env.id=CartPole-v1", "algo=snd_vic", "num_envs=4", "rollout_length=16"]
CART += ["ppo.minibatch_size=32", "algo.minibatch_size=32"]


@pytest.mark.parametrize(("precision", "bits"), [("bf16", 7), ("tf32", 10), (None, None)])
def test_build_experiment_precision_is_that_of_acting_and_learning(precision, bits):
    config = load_config([*CART, *([f"precision={precision}"] if precision else [])])
    experiment = build_experiment(config)
    collector, train = experiment.make_collector(), experiment.init_states()
    actor = sndjax.Actor(train.policy, train.observations, train.key)
    batch, _ = collector.collect(actor)
    learned = str(jax.make_jaxpr(experiment.make_train_step())(train, batch))
    recorder, state = make_recorder(experiment.agent, config), collector.pool_states[0]
    memory = first_memory(experiment.agent, state.frame)
    opening = jax.tree.map(jax.numpy.asarray, (memory, state.frame, state.first))
    record, _ = recorder.open(*opening)
    acted = str(jax.make_jaxpr(recorder.act)(actor, record, *opening[1:], 0, 0))
    collector.close()
    for program in (learned, acted):
        assert ("reduce_precision" in program) == (bits is not None)
        assert bits is None or f"mantissa_bits={bits}" in program


def count_rounded(function, *arguments):
    """Return how many arrays a program rounds."""
    return str(jax.make_jaxpr(function)(*arguments)).count("reduce_precision[")


def test_at_precision_two_functions_traced_late_keep_their_own():
    ones = jax.numpy.ones((2, 2))
    square = lambda x: matmul(x, x)
    rough, plain, exact = (at_precision(name, square) for name in ("bf16", None, "float32"))
    assert [count_rounded(one, ones) for one in (plain, rough, plain)] == [0, 2, 0]
    with jax.default_matmul_precision("bfloat16"):  # as JAX_DEFAULT_MATMUL_PRECISION sets it
        assert [count_rounded(one, ones) for one in (plain, exact)] == [2, 0]
    assert set(PRECISIONS) == {"float32", "tf32", "bf16"}


@pytest.mark.exhaustive
@pytest.mark.parametrize("precision", ["bf16", "tf32"])
def test_run_mountaincar_at_fewer_bits_learns_the_task(precision, tmp_path):
    """Repeat most of seed 0 of the table in docs/overlap.md."""
    arguments = ["env=MountainCar", "algo=snd_vic", "algo.eta=10", f"precision={precision}"]
    path = tmp_path / "run"
    assert main([*arguments, "total_steps=720_896", f"run_dir={path}"]) == 0
    assert lines(path)[-1]["last100_ext_return"] > 0.5
