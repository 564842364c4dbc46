"""Rollouts of environments that live in JAX: policy and environments step in one program."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, Float, Int, Key, PRNGKeyArray, Shaped, UInt32

from sndjax.acting import Actor, AgentSpec, act
from sndjax.protocols import EnvironmentReset, EnvironmentStep
from sndjax.rollout import push_frame
from sndjax.types import Experience, Rollout

RESETS_OF = 128  # one environment in so many, and at least two, are reset at once


Keys = Key[Array, " N"] | UInt32[Array, "N _"]  # one for each environment


class JaxEnvironment(NamedTuple):
    """An environment as two pure functions of one instance, which is never reset by itself.

    `sndjax` reads only the functions and `num_actions`; the laboratory reads observations by their
    bounds or categories.

    Attributes:
      reset: key -> (state, observation).
      step: (key, state, action) -> (state, observation, reward, terminated, truncated).
      num_actions: A, actions are 0 to A - 1.
      low: the smallest value of each component of an observation, or of all; -inf: no bound.
      high: the largest value.
      categories: for observations whose integers are categories, their number in each component
        (an array that broadcasts to the observation's shape); else None.
    """

    reset: EnvironmentReset
    step: EnvironmentStep
    num_actions: int
    low: Any = -jnp.inf
    high: Any = jnp.inf
    categories: Any = None


class LiveEnvironments(NamedTuple):
    """N environments between two steps."""

    state: Any  # the environments' own, leaves [N, ...]
    frame: Shaped[Array, "N *frame"]  # the newest observation
    first: Bool[Array, " N"]  # it opens an episode
    ended: Bool[Array, " N"]  # it closes one: the next step resets the environment
    window: Shaped[Array, "S N *frame"]  # the stack before this frame


class EnvironmentRow(NamedTuple):
    """The result of one step of N environments, see `Rollout` and `Experience`."""

    reward: Float[Array, " N"]
    done: Bool[Array, " N"]
    truncated: Bool[Array, " N"]
    valid: Bool[Array, " N"]


StepRows = Callable[
    [LiveEnvironments, Int[Array, " N"], Int[Array, ""]], tuple[EnvironmentRow, LiveEnvironments]
]


def check_environment(env: JaxEnvironment) -> None:
    """Check, without computing anything, that `reset` and `step` fit each other.

    Args:
      env: what is checked.

    Raises:
      ValueError: `step` returns a state or an observation of another structure, shape or dtype than
        `reset`, or its reward or a flag is not a scalar.
    """
    key = jax.random.key(0)
    state, frame = jax.eval_shape(env.reset, key)
    action = jax.ShapeDtypeStruct((), jnp.int32)
    after, next_frame, *scalars = jax.eval_shape(env.step, key, state, action)
    structure: Callable[[Any], Any] = jax.tree.structure
    for name, old, new in (("state", state, after), ("observation", frame, next_frame)):
        if structure(old) != structure(new):
            raise ValueError(f"step returns a {name} of another structure than reset")
        for (path, was), becomes in zip(
            jax.tree_util.tree_leaves_with_path(old), jax.tree.leaves(new), strict=True
        ):
            if (was.shape, was.dtype) != (becomes.shape, becomes.dtype):
                raise ValueError(
                    f"{name}{jax.tree_util.keystr(path)} is {was.dtype}{list(was.shape)} after "
                    f"reset and {becomes.dtype}{list(becomes.shape)} after step"
                )
    for name, value in zip(("reward", "terminated", "truncated"), scalars, strict=True):
        if jnp.shape(value) != ():
            raise ValueError(f"step returns a {name} of shape {jnp.shape(value)}, not a scalar")


def init_environments(
    env: JaxEnvironment, key: PRNGKeyArray, num_envs: int, stack: int = 1
) -> LiveEnvironments:
    """Reset N environments.

    Args:
      env: the environment.
      key: of the resets; environment i gets `fold_in(key, i)`.
      num_envs: N.
      stack: the number of frames that the policy sees, `agent.stack.size`.

    Raises:
      ValueError: the environment's functions do not fit each other.
    """
    check_environment(env)
    state, frame = jax.vmap(env.reset)(environment_keys(key, num_envs))
    strong = lambda x: lax.convert_element_type(x, x.dtype) if is_number(x) else x
    state, frame = jax.tree.map(strong, (state, frame))
    return LiveEnvironments(
        state=state,
        frame=frame,
        first=jnp.ones(num_envs, bool),
        ended=jnp.zeros(num_envs, bool),
        window=jnp.zeros((stack, *frame.shape), frame.dtype),
    )


def step_environments(
    env: JaxEnvironment, live: LiveEnvironments, action: Int[Array, " N"], key: PRNGKeyArray
) -> tuple[EnvironmentRow, LiveEnvironments]:
    """Step N environments; one that ended is reset instead, which takes a row of its own.

    Args:
      env: the environment.
      live: the environments before.
      action: their actions, ignored where `live.ended`.
      key: of this step; environment i gets `fold_in(key, i)`.

    Returns:
      The row, and the environments after it, with the window as it was.
    """
    keys = environment_keys(key, live.ended.shape[0])
    state, frame, reward, terminated, truncated = jax.vmap(env.step)(keys, live.state, action)
    state, frame = reset_ended(env, live.ended, keys, (state, frame))
    row = make_row(live, reward, terminated, truncated)
    return row, LiveEnvironments(state, frame, first=live.ended, ended=row.done, window=live.window)


def collect(
    agent: AgentSpec,
    env: JaxEnvironment,
    actor: Actor,
    live: LiveEnvironments,
    key: PRNGKeyArray,
    steps: int,
) -> tuple[Experience, LiveEnvironments]:
    """Collect a rollout of T steps of N environments: the `batch` of `train_step`.

    `jax.vmap` of it collects for several agents; the resets stay as cheap as for one.

    Args:
      agent: what acts.
      env: the environment; its observations are the frames.
      actor: the policy's weights and the key of its draws.
      live: the environments, from `init_environments` or from the rollout before.
      key: of the environments' draws; a new one for every rollout, not that of the actor.
      steps: T.

    Returns:
      The rollout, and the environments after it.

    >>> import sndjax
    >>> from sndjax import VECTOR, ActorCritic, ppo
    >>> look = lambda at: jax.nn.one_hot(at, 4)
    >>> def step(key, at, action):  # a corridor of four cells
    ...     at = jnp.clip(at + 2 * action - 1, 0, 3)
    ...     return at, look(at), (at == 3).astype(jnp.float32), at == 3, jnp.zeros((), bool)
    >>> env = JaxEnvironment(lambda key: (jnp.zeros((), jnp.int32), look(0)), step, num_actions=2)
    >>> agent = AgentSpec(ActorCritic(VECTOR, 2, value_heads=1), ppo.Hyperparameters())
    >>> state = sndjax.init_train_state(agent, jax.random.key(0), jnp.zeros((2, 4)))
    >>> live = init_environments(env, jax.random.key(1), num_envs=2)
    >>> actor = Actor(state.policy, state.observations, state.key)
    >>> batch, live = collect(agent, env, actor, live, jax.random.key(2), steps=8)
    >>> batch.rollout.frames.shape, batch.rollout.action.shape
    ((9, 2, 4), (8, 2))
    """
    step = lambda live, action, t: step_environments(env, live, action, jax.random.fold_in(key, t))
    return collect_steps(agent, actor, live, step, steps)


def collect_steps(
    agent: AgentSpec,
    actor: Actor,
    live: LiveEnvironments,
    step: StepRows,
    steps: int,
) -> tuple[Experience, LiveEnvironments]:
    """Collect a rollout with a function that steps all N environments, however it does that.

    Args:
      agent: what acts.
      actor: the policy's weights and the key of its draws.
      live: the environments.
      step: (live, action[N], t) -> (row, the environments after it, with the window as it was).
      steps: T.

    Returns:
      The rollout, and the environments after it.
    """
    opening = push_frame(live.window, live.frame, live.first, agent.stack.repeat)

    def act_and_step(
        live: LiveEnvironments, t: Int[Array, ""]
    ) -> tuple[LiveEnvironments, tuple[Any, ...]]:
        output, window = act(agent, actor, live.window, live.frame, live.first, t)
        row, after = step(live, output.executed, t)
        return after._replace(window=window), (live.frame, live.first, output, row)

    times = jnp.arange(steps, dtype=jnp.int32)
    live, (frames, first, output, row) = lax.scan(act_and_step, live, times)
    # Only for the value of the last frame: the next rollout acts on it.
    last, _ = act(agent, actor, live.window, live.frame, live.first, jnp.int32(steps))
    rollout = Rollout(
        frames=jnp.concatenate([frames, live.frame[None]]),
        action=output.action,
        first=first,
        done=row.done,
        valid=row.valid,
    )
    return Experience(
        rollout=rollout,
        history=opening[:-1],
        reward=row.reward,
        truncated=row.truncated,
        log_prob=output.log_prob,
        value=jnp.concatenate([output.value, last.value[None]]),
    ), live


def make_row(
    live: LiveEnvironments,
    reward: Float[Array, " N"],
    terminated: Bool[Array, " N"],
    truncated: Bool[Array, " N"],
) -> EnvironmentRow:
    """Return the row of a step in which the environments that had ended were reset.

    An episode that its task and a limit end in the same step is terminated, not truncated.

    Args:
      live: the environments before the step.
      reward: what they returned; ignored where they were reset.
      terminated: whether the task ended the episode.
      truncated: whether a limit ended it.
    """
    valid = ~live.ended
    return EnvironmentRow(
        reward=jnp.where(valid, reward, 0).astype(jnp.float32),
        done=(terminated | truncated) & valid,
        truncated=truncated & ~terminated & valid,
        valid=valid,
    )


def environment_keys(key: PRNGKeyArray, num_envs: int) -> Keys:
    """Return a key for each environment: the draws of one do not depend on the others."""
    return jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(num_envs))


def is_number(x: Any) -> bool:
    """Return False for arrays of random keys."""
    return not jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def reset_ended(env: JaxEnvironment, ended: Bool[Array, " N"], keys: Keys, live: Any) -> Any:
    """Reset the environments that ended, a few at once, and no others.

    A reset may cost twenty steps (Craftax), and under vmap a branch for each environment would
    become a reset of all of them on every step. The result does not depend on how many are reset at
    once. Under vmap the mapped axes are joined with that of the environments.

    Args:
      env: the environment.
      ended: which are reset.
      keys: the key of each.
      live: state and frame of each, leaves [N, ...].

    Returns:
      `live` with those that ended replaced.
    """

    @custom_vmap
    def reset(ended: Any, keys: Any, live: Any) -> Any:
        count = ended.shape[0]
        some = min(count, max(2, count // RESETS_OF))

        def reset_some(carry: tuple[Array, Any]) -> tuple[Array, Any]:
            left, live = carry
            (index,) = jnp.nonzero(left, size=some, fill_value=count)
            fresh = jax.vmap(env.reset)(keys[jnp.minimum(index, count - 1)])
            put = lambda x, new: x.at[index].set(new, mode="drop")
            return left.at[index].set(False, mode="drop"), jax.tree.map(put, live, fresh)

        return lax.while_loop(lambda carry: jnp.any(carry[0]), reset_some, (ended, live))[1]

    @reset.def_vmap
    def reset_of_all(
        axis_size: int, in_batched: Any, ended: Any, keys: Any, live: Any
    ) -> tuple[Any, Any]:
        """Join the mapped axis with that of the environments; Returns the result and its axes."""
        repeat = lambda x, has: x if has else jnp.broadcast_to(x, (axis_size, *x.shape))
        args = jax.tree.map(repeat, (ended, keys, live), tuple(in_batched))
        joined = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), args)
        done = reset(*joined)
        split = lambda x: x.reshape(axis_size, -1, *x.shape[1:])
        return jax.tree.map(split, done), jax.tree.map(lambda _: True, done)

    return reset(ended, keys, live)
