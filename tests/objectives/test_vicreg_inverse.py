import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.rollouts import NO_ROLLOUT, no_encode

from sndjax import (
    Features,
    Transition,
    byol,
    inverse_dynamics_loss,
    vicreg,
    vicreg_inverse,
    vicreg_loss,
    weighted_sum,
)
from sndjax.networks import MLP


def test_vicreg_inverse_loss_is_vicreg_plus_half_inverse_dynamics():
    """Compare with eq. 5.9, its two terms computed separately."""
    rng = np.random.default_rng(0)
    z, z_next = (jnp.asarray(rng.normal(size=(6, 8)).astype(np.float32)) for _ in range(2))
    features, valid = Features(z, z_next, None, None), jnp.arange(6) < 5
    action = jnp.array([0, 1, 2, 0, 1, 2])
    vinv = vicreg_inverse()
    params = vinv.init(jax.random.key(0), features, 3)
    batch = Transition(None, action, None, None, valid)
    got, metrics = vinv.loss(params, no_encode, features, batch, NO_ROLLOUT, jax.random.key(1))
    logits = MLP((8, 4, 3)).apply(params[1], jnp.concatenate([z, z_next], -1))
    wanted = vicreg_loss(z, z_next, valid)[0] + inverse_dynamics_loss(logits, action, valid)[0] / 2
    np.testing.assert_allclose(got, wanted, rtol=1e-5)
    assert {"vicreg_variance", "inverse_dynamics"} <= set(metrics)


def test_weighted_sum_part_with_ema_raises_value_error():
    with pytest.raises(ValueError, match="ema_decay"):
        weighted_sum((1, vicreg()), (1, byol()))
