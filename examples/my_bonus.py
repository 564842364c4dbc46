"""A new objective in one file: find the next state among all in the batch (InfoNCE, cosine).

python -m experiments.run env=MountainCar algo.module=examples/my_bonus.py:my_bonus
"""

import jax
import jax.numpy as jnp

import sndjax


def info_nce(temperature: float = 0.1) -> sndjax.Objective:
    """Make InfoNCE: mean of -log softmax over valid candidates of cos(z_t, z_t+1) / temperature."""

    def init(key, features, num_actions):
        return {}  # no parameters except the encoder's

    def loss(params, encode, features, batch, rollout, key):
        unit = lambda z: z / jnp.sqrt(jnp.sum(z**2, axis=-1, keepdims=True) + 1e-12)
        logits = unit(features.z) @ unit(features.z_next).T / temperature
        logits = jnp.where(batch.valid[None, :], logits, -1e9)
        total = sndjax.masked_mean(-jnp.diagonal(jax.nn.log_softmax(logits)), batch.valid)
        return total, {"info_nce": total}

    return sndjax.Objective(init, loss)


def my_bonus(num_actions: int, size: sndjax.Architecture) -> sndjax.IntrinsicModule:
    """Make SND with this objective; `"noveld"` in place of `"distillation"` makes NovelD."""
    return sndjax.make_module(info_nce, "distillation", num_actions, size)
