"""An encoder, an objective and a signal make an intrinsic module: one cell of the grid."""

from typing import cast

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from sndjax.convolution import to_float
from sndjax.networks import Encoder
from sndjax.preprocessing import Preprocess, preprocessor
from sndjax.rollout import without_invalid
from sndjax.statistics import feature_spread, no_moments, update_moments
from sndjax.types import Average, Encode, Features, IntrinsicModule, Objective, Signal, View


def compose(
    encoder: Encoder,
    objective: Objective | None,
    signal: Signal,
    num_actions: int,
    *,
    preprocess: Preprocess = "none",
    weights: tuple[float, float] = (1.0, 1.0),
) -> IntrinsicModule:
    """The module that reads `signal` off `encoder` while `objective` shapes it.

    Args:
      encoder: the network that features come from. Objectives train it; whether a signal
        does is the signal's own matter.
      objective: what trains the encoder on pairs (s_t, s_t+1). None: the encoder stays as
        it was drawn.
      signal: what is read off it.
      num_actions: A, of the environment.
      preprocess: what frames go through first; moments take in a rollout before its
        rewards are read.
      weights: of the objective's and of the signal's loss.

    Returns:
      The module. Its params are "encoder" and "objective" (both only where there is an
      objective) and "signal"; its state "moments" of the input, the "encoder" where it is
      frozen, "slow" copies where the objective wants them, and the "signal"'s own.

    >>> from sndjax import VECTOR, rnd
    >>> params, state = rnd(3, VECTOR).init(jax.random.key(0), jnp.zeros((1, 2)))
    >>> sorted(params), sorted(state)
    (['signal'], ['encoder', 'moments', 'signal', 'slow'])
    """
    moving = preprocess != "none"
    decay = objective.decay if objective else None
    pairs = signal.pairs or (objective is not None and objective.pairs)

    def init(key, example):
        key_encoder, key_objective, key_signal = jax.random.split(key, 3)
        frame, action = to_float(example[:1]), jnp.zeros(1, jnp.int32)
        weights = encoder.init(key_encoder, frame, action)
        z, local = forward(weights, frame, action)
        features = Features(z, z, local, local)
        params = {}
        if objective is not None:
            params["encoder"] = weights
            params["objective"] = objective.init(key_objective, features, num_actions)
        params["signal"], signal_state = signal.init(key_signal, example, features, num_actions)
        return params, {
            "moments": no_moments(frame.shape[1:]) if moving else None,
            "encoder": weights if objective is None else None,
            "slow": slow_part(params) if decay is not None else None,
            "signal": signal_state,
        }

    def forward(weights, frames, action=None) -> tuple[Array, Array]:
        return cast(tuple[Array, Array], encoder.apply(weights, frames, action))

    def view(params, state, weights=None) -> View:
        prepare = preprocessor(preprocess, state["moments"])
        if weights is None:
            weights = params["encoder"] if objective is not None else state["encoder"]
        encode: Encode = lambda frames, action=None: forward(weights, prepare(frames), action)
        return View(prepare, encode)

    def slow_part(params):
        return {name: params[name] for name in ("encoder", "objective")}

    def reward(params, state, rollout, key):
        if moving:
            seen = update_moments(state["moments"], rollout.frames[:-1], rollout.valid, to_float)
            state = state | {"moments": seen}
        value, own = signal.reward(
            params["signal"], state["signal"], view(params, state), rollout, key
        )
        return jnp.where(rollout.valid, value, jnp.zeros_like(value)), state | {"signal": own}

    def loss(params, state, batch, rollout, key):
        batch = without_invalid(batch)
        key_objective, key_signal = jax.random.split(key)
        seen = view(params, state)
        if pairs:
            z, local = seen.encode(batch.frames)
            features = Features(batch.now(z), batch.then(z), batch.now(local), batch.then(local))
        else:
            z, local = seen.encode(batch.frame, batch.action)
            features = Features(z, z, local, local)
        total, metrics = signal.loss(
            params["signal"], state["signal"], seen, features, batch, key_signal
        )
        metrics = metrics | {
            "feature_spread": feature_spread(lax.stop_gradient(features.z), batch.valid)
        }
        if objective is None:
            return total, metrics
        more = {}
        if decay is not None:
            slow = state["slow"]
            encode = view(params, state, slow["encoder"]).encode
            more["average"] = Average(slow["objective"], encode)
        shaping, terms = objective.loss(
            params["objective"], seen.encode, features, batch, rollout, key_objective, **more
        )
        total = weights[0] * shaping + weights[1] * total
        return total, metrics | {"objective_loss": shaping} | terms

    def update(params, state):
        if decay is None:
            return state
        mix = lambda slow, now: decay * slow + (1 - decay) * now
        return state | {"slow": jax.tree.map(mix, state["slow"], slow_part(params))}

    def features(params, state, frames, action=None):
        return view(params, state).encode(frames, action)[0]

    return IntrinsicModule(init, reward, loss, update, features)
