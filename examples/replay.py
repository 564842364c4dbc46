"""A bonus in an off-policy agent: DQN with a replay buffer, on the maze of purejaxrl_style.py.

python examples/replay.py     # a minute on two cores, with the library alone

The reward of a batch is read when the batch is drawn, with the weights of that moment, by
`bonus.step_batch`. The lines that a bonus adds or changes end with `# +`.
"""

import os

os.environ.setdefault("XLA_FLAGS", "--xla_cpu_enable_concurrency_optimized_scheduler=false")
import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from purejaxrl_style import GOAL, MAZE, SEEDS, reset, step

import sndjax  # +

ENVS, CAPACITY, BATCH, STEPS = 16, 4000, 128, 16_000
GAMMA, EPSILON, RATE, TARGET_EVERY = 0.98, 0.05, 3e-3, 50
METHODS = {"DQN": ("rnd", 0.0), "RND": ("rnd", 0.1)}


class Values(nn.Module):
    """The value of every action."""

    @nn.compact
    def __call__(self, x):
        return nn.Dense(4)(nn.relu(nn.Dense(64)(nn.relu(nn.Dense(64)(x)))))


def train(name, eta, seed):
    """Return how often every cell of the maze was entered."""
    network, optimizer = Values(), optax.adam(RATE)
    key, key_net, key_env, key_bonus = jax.random.split(jax.random.key(seed), 4)
    obs, mazes = jax.vmap(reset)(jax.random.split(key_env, ENVS))
    params = network.init(key_net, obs)
    bonus = sndjax.bonus(name, num_actions=4, example=obs, preset="small")  # +
    curious = bonus.init(key_bonus, obs)  # +
    # The replay holds the cells of observations, which are one-hot.
    cell, number = jnp.zeros((CAPACITY, ENVS), jnp.int32), jnp.zeros((CAPACITY, ENVS))
    replay = (cell, cell, number, number, cell)

    def one(carry, time):
        params, target, moments, replay, curious, mazes, obs = carry  # +
        keys = jax.random.split(jax.random.fold_in(key, time), 4)
        greedy = network.apply(params, obs).argmax(-1)
        explores = jax.random.bernoulli(keys[0], EPSILON, (ENVS,))
        action = jnp.where(explores, jax.random.randint(keys[1], (ENVS,), 0, 4), greedy)
        after, mazes, reward, done, info = jax.vmap(step)(
            jax.random.split(keys[2], ENVS), mazes, action
        )
        row = (obs.argmax(-1), action, reward, done, info["final_observation"].argmax(-1))
        replay = jax.tree.map(lambda all, x: all.at[time % CAPACITY].set(x), replay, row)

        flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), replay)
        filled = jnp.minimum(time + 1, CAPACITY) * ENVS
        drawn = jax.random.randint(keys[3], (BATCH,), 0, filled)
        seen, acted, paid, ended, then = (x[drawn] for x in flat)
        seen, then = (jax.nn.one_hot(x, obs.shape[-1]) for x in (seen, then))
        intrinsic, curious, _ = bonus.step_batch(curious, seen, acted, then)  # +
        paid = paid + eta * jax.nn.standardize(intrinsic, epsilon=1e-12)  # +
        best = network.apply(params, then).argmax(-1, keepdims=True)  # double DQN
        later = jnp.take_along_axis(network.apply(target, then), best, -1)[:, 0]
        wanted = paid + GAMMA * (1 - ended) * later

        def loss(params):
            value = jnp.take_along_axis(network.apply(params, seen), acted[:, None], -1)[:, 0]
            return optax.huber_loss(value, wanted).mean()

        change, moments = optimizer.update(jax.grad(loss)(params), moments)
        params = optax.apply_updates(params, change)
        target = optax.periodic_update(params, target, time, TARGET_EVERY)
        seen_now = info["final_observation"].sum(0)
        return (params, target, moments, replay, curious, mazes, after), seen_now  # +

    start = (params, params, optimizer.init(params), replay, curious, mazes, obs)  # +
    return jax.lax.scan(one, start, jnp.arange(STEPS))[1].sum(0)


if __name__ == "__main__":
    for name, (bonus, eta) in METHODS.items():
        print(f"{name:8} trains {SEEDS} seeds ...", end=" ", flush=True)
        visits = jax.jit(jax.vmap(lambda seed, b=bonus, e=eta: train(b, e, seed)))(
            jnp.arange(SEEDS)
        )
        goal = visits[:, MAZE.shape[1] * GOAL[0] + GOAL[1]]
        print(f"cells entered, by seed: {(visits > 0).sum(1)} of {(~MAZE).sum()}", end="; ")
        print(f"goal reached {goal.astype(int)} times", flush=True)
