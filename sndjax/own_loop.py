"""A bonus for a training loop of one's own: a module with all that it needs, in one pytree."""

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple, Unpack

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, Shaped

from sndjax.algorithms import make_named
from sndjax.architectures import size_for
from sndjax.autoreset import (
    count_resets_as_next,
    from_autoreset,
    from_carried_observations,
)
from sndjax.bonus_record import (
    PRESETS,
    Bonus,
    BonusChanges,
    BonusSettings,
    BonusState,
    check_settings,
)
from sndjax.checks import check_choice
from sndjax.convolution import to_float
from sndjax.grid import make_module
from sndjax.intrinsic_module import IntrinsicModule
from sndjax.intrinsic_training import (
    IntrinsicConfig,
    IntrinsicTrainState,
    read_rewards,
    train_module,
)
from sndjax.loop_checks import LoopShapes, check_batch, check_example, check_steps
from sndjax.preprocessing import standardize
from sndjax.rollout import minibatch_rows
from sndjax.statistics import (
    init_return_statistics,
    init_running_statistics,
    update_running_statistics,
)
from sndjax.types import Metrics, Rollout
from sndjax.vmap_hint import hint_under_vmap


def bonus(
    name: str | IntrinsicModule,
    num_actions: int,
    example: Shaped[Array, "N *frame"],
    preset: str = "thesis",
    module_options: Mapping[str, Any] = {},
    **settings: Unpack[BonusChanges],
) -> Bonus:
    """Make an intrinsic reward for a loop of one's own.

    The network follows from the shape of an observation: vectors and small grids get two hidden
    layers of 64, images the thesis' four convolutions (a smaller network with `preset="small"`).

    Args:
      name: of an algorithm (`sndjax.ALGORITHMS`); of a cell, objective and signal, such as
        "none+noveld"; or a module of one's own.
      num_actions: A.
      example: observations of all N environments, as in `init`; only shape and dtype are read.
      preset: "thesis", or "small" for tasks of minutes. With "small", for vectors, and for signals
        without a published unit, the reward is scaled by its running deviation, with eta 1;
        vectors are standardized either way.
      module_options: of a name, see `make_module`.
      **settings: the fields of `BonusSettings`, over those of the preset.

    Raises:
      ValueError: there is no such algorithm, preset or setting, a setting has another value than
        it may have, or `example` is none of vectors [N, D], images [N, H, W, C] and grids.

    >>> obs = jnp.zeros((8, 2))  # 8 environments
    >>> rewarder = bonus("snd_vic", num_actions=3, example=obs, preset="small")
    >>> state = rewarder.init(jax.random.key(0), obs)
    >>> steps, no = jnp.ones((16, 8, 2)), jnp.zeros((16, 8), bool)
    >>> action = jnp.zeros((16, 8), int)
    >>> reward, state, metrics = jax.jit(rewarder.step)(state, steps, action, steps, no)
    >>> reward.shape
    (16, 8)
    """
    shapes = check_example(example, num_actions)
    check_choice("preset", preset, tuple(PRESETS))
    check_settings(settings)
    size = size_for(shapes.frame, "small" if preset == "small" else "thesis")
    if isinstance(name, str):
        objective, cell, signal = name.partition("+")
        module = (
            make_module(objective, signal, num_actions, size, **module_options)
            if cell
            else make_named(name, num_actions, size, **module_options)
        )
    elif module_options:
        raise ValueError("module_options are for named algorithms; this module is made already")
    else:
        module = name
    chosen = PRESETS[preset]._replace(standardize=not size.channels)
    if not (module.has_published_scale and size.channels):
        chosen = chosen._replace(eta=1.0, reward_scale="running_std")
    chosen = chosen._replace(**settings)
    parts = BonusParts(module, chosen, shapes)
    return Bonus(
        init=partial(init_bonus, parts),
        step=partial(step_bonus, parts),
        step_batch=partial(step_batch, parts),
        module=module,
        settings=chosen,
    )


class BonusParts(NamedTuple):
    """What a bonus is made of."""

    module: IntrinsicModule
    settings: BonusSettings
    shapes: LoopShapes

    @property
    def config(self) -> IntrinsicConfig:
        """Return the module, and how its signal and its training are used."""
        fields = set(IntrinsicConfig._fields) & set(BonusSettings._fields)
        return IntrinsicConfig(
            self.module, **{name: getattr(self.settings, name) for name in fields}
        )


def init_bonus(parts: BonusParts, key: PRNGKeyArray, obs: Shaped[Array, "N *frame"]) -> BonusState:
    """Return the state of a bonus before any step. See `BonusInit`.

    Args:
      parts: what the bonus is made of.
      key: of the random draws.
      obs: the first observations of all N environments.

    Raises:
      ValueError: `obs` has another shape or dtype than the example.
    """
    parts.shapes.check("obs", obs, ("N",))
    key, key_module = jax.random.split(key)
    envs = obs.shape[0]
    params, module_state = parts.module.init(key_module, obs)
    shape = obs.shape[1:] if parts.settings.standardize else ()
    return BonusState(
        trained=IntrinsicTrainState(params, parts.config.optimizer().init(params), module_state),
        returns=init_return_statistics(envs),
        observations=init_running_statistics(shape),
        first=jnp.ones(envs, bool),
        reset=jnp.zeros(envs, bool),
        key=key,
    )


