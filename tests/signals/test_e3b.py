import jax
import jax.numpy as jnp
import numpy as np
from helpers.rollouts import KINDS, rollout
from hypothesis import given, settings
from hypothesis import strategies as st

from sndjax import Features, Rollout, make_module
from sndjax import elliptical_bonus as eager_bonus
from sndjax.grid import OBJECTIVES, make_encoder_and_predictor
from sndjax.signals.e3b import e3b

elliptical_bonus = jax.jit(eager_bonus)
VECTOR = KINDS[2]


def in_numpy(covariance, z, made, ridge=0.1):
    """Compute the bonus in float64 from the covariance itself, solved at every step."""
    first, valid = np.asarray(made.first), np.asarray(made.valid)
    z, width = np.asarray(z, np.float64), z.shape[-1]
    bonus = np.zeros(valid.shape)
    for t in range(len(valid)):
        for n in range(valid.shape[1]):
            if not valid[t, n]:
                continue
            if first[t, n]:
                covariance[n] = ridge * np.eye(width) + np.outer(z[t, n], z[t, n])
            bonus[t, n] = z[t + 1, n] @ np.linalg.solve(covariance[n], z[t + 1, n])
            covariance[n] = covariance[n] + np.outer(z[t + 1, n], z[t + 1, n])
    return bonus


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_elliptical_bonus_two_rollouts_equals_ellipsoid_solved_at_each_step(seed):
    rng = np.random.default_rng(seed)
    covariance = np.tile(0.1 * np.eye(3), (4, 1, 1))
    ours = jnp.tile(jnp.eye(3)[None] / np.sqrt(0.1), (4, 1, 1))
    for _ in range(2):
        made = rollout(VECTOR, rng)
        z = rng.normal(size=(9, 4, 3)).astype(np.float32)
        wanted = in_numpy(covariance, z, made)
        bonus, ours = elliptical_bonus(ours, jnp.asarray(z), made)
        valid = np.asarray(made.valid)
        np.testing.assert_allclose(np.asarray(bonus)[valid], wanted[valid], rtol=2e-3, atol=1e-5)
    inverse = np.einsum("nij,nkj->nik", *2 * [np.asarray(ours, np.float64)])
    np.testing.assert_allclose(inverse, np.linalg.inv(covariance), rtol=1e-3, atol=1e-5)


def test_elliptical_bonus_state_met_k_times_is_one_over_k_plus_ridge():
    """Compare with the closed form for one direction: ||z||^2 / (ridge + k ||z||^2)."""
    made = rollout(VECTOR, np.random.default_rng(0))
    no = jnp.zeros((8, 4), bool)
    made = made._replace(first=no.at[0].set(True), done=no, valid=~no)
    z = jnp.tile(jnp.array([2.0, 0.0])[None, None], (9, 4, 1))
    bonus, _ = elliptical_bonus(jnp.tile(jnp.eye(2)[None], (4, 1, 1)), z, made)
    np.testing.assert_allclose(bonus[:, 0], [4 / (0.1 + 4 * k) for k in range(1, 9)], rtol=1e-4)


def test_elliptical_bonus_long_episode_of_wide_correlated_features_is_exact():
    """Compare 1,500 steps that drift through 4 of 128 dimensions, 125 a rollout, with float64."""
    rng, width, steps = np.random.default_rng(0), 128, 1500
    walk = np.zeros((steps + 1, 4))
    for t in range(steps):
        walk[t + 1] = 0.97 * walk[t] + rng.normal(size=4)
    z = walk @ rng.normal(size=(4, width)) + 5 * rng.normal(size=width)
    z += 0.2 * rng.normal(size=z.shape)
    z = (z / np.sqrt((z**2).mean())).astype(np.float32)[:, None]
    no = np.zeros((steps, 1), bool)
    made = Rollout(None, None, no.copy(), no, ~no)
    made.first[0] = True
    wanted = in_numpy(np.zeros((1, width, width)), z, made)
    ours, bonus = jnp.eye(width)[None], []
    for s in range(0, steps, 125):
        part = Rollout(None, None, *(jnp.asarray(x[s : s + 125]) for x in made[2:]))
        got, ours = elliptical_bonus(ours, jnp.asarray(z[s : s + 126]), part)
        bonus.append(got)
    np.testing.assert_allclose(np.concatenate(bonus), wanted, rtol=1e-3)


def test_elliptical_bonus_thirty_thousand_states_that_are_alike_stays_exact():
    """Vary features by 0.003 around a common mean: the covariance spans seven orders."""
    rng, width, steps = np.random.default_rng(0), 32, 30_000
    z = rng.normal(size=width) + 0.003 * rng.normal(size=(steps + 1, width))
    z = z.astype(np.float32)
    exact = z.astype(np.float64)
    covariance = 0.1 * np.eye(width) + np.outer(exact[0], exact[0])
    root, no = jnp.eye(width)[None], jnp.zeros((1000, 1), bool)
    worst = []
    for start in range(0, steps, 1000):
        rows = (no.at[0].set(start == 0), no, ~no)
        part = jnp.asarray(z[start : start + 1001])[:, None]
        got, root = elliptical_bonus(root, part, Rollout(None, None, *rows))
        inverse, wanted = np.linalg.inv(covariance), []
        for x in exact[start + 1 : start + 1001]:  # float64, inverted anew for every thousand
            across = inverse @ x
            wanted.append(x @ across)
            inverse -= np.outer(across, across) / (1 + wanted[-1])
            covariance += np.outer(x, x)
        worst.append(np.abs(np.asarray(got)[:, 0] / wanted - 1).max())
    assert max(worst) < 2e-3


def test_e3b_reward_is_bonus_over_its_std_and_wide_features_are_projected():
    made = rollout(VECTOR, np.random.default_rng(0))
    module = make_module("none", "e3b", VECTOR.actions, VECTOR.size)
    params, state = jax.jit(module.init)(jax.random.key(0), made.frames[0])
    assert state.signal.projection is None  # 16 features need no projection
    reward, _ = jax.jit(module.reward)(params, state, made, jax.random.key(1))
    encoder, _ = make_encoder_and_predictor(OBJECTIVES["none"], VECTOR.size, "elu", "asymmetric")
    z, _ = encoder.apply(state.encoder, made.frames.reshape(36, -1))
    valid = np.asarray(made.valid)
    z = np.asarray(z, np.float64).reshape(9, 4, 16)
    wanted = in_numpy(np.tile(0.1 * np.eye(16), (4, 1, 1)), z, made)[valid]
    np.testing.assert_allclose(np.asarray(reward)[valid], wanted / wanted.std(), rtol=5e-3)
    options = {"scale_features": True, "normalize": False}
    before = make_module("none", "e3b", VECTOR.actions, VECTOR.size, signal_options=options)
    params, state = jax.jit(before.init)(jax.random.key(0), made.frames[0])
    reward, _ = jax.jit(before.reward)(params, state, made, jax.random.key(1))
    z = z / np.sqrt((z[:-1][valid] ** 2).mean())
    wanted = in_numpy(np.tile(0.1 * np.eye(16), (4, 1, 1)), z, made)[valid]
    np.testing.assert_allclose(np.asarray(reward)[valid], wanted, rtol=5e-3)
    wide = Features(jnp.zeros((1, 512)), None, None, None)
    _, state = e3b().init(jax.random.key(0), made.frames[0], wide, 3)
    assert state.projection.shape == (512, 128)
    assert state.root.shape == (4, 128, 128)
