"""Rollouts of environments that live in JAX: policy and environments step in one program."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, Shaped

from sndjax.acting import Actor, ActorMemory, AgentSpec, act
from sndjax.actor_critic import ActorCritic, Hidden
from sndjax.jax_environment import (
    JaxEnvironment,
    Keys,
    check_environment,
    environment_keys,
    is_number,
    reset_ended,
)
from sndjax.rollout import push_frame
from sndjax.types import Experience, Rollout
from sndjax.visits import Visits, init_visits, update_visits


class LiveEnvironments(NamedTuple):
    """N environments between two steps."""

    state: Any  # the environments' own, leaves [N, ...]
    frame: Shaped[Array, "N *frame"]  # the newest observation
    first: Bool[Array, " N"]  # it opens an episode
    ended: Bool[Array, " N"]  # it closes one: the next step resets the environment
    window: Shaped[Array, "S N *frame"]  # the stack before this frame
    hidden: Hidden = None  # of a recurrent policy
    visits: Visits | None = None  # of environments with `place`

    @property
    def memory(self) -> ActorMemory:
        """Return what the policy remembers of the running episodes."""
        return ActorMemory(self.window, self.hidden)


class EnvironmentRow(NamedTuple):
    """The result of one step of N environments, see `Rollout` and `Experience`."""

    reward: Float[Array, " N"]
    done: Bool[Array, " N"]
    truncated: Bool[Array, " N"]
    valid: Bool[Array, " N"]


StepRows = Callable[
    [LiveEnvironments, Int[Array, " N"], Int[Array, ""]], tuple[EnvironmentRow, LiveEnvironments]
]


def init_environments(
    env: JaxEnvironment,
    key: PRNGKeyArray,
    num_envs: int,
    stack: int = 1,
    network: ActorCritic | None = None,
) -> LiveEnvironments:
    """Reset N environments.

    Args:
      env: the environment.
      key: of the resets; environment i gets `fold_in(key, i)`.
      num_envs: N.
      stack: the number of frames that the policy sees, `agent.stack.size`.
      network: of the agent; needed where it has a memory.

    Raises:
      ValueError: the environment's functions do not fit each other.
    """
    live = init_with_keys(env, environment_keys(key, num_envs), stack)
    return live._replace(hidden=network.initial_memory(num_envs)) if network else live


def init_with_keys(env: JaxEnvironment, keys: Keys, stack: int = 1) -> LiveEnvironments:
    """Reset N environments, each with a key of its own. See `init_environments`.

    Args:
      env: the environment.
      keys: of the resets.
      stack: the number of frames that the policy sees.

    Raises:
      ValueError: the environment's functions do not fit each other.
    """
    check_environment(env)
    state, frame = jax.vmap(env.reset)(keys)
    num_envs = frame.shape[0]
    strong = lambda x: lax.convert_element_type(x, x.dtype) if is_number(x) else x
    state, frame = jax.tree.map(strong, (state, frame))
    return LiveEnvironments(
        state=state,
        frame=frame,
        first=jnp.ones(num_envs, bool),
        ended=jnp.zeros(num_envs, bool),
        window=jnp.zeros((stack, *frame.shape), frame.dtype),
        visits=init_visits(env, state),
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
    return step_with_keys(env, live, action, environment_keys(key, live.ended.shape[0]))


def step_with_keys(
    env: JaxEnvironment, live: LiveEnvironments, action: Int[Array, " N"], keys: Keys
) -> tuple[EnvironmentRow, LiveEnvironments]:
    """Step N environments, each with a key of its own. See `step_environments`.

    Args:
      env: the environment.
      live: the environments before.
      action: their actions.
      keys: of this step.

    Returns:
      The row, and the environments after it.
    """
    state, frame, reward, terminated, truncated = jax.vmap(env.step)(keys, live.state, action)
    state, frame = reset_ended(env, live.ended, keys, (state, frame))
    row = make_row(live, reward, terminated, truncated)
    visits = update_visits(env, live.visits, state, row.done)
    after = live._replace(state=state, frame=frame, first=live.ended, ended=row.done, visits=visits)
    return row, after


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
    hidden = live.hidden

    def act_and_step(
        live: LiveEnvironments, t: Int[Array, ""]
    ) -> tuple[LiveEnvironments, tuple[Any, ...]]:
        output, memory = act(agent, actor, live.memory, live.frame, live.first, t)
        row, after = step(live, output.executed, t)
        return after._replace(**memory._asdict()), (live.frame, live.first, output, row)

    times = jnp.arange(steps, dtype=jnp.int32)
    live, (frames, first, output, row) = lax.scan(act_and_step, live, times)
    # Only for the value of the last frame: the next rollout acts on it.
    last, _ = act(agent, actor, live.memory, live.frame, live.first, jnp.int32(steps))
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
        hidden=hidden,
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
