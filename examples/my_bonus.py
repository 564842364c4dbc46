"""A new objective in one file: the successor among the batch's others (InfoNCE, cosine).

python -m experiments.run env=MountainCar algo.module=examples/my_bonus.py:my_bonus
"""

import jax
import jax.numpy as jnp

import sndjax


def info_nce(temperature: float = 0.1) -> sndjax.Objective:
    """-log softmax over valid candidates of cos(z_t, z_t+1) / temperature, mean over rows."""

    def init(key, features, num_actions):
        return {}  # no parameters of its own

    def loss(params, encode, features, batch, rollout, key):
        unit = lambda z: z / jnp.sqrt(jnp.sum(z**2, axis=-1, keepdims=True) + 1e-12)
        logits = unit(features.z) @ unit(features.z_next).T / temperature
        logits = jnp.where(batch.valid[None, :], logits, -1e9)
        total = sndjax.masked_mean(-jnp.diagonal(jax.nn.log_softmax(logits)), batch.valid)
        return total, {"info_nce": total}

    return sndjax.Objective(init, loss)


def my_bonus(num_actions: int, size: sndjax.Architecture) -> sndjax.IntrinsicModule:
    """SND with it; `"noveld"` instead of `"distillation"` would be NovelD with it."""
    return sndjax.make_module_from_recipe(
        sndjax.ObjectiveRecipe(info_nce), "distillation", num_actions, size
    )
