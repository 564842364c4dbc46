"""An environment inside the jit for tests, and the plain loop that its rollouts must equal."""

import jax
import jax.numpy as jnp
import numpy as np

import sndjax

CELLS, LIMIT = 5, 7


def corridor(cells=CELLS, limit=LIMIT, slip=0.25):
    """Return a corridor with a random start, slips, an end and a step limit."""

    def look(state):
        return jnp.stack([state["at"], state["time"]]).astype(jnp.float32) + state["mark"]

    def reset(key):
        key_at, key_mark = jax.random.split(key)
        at = jax.random.randint(key_at, (), 0, cells - 1)
        state = {"at": at, "time": jnp.int32(0), "mark": jax.random.uniform(key_mark), "key": key}
        return state, look(state)

    def step(key, state, action):
        slips = jax.random.bernoulli(key, slip)
        move = jnp.where(slips, -1, 2 * action - 1)
        state = state | {"at": jnp.clip(state["at"] + move, 0, cells - 1)}
        state["time"] = state["time"] + 1
        end = state["at"] == cells - 1
        return state, look(state), 1.5 * end, end, state["time"] >= limit

    return sndjax.JaxEnvironment(reset, step, num_actions=2)


def play_in_python(env, start, actions, keys):
    """Play every environment by itself; return frames [T + 1, N, ...] and columns [T, N].

    Args:
      env: the environment.
      start: the keys of the first resets, [N].
      actions: [T, N].
      keys: the keys of the steps, [T, N].
    """
    steps, envs = actions.shape
    reset, step = jax.jit(env.reset), jax.jit(env.step)
    frames, columns = [], []
    for n in range(envs):
        state, frame = reset(start[n])
        first, ended, own, rows = True, False, [frame], []
        for t in range(steps):
            if ended:
                state, frame = reset(keys[t, n])
                rows.append((0.0, False, False, False, first))
                first, ended = True, False
            else:
                state, frame, reward, end, limit = step(keys[t, n], state, actions[t, n])
                done, truncated = bool(end or limit), bool(limit and not end)
                rows.append((float(reward), done, truncated, True, first))
                first, ended = False, done
            own.append(frame)
        frames.append(own)
        columns.append(rows)
    names = ("reward", "done", "truncated", "valid", "first")
    table = np.array(columns, dtype=float).transpose(2, 1, 0)
    frames = np.array([[np.asarray(x) for x in own] for own in frames])
    return np.moveaxis(frames, 0, 1), dict(zip(names, table, strict=True))
