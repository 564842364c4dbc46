"""`sndjax.snd_vic` in plain REINFORCE, in a corridor whose reward random actions never reach."""

import jax
import jax.numpy as jnp
import optax

import sndjax

LENGTH, STEPS, ENVS = 40, 64, 32  # cells; steps of an episode; corridors side by side
look = lambda at: jax.nn.one_hot(at, LENGTH)


def play(table, key):
    """Play an episode in every corridor; return the next cells, actions and rewards, [T, N]."""

    def step(at, key):
        action = jax.random.categorical(key, 10 * table[at])
        after = jnp.clip(at + 2 * action - 1, 0, LENGTH - 1)
        return after, (after, action, (after == LENGTH - 1).astype(jnp.float32))

    return jax.lax.scan(step, jnp.zeros(ENVS, jnp.int32), jax.random.split(key, STEPS))[1]


def train(eta, seed=0, iterations=150):
    """Return the share of corridors whose end is reached in the last episode."""
    module = sndjax.snd_vic(num_actions=2, size=sndjax.VECTOR)
    params, state = module.init(jax.random.key(seed), look(jnp.zeros(ENVS, jnp.int32)))
    agent, adam = {"table": jnp.zeros((LENGTH, 2)), "module": params}, optax.adam(3e-3)

    def loss(agent, state, at, action, rollout, advantage, key):
        log_p = jax.nn.log_softmax(10 * agent["table"])
        reinforce = -jnp.mean(log_p[at[:-1], action] * advantage)
        rows = sndjax.gather_transitions(rollout, jnp.arange(action.size))
        return reinforce + module.loss(agent["module"], state, rows, rollout, key)[0]

    @jax.jit
    def iteration(agent, state, optimizer, key):
        after, action, reward = play(agent["table"], key)
        at = jnp.concatenate([jnp.zeros_like(after[:1]), after])
        time = jnp.broadcast_to(jnp.arange(STEPS)[:, None], action.shape)
        rollout = sndjax.Rollout(look(at), action, time == 0, time == STEPS - 1, time >= 0)
        bonus, state = module.reward(agent["module"], state, rollout, key)
        total = reward + eta * bonus / (jnp.std(bonus) + 1e-8)
        returns = jax.lax.associative_scan(jnp.add, total, reverse=True)
        advantage = returns - returns.mean(1, keepdims=True)
        slope = jax.grad(loss)(agent, state, at, action, rollout, advantage, key)
        change, optimizer = adam.update(slope, optimizer)
        agent = optax.apply_updates(agent, change)
        return agent, module.update(agent["module"], state), optimizer, jnp.mean(reward.max(0))

    optimizer = adam.init(agent)
    for key in jax.random.split(jax.random.key(seed), iterations):
        agent, state, optimizer, reached = iteration(agent, state, optimizer, key)
    return float(reached)


if __name__ == "__main__":
    print(f"{train(0.0):.0%} of the corridors walked to their end; with SND-VIC {train(0.1):.0%}")
