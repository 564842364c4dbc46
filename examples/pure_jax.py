"""DeepSea, all seeds in one jitted function: PPO does not learn to find the treasure, bonuses do.

python examples/pure_jax.py     # less than a minute on two cores; draws pure_jax.png
"""

import os

os.environ.setdefault("XLA_FLAGS", "--xla_cpu_enable_concurrency_optimized_scheduler=false")
import jax, jax.numpy as jnp, matplotlib.pyplot as plt, sndjax  # noqa: E401, I001

SIZE, ENVS, STEPS, ITERATIONS, SEEDS = 14, 32, 60, 130, 5
LEFT_OR_RIGHT = jax.random.bernoulli(jax.random.key(0), shape=(SIZE, SIZE))  # what action 1 means
BONUSES = {"PPO": None, "RND": sndjax.rnd, "SND-VIC": sndjax.snd_vic}


def observe(at):
    """Return row and column as one number, one-hot."""
    return jax.nn.one_hot(at[0] * SIZE + at[1], SIZE * SIZE)


def reset(key):
    """Start in the upper left corner."""
    return jnp.zeros(2, jnp.int32), observe(jnp.zeros(2, jnp.int32))


def step(key, at, action):
    """Go a row down, to the left or, at a cost, to the right; the last cell on the right pays 1."""
    right = action == LEFT_OR_RIGHT[at[0], at[1]]
    reward = jnp.where(right, (at[1] == SIZE - 1) - 0.01 / SIZE, 0.0)
    at = jnp.stack([at[0] + 1, jnp.clip(at[1] + jnp.where(right, 1, -1), 0, SIZE - 1)])
    return at, observe(at), reward, at[0] == SIZE, jnp.zeros((), bool)


def train(bonus, seed):
    """Return the share of episodes with the treasure in every iteration of a seed."""
    env, heads = sndjax.JaxEnvironment(reset, step, num_actions=2), 2 if bonus else 1
    module = bonus and sndjax.IntrinsicConfig(
        bonus(2, sndjax.VECTOR), 1.0, "running_std", 3e-4, 128
    )
    hyper = sndjax.Hyperparameters(1e-3, minibatch_size=128, episodic_int=False)
    agent = sndjax.AgentSpec(sndjax.ActorCritic(sndjax.VECTOR, 2, heads), hyper, module)
    train_step = sndjax.make_train_step(agent)

    def iteration(carry, _):
        state, live = carry
        actor, key = sndjax.Actor(state.policy, state.observations, state.key), state.key
        batch, live = sndjax.collect(agent, env, actor, live, jax.random.fold_in(key, 2), STEPS)
        state, *_ = train_step(state, batch)
        return (state, live), (batch.reward > 0.5).sum() / batch.rollout.done.sum()

    live = sndjax.init_environments(env, jax.random.key(seed), ENVS)
    state = sndjax.init_train_state(agent, jax.random.key(seed), live.frame)
    return jax.lax.scan(iteration, (state, live), length=ITERATIONS)[1]


if __name__ == "__main__":
    figure, axes = plt.subplots(1, len(BONUSES), sharey=True, figsize=(8, 3), layout="constrained")
    for (name, bonus), axis in zip(BONUSES.items(), axes, strict=True):
        found = jax.jit(jax.vmap(lambda seed, b=bonus: train(b, seed)))(jnp.arange(SEEDS))
        print(f"{name:8} share of the last episodes with the treasure, by seed: {found[:, -1]}")
        axis.plot(ENVS * STEPS / 1000 * jnp.arange(1, ITERATIONS + 1), found.T, alpha=0.8)
        axis.set(title=name, xlabel="steps, thousands", ylim=(-0.05, 1.05))
    axes[0].set_ylabel("episodes with the treasure")
    figure.suptitle(f"DeepSea {SIZE}: a random walk finds it once in {2**SIZE:,} episodes")
    figure.savefig("pure_jax.png", dpi=100)