def step_bonus(
    parts: BonusParts,
    state: BonusState,
    obs: Shaped[Array, "T N *frame"],
    action: Int[Array, "T N"],
    next_obs: Shaped[Array, "T N *frame"] | None = None,
    done: Shaped[Array, "T N"] | None = None,
    *,
    last_obs: Shaped[Array, "N *frame"] | None = None,
    train: bool = True,
) -> tuple[Float[Array, "T N"], BonusState, Metrics]:
    """Return the intrinsic reward of T steps, and train on them. See `BonusStep`.

    Args:
      parts: what the bonus is made of.
      state: before.
      obs: what the policy saw.
      action: what it did.
      next_obs: the true next observation.
      done: the episode ended with this step.
      last_obs: in place of `next_obs`.
      train: False: read only.

    Raises:
      ValueError: an array does not fit the others, the example, or the number of actions.
    """
    settings = parts.settings
    ended = check_steps(parts.shapes, state.first.shape[0], obs, action, next_obs, done, last_obs)
    next_step = settings.reset == "next_step"
    if next_obs is not None and not next_step:
        rollout, stride = from_autoreset(obs, next_obs, action, ended, state.first), 2
    else:
        last = last_obs if next_obs is None else next_obs[-1]
        assert last is not None  # `check_steps`
        reset = state.reset if next_step else None
        rollout = from_carried_observations(obs, last, action, ended, state.first, reset)
        stride = 1
    reward, state, metrics = reward_and_train(parts, state, rollout, stride, train)
    if stride == 2 and next_obs is not None:
        metrics["resets_as_next_obs"] = count_resets_as_next(obs, next_obs, ended)
    before, last_done = jnp.concatenate([state.reset[None], ended])[-2:]
    state = state._replace(
        first=before if next_step else last_done,
        reset=last_done if next_step else state.reset,
    )
    return reward[::stride], state, metrics


def step_batch(
    parts: BonusParts,
    state: BonusState,
    obs: Shaped[Array, "B *frame"],
    action: Int[Array, " B"],
    next_obs: Shaped[Array, "B *frame"],
    *,
    valid: Shaped[Array, " B"] | None = None,
    train: bool = True,
) -> tuple[Float[Array, " B"], BonusState, Metrics]:
    """Return the intrinsic reward of B transitions, and train on them. See `BonusStepBatch`.

    Args:
      parts: what the bonus is made of.
      state: before.
      obs: what the policy saw.
      action: what it did.
      next_obs: the next observation.
      valid: the rows whose `next_obs` is the true one.
      train: False: read only.

    Raises:
      ValueError: the signal remembers episodes, or an array does not fit the others, the example,
        or the number of actions.
    """
    if parts.module.episodic:
        raise ValueError(
            f"{parts.module!r} remembers the running episode of every environment, and a batch of "
            "a replay has none; call step when transitions are collected and store the rewards, "
            "or take a signal without episode memory: distillation, prediction, disagreement, "
            "re3 or simhash"
        )
    counted = check_batch(parts.shapes, obs, action, next_obs, valid)
    no = jnp.zeros_like(counted)
    rollout = from_autoreset(obs[None], next_obs[None], action[None], no[None])
    rollout = rollout._replace(valid=counted[None])
    # Rows in no order have no sum over time: that of a single reward is the reward.
    alone = state.returns._replace(discounted=jnp.zeros(action.shape, jnp.float32))
    reward, after, metrics = reward_and_train(
        parts, state._replace(returns=alone), rollout, stride=1, train=train
    )
    returns = after.returns._replace(discounted=state.returns.discounted)
    return reward[0], after._replace(returns=returns), metrics


def reward_and_train(
    parts: BonusParts, state: BonusState, rollout: Rollout, stride: int, train: bool
) -> tuple[Float[Array, "R N"], BonusState, Metrics]:
    """Read the rewards of a rollout with the weights before, then train on it.

    Args:
      parts: what the bonus is made of.
      state: before.
      rollout: of R rows.
      stride: every so many rows is a transition; the rows between them are never valid.
      train: False: read only.

    Returns:
      The rewards of all rows, the state after, and metrics.
    """
    settings, config = parts.settings, parts.config
    key, key_reward, key_order, key_loss = jax.random.split(state.key, 4)
    observations = state.observations
    if settings.standardize:
        observations = update_running_statistics(
            observations, rollout.frames[:-1], rollout.valid, to_float
        )
        rollout = rollout._replace(frames=standardize(rollout.frames, observations))
    read = read_rewards(
        config, state.trained, state.returns, rollout, settings.discount, key_reward
    )
    trained = state.trained._replace(intrinsic_state=read.intrinsic_state)
    beyond = (rollout.action < 0) | (rollout.action >= parts.shapes.num_actions)
    metrics = read.metrics | {"unknown_actions": jnp.sum(beyond & rollout.valid, dtype=jnp.int32)}
    if train:
        steps, envs = rollout.action[::stride].shape
        index = jnp.concatenate(
            [
                minibatch_rows(one, steps, envs, settings.minibatch_size, settings.shuffle, stride)
                for one in jax.random.split(key_order, settings.epochs)
            ]
        )
        trained, learned = train_module(config, trained, rollout, index, key_loss)
        metrics |= learned
    return (
        read.reward,
        state._replace(
            trained=trained,
            returns=read.reward_scale,
            observations=observations,
            key=hint_under_vmap(key),
        ),
        metrics,
    )
