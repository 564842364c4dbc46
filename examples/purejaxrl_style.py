"""A bonus in ten lines of an agent that is not ours: PPO in one jitted, vmapped function.

python examples/purejaxrl_style.py            # a minute on two cores, with the library alone
python examples/purejaxrl_style.py maze.png   # with matplotlib: draws the curves too

The loop has PureJaxRL's form: environments that reset themselves within the step, `lax.scan` over
updates, `jax.vmap` over seeds. The lines that a bonus adds or changes end with `# +`. The task is a
maze of four corridors, of which the end of the last is rewarded. PPO alone is the bonus times 0.
"""

import os

os.environ.setdefault("XLA_FLAGS", "--xla_cpu_enable_concurrency_optimized_scheduler=false")
import sys
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax

import sndjax  # +

LIMIT, SEEDS = 100, 5
ENVS, STEPS, UPDATES, EPOCHS, MINIBATCHES = 16, 100, 200, 4, 8
GAMMA, LAMBDA, CLIP, ENTROPY, RATE = 0.99, 0.95, 0.2, 0.02, 5e-4
METHODS = {"PPO": ("rnd", 0.0), "RND": ("rnd", 1.0), "SND-VIC": ("snd_vic", 1.0)}
MAZE = jnp.array([[cell == "#" for cell in row] for row in (
    "..........",
    "#########.",
    "..........",
    ".#########",
    "..........",
    "#########.",
    "..........",
)])  # fmt: skip
GOAL, MOVES = jnp.array([6, 0]), jnp.array([[-1, 0], [1, 0], [0, -1], [0, 1]])


class Maze(NamedTuple):
    """Where the agent is, and since how many steps."""

    at: jax.Array
    time: jax.Array


def look(maze):
    """Return the cell, one-hot."""
    return jax.nn.one_hot(maze.at[0] * MAZE.shape[1] + maze.at[1], MAZE.size)


def reset(key):
    """Start in the upper left corner."""
    maze = Maze(jnp.zeros(2, jnp.int32), jnp.int32(0))
    return look(maze), maze


def step(key, maze, action):
    """Move where no wall is, and reset in the same step, as gymnax does."""
    to = jnp.clip(maze.at + MOVES[action], 0, jnp.array(MAZE.shape) - 1)
    after = Maze(jnp.where(MAZE[to[0], to[1]], maze.at, to), maze.time + 1)
    found = (after.at == GOAL).all()
    done = found | (after.time == LIMIT)
    obs, fresh = reset(key)
    state = jax.tree.map(lambda new, old: jnp.where(done, new, old), fresh, after)
    info = {"final_observation": look(after)}
    return jnp.where(done, obs, look(after)), state, found.astype(jnp.float32), done, info


class ActorCritic(nn.Module):
    """The policy and its value."""

    @nn.compact
    def __call__(self, x):
        start = nn.initializers.he_normal()
        layer = lambda x, width: nn.tanh(nn.Dense(width, kernel_init=start)(x))
        logits = nn.Dense(4, kernel_init=nn.initializers.normal(0.01))(layer(layer(x, 64), 64))
        return logits, nn.Dense(1)(layer(layer(x, 64), 64))[..., 0]


class Row(NamedTuple):
    """A step of all environments."""

    obs: jax.Array
    action: jax.Array
    reward: jax.Array
    done: jax.Array
    value: jax.Array
    log_prob: jax.Array
    next_obs: jax.Array  # +


def loss(params, network, rows, advantage, target):
    """Return PPO's loss of a minibatch."""
    logits, value = network.apply(params, rows.obs)
    log_p = jax.nn.log_softmax(logits)
    ratio = jnp.exp(jnp.take_along_axis(log_p, rows.action[:, None], 1)[:, 0] - rows.log_prob)
    advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
    gain = jnp.minimum(ratio * advantage, jnp.clip(ratio, 1 - CLIP, 1 + CLIP) * advantage)
    entropy = -(jnp.exp(log_p) * log_p).sum(-1)
    return 0.5 * jnp.mean((value - target) ** 2) - gain.mean() - ENTROPY * entropy.mean()


