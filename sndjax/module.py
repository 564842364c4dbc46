"""An encoder, an objective and a signal make an intrinsic module: one cell of the grid."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, PRNGKeyArray, Shaped

from sndjax.checks import check_actions, check_rollout
from sndjax.convolution import to_float
from sndjax.encoder_view import Parts, apply_encoder, encode_batch, view_encoder
from sndjax.intrinsic_module import IntrinsicModule
from sndjax.networks import Encoder
from sndjax.preprocessing import Preprocess
from sndjax.protocols import Objective, Signal, TargetNetwork
from sndjax.rollout import zero_invalid_rows
from sndjax.statistics import (
    feature_std_over_batch,
    init_running_statistics,
    update_running_statistics,
)
from sndjax.types import (
    Features,
    Loss,
    ModuleParams,
    ModuleState,
    Rollout,
    TargetWeights,
    Transition,
)


def make_intrinsic_module(
    encoder: Encoder,
    objective: Objective | None,
    signal: Signal,
    num_actions: int,
    *,
    preprocess: Preprocess = "none",
    weights: tuple[float, float] = (1.0, 1.0),
) -> IntrinsicModule:
    """Return the module that reads `signal` off `encoder` while `objective` shapes it.

    Args:
      encoder: the network that features come from; objectives train it, and some signals do.
      objective: what trains the encoder on pairs (s_t, s_t+1). None: the encoder stays random.
      signal: what is read off it.
      num_actions: A, of the environment.
      preprocess: of frames; a rollout updates its running statistics before its rewards are read.
      weights: of the objective's and of the signal's loss.

    Returns:
      The module. Its params are a `ModuleParams`, its state is a `ModuleState`.

    >>> from sndjax import VECTOR, rnd
    >>> module = rnd(3, VECTOR)
    >>> params, state = module.init(jax.random.key(0), jnp.zeros((1, 2)))
    >>> params.encoder is None, state.slow is None, module.has_published_scale
    (True, True, True)
    """
    parts = Parts(encoder, objective, signal, num_actions, preprocess, weights)
    return IntrinsicModule(
        init=partial(init_module, parts),
        reward=partial(module_reward, parts),
        loss=partial(module_loss, parts),
        update=partial(update_target, parts),
        features=partial(module_features, parts),
        has_published_scale=signal.has_published_scale,
        episodic=signal.episodic,
        description=(
            f"objective={objective!r}, signal={signal!r}, preprocess={preprocess!r}, "
            f"weights={weights!r}, {encoder.description}"
        ),
    )


def init_module(
    parts: Parts, key: PRNGKeyArray, example: Shaped[Array, "N *frame"]
) -> tuple[ModuleParams, ModuleState]:
    """Return the parameters and the state of a module before any training.

    Args:
      parts: what it is made of.
      key: of the random draws.
      example: frames of all N environments, for their shape and dtype.
    """
    objective = parts.objective
    key_encoder, key_objective, key_signal = jax.random.split(key, 3)
    frame, action = to_float(example[:1]), jnp.zeros(1, jnp.int32)
    encoder = parts.encoder.init(key_encoder, frame, action)
    z, local = apply_encoder(parts.encoder, encoder, frame, action)
    features = Features(z=z, z_next=z, local=local, local_next=local)
    own = objective.init(key_objective, features, parts.num_actions) if objective else None
    signal, signal_state = parts.signal.init(key_signal, example, features, parts.num_actions)
    params = ModuleParams(encoder=encoder if objective else None, objective=own, signal=signal)
    moments = None if parts.preprocess == "none" else init_running_statistics(frame.shape[1:])
    return params, ModuleState(
        encoder=None if objective else encoder,
        moments=moments,
        signal=signal_state,
        slow=None if parts.ema_decay is None else copy_weights(params),
    )


def copy_weights(params: ModuleParams) -> TargetWeights:
    """Return target networks with the weights of the others, in arrays of their own.

    A state that holds an array twice cannot be donated to a jitted function.
    """
    online = TargetWeights(params.encoder, params.objective)
    return jax.tree.map(lambda x: jnp.array(x, copy=True), online)


def module_reward(
    parts: Parts,
    params: ModuleParams,
    state: ModuleState,
    rollout: Rollout,
    key: PRNGKeyArray,
    update_statistics: bool = True,
) -> tuple[Float[Array, "T N"], ModuleState]:
    """Return the signal of every row, 0 at invalid rows, and the new state.

    Args:
      parts: what the module is made of.
      params: of the module.
      state: of the module.
      rollout: what to read.
      key: of the random draws.
      update_statistics: add the rollout to the running statistics of the input first.

    Raises:
      ValueError: the arrays of the rollout do not belong together, see `check_rollout`.
    """
    check_rollout(rollout, parts.num_actions)
    if state.moments is not None and update_statistics:
        moments = update_running_statistics(
            state.moments, rollout.frames[:-1], rollout.valid, to_float
        )
        state = state._replace(moments=moments)
    view = view_encoder(parts, params, state)
    value, own = parts.signal.reward(params.signal, state.signal, view, rollout, key)
    value = jnp.where(rollout.valid, value, jnp.zeros_like(value))
    return value, state._replace(signal=own)


def module_loss(
    parts: Parts,
    params: ModuleParams,
    state: ModuleState,
    batch: Transition,
    rollout: Rollout,
    key: PRNGKeyArray,
) -> Loss:
    """Return the weighted sum of the objective's and the signal's loss, and metrics.

    Args:
      parts: what the module is made of.
      params: of the module.
      state: of the module.
      batch: the minibatch.
      rollout: the rollout that it is from.
      key: of the random draws.

    Raises:
      ValueError: an action is not below A, where its value is known.
    """
    check_actions(batch.action, batch.valid, parts.num_actions)
    batch = zero_invalid_rows(batch)
    key_objective, key_signal = jax.random.split(key)
    view = view_encoder(parts, params, state)
    features = encode_batch(parts, view, batch)
    total, metrics = parts.signal.loss(
        params.signal, state.signal, view, features, batch, key_signal
    )
    spread = feature_std_over_batch(lax.stop_gradient(features.z), batch.valid)
    metrics = metrics | {"feature_spread": spread}
    if parts.objective is None:
        return parts.weights[1] * total, metrics
    loss: Callable[..., Loss] = parts.objective.loss
    target: dict[str, Any] = {}
    if state.slow is not None:
        encode = view_encoder(parts, params, state, state.slow.encoder).encode
        target["target"] = TargetNetwork(params=state.slow.objective, encode=encode)
    shaping, terms = loss(
        params.objective, view.encode, features, batch, rollout, key_objective, **target
    )
    total = parts.weights[0] * shaping + parts.weights[1] * total
    return total, metrics | {"objective_loss": shaping} | terms


def update_target(parts: Parts, params: ModuleParams, state: ModuleState) -> ModuleState:
    """Return the state with the target networks moved by one step of their moving average.

    Args:
      parts: what the module is made of.
      params: after the optimizer step.
      state: before it.
    """
    decay = parts.ema_decay
    if decay is None:
        return state
    online = TargetWeights(params.encoder, params.objective)
    average = lambda target, now: decay * target + (1 - decay) * now
    return state._replace(slow=jax.tree.map(average, state.slow, online))


def module_features(
    parts: Parts,
    params: ModuleParams,
    state: ModuleState,
    frames: Shaped[Array, "B *frame"],
    action: Int[Array, " B"] | None = None,
) -> Float[Array, "B d"]:
    """Return the encoder's features of a batch of frames.

    Args:
      parts: what the module is made of.
      params: of the module.
      state: of the module.
      frames: observations.
      action: for encoders that take the action as input.
    """
    return view_encoder(parts, params, state).encode(frames, action)[0]
