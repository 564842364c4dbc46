import jax
import jax.numpy as jnp
import pytest
from helpers.rollouts import NO_ROLLOUT, no_encode

import sndjax
from experiments.benchmarks import analytic_flops as nominal
from experiments.training.flops import count_flops
from sndjax.grid import OBJECTIVES, make_encoder_and_predictor

# From the issue that asked for the benchmark: 10^9 operations per step, Atari frames.
PUBLISHED = {
    (None, "distillation"): 1.02,
    ("none", "distillation"): 1.19,
    ("inverse_dynamics", "prediction"): 1.61,
    ("st_dim", "prediction"): 1.67,
    ("vicreg", "distillation"): 1.83,
    ("st_dim", "distillation"): 1.89,
}
KINDS = {
    "atari": (sndjax.ATARI, (96, 96, 1), jnp.uint8, 4),
    "procgen": (sndjax.PROCGEN, (64, 64, 3), jnp.uint8, 2),
    "vector": (sndjax.VECTOR, (5,), jnp.float32, 1),
}


def counted(function, *arguments):
    """Operations of a program, which runs on shapes only."""
    return count_flops(jax.make_jaxpr(function)(*arguments).jaxpr)


@pytest.mark.parametrize(("objective", "signal"), PUBLISHED)
def test_flops_per_step_published_pairs_match_published_values(objective, signal):
    work = nominal.flops_per_step(objective, signal, sndjax.ATARI, (96, 96, 1), 4, 18)
    assert work / 1e9 == pytest.approx(PUBLISHED[objective, signal], abs=0.006)


@pytest.mark.parametrize("objective", OBJECTIVES)
@pytest.mark.parametrize("kind", KINDS)
def test_encoder_flops_any_encoder_equals_the_traced_program(objective, kind):
    size, shape, dtype, _ = KINDS[kind]
    frame = jnp.zeros((1, *shape), dtype)
    for network in make_encoder_and_predictor(OBJECTIVES[objective], size, "elu", "asymmetric"):
        params = jax.eval_shape(network.init, jax.random.key(0), frame)
        assert nominal.encoder_flops(network, shape) == counted(network.apply, params, frame)


@pytest.mark.parametrize("heads", [1, 2])
@pytest.mark.parametrize("kind", KINDS)
def test_policy_flops_any_policy_equals_the_traced_program(heads, kind):
    size, shape, dtype, stack = KINDS[kind]
    stacked = (*shape[:-1], shape[-1] * stack)
    network = sndjax.ActorCritic(size, 18, heads)
    params = jax.eval_shape(network.init, jax.random.key(0), jnp.zeros((1, *stacked), dtype))
    found = counted(network.apply, params, jnp.zeros((1, *stacked), dtype))
    assert nominal.policy_flops(size, stacked, 18, heads) == found


@pytest.mark.parametrize(
    "objective", ["st_dim", "vicreg", "barlow_twins", "inverse_dynamics", "vicreg_inverse"]
)
def test_objective_flops_five_objectives_equal_the_traced_program(objective):
    """Count the forward pass of the loss on the features of a minibatch."""
    rows, of = 24, jax.ShapeDtypeStruct
    z, local = of((rows, 512), jnp.float32), of((rows, 12, 12, 64), jnp.float32)
    features = sndjax.Features(z, z, local, local)
    made = OBJECTIVES[objective].objective()
    params = jax.eval_shape(lambda f: made.init(jax.random.key(0), f, 18), features)
    action, valid = of((rows,), jnp.int32), of((rows,), bool)

    def loss(params, features, action, valid):
        batch = sndjax.Transition(None, action, None, None, valid)
        return made.loss(params, no_encode, features, batch, NO_ROLLOUT, jax.random.key(1))

    found = counted(loss, params, features, action, valid) / rows
    assert nominal.objective_flops(objective, sndjax.ATARI, (96, 96, 1), 18, rows) == pytest.approx(
        found
    )


def test_flops_per_step_unknown_objective_or_signal_is_none():
    for cell in (("byol", "distillation"), ("vicreg", "e3b"), ("none", "prediction")):
        assert nominal.flops_per_step(*cell, sndjax.ATARI, (96, 96, 1), 4, 18) is None