def train(name, eta, seed):
    """Return the share of episodes that end at the goal, for every update."""
    network = ActorCritic()
    optimizer = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(RATE))
    key, key_net, key_env, key_bonus = jax.random.split(jax.random.key(seed), 4)
    obs, mazes = jax.vmap(reset)(jax.random.split(key_env, ENVS))
    params = network.init(key_net, obs)
    bonus = sndjax.bonus(name, num_actions=4, example=obs, preset="small", eta=eta)  # +
    curious = bonus.init(key_bonus, obs)  # +

    def act(carry, key):
        params, mazes, obs = carry
        key, key_env = jax.random.split(key)
        logits, value = network.apply(params, obs)
        action = jax.random.categorical(key, logits)
        log_prob = jnp.take_along_axis(jax.nn.log_softmax(logits), action[:, None], 1)[:, 0]
        keys = jax.random.split(key_env, ENVS)
        after, mazes, reward, done, info = jax.vmap(step)(keys, mazes, action)
        row = Row(obs, action, reward, done, value, log_prob, info["final_observation"])  # +
        return (params, mazes, after), row

    def update(carry, key):
        params, moments, curious, mazes, obs = carry  # +
        key_act, key_order = jax.random.split(key)
        (_, mazes, obs), rows = jax.lax.scan(
            act, (params, mazes, obs), jax.random.split(key_act, STEPS)
        )
        steps = (rows.obs, rows.action, rows.next_obs, rows.done)  # +
        intrinsic, curious, _ = bonus.step(curious, *steps)  # +
        reward = rows.reward + intrinsic  # +

        def back(carry, row):
            later, value_after = carry
            reward, value, done = row
            delta = reward + GAMMA * value_after * (1 - done) - value
            later = delta + GAMMA * LAMBDA * (1 - done) * later
            return (later, value), later

        last = network.apply(params, obs)[1]
        _, advantage = jax.lax.scan(
            back, (jnp.zeros(ENVS), last), (reward, rows.value, rows.done), reverse=True
        )
        flat = jax.tree.map(
            lambda x: x.reshape(-1, *x.shape[2:]), (rows, advantage, advantage + rows.value)
        )

        def learn(carry, index):
            params, moments = carry
            part = jax.tree.map(lambda x: x[index], flat)
            slope = jax.grad(loss)(params, network, *part)
            change, moments = optimizer.update(slope, moments)
            return (optax.apply_updates(params, change), moments), None

        orders = jax.vmap(lambda key: jax.random.permutation(key, STEPS * ENVS))(
            jax.random.split(key_order, EPOCHS)
        )
        (params, moments), _ = jax.lax.scan(
            learn, (params, moments), orders.reshape(EPOCHS * MINIBATCHES, -1)
        )
        found = rows.reward.sum() / jnp.maximum(rows.done.sum(), 1)
        return (params, moments, curious, mazes, obs), found  # +

    start = (params, optimizer.init(params), curious, mazes, obs)  # +
    return jax.lax.scan(update, start, jax.random.split(key, UPDATES))[1]


def draw(curves, path):
    """Draw the curve of every seed."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(curves), sharey=True, figsize=(8, 2.8), layout="constrained")
    steps = jnp.arange(1, UPDATES + 1) * STEPS * ENVS / 1000
    for axis, (name, curve) in zip(axes, curves.items(), strict=True):
        axis.plot(steps, curve.T, alpha=0.8)
        axis.set(title=name, xlabel="steps, thousands", ylim=(-0.05, 1.05))
    axes[0].set_ylabel("episodes that end at the goal")
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    curves = {}
    for name, (bonus, eta) in METHODS.items():
        print(f"{name:8} trains {SEEDS} seeds ...", end=" ", flush=True)
        curves[name] = jax.jit(jax.vmap(lambda seed, b=bonus, e=eta: train(b, e, seed)))(
            jnp.arange(SEEDS)
        )
        solved = int((curves[name][:, -1] > 0.5).sum())
        print(f"{solved} of {SEEDS} reach the goal: {curves[name][:, -1].round(2)}", flush=True)
    if sys.argv[1:]:
        draw(curves, sys.argv[1])
