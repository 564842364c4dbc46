"""What a module is made of, and how it sees frames."""

from typing import NamedTuple, cast

from jaxtyping import Array, Float, Int, Shaped

from sndjax.networks import Encoder, match_dtype
from sndjax.preprocessing import Preprocess, make_preprocess
from sndjax.protocols import EncoderView, Objective, Signal
from sndjax.types import Features, ModuleParams, ModuleState, Params, Transition


class Parts(NamedTuple):
    """What a module is made of.

    Attributes:
      encoder: the network that features come from.
      objective: what trains it, if anything does.
      signal: what is read off it.
      num_actions: A.
      preprocess: what frames go through first.
      weights: of the objective's and of the signal's loss.
    """

    encoder: Encoder
    objective: Objective | None
    signal: Signal
    num_actions: int
    preprocess: Preprocess
    weights: tuple[float, float]

    @property
    def needs_pairs(self) -> bool:
        """Return True if a loss reads the features of s_t+1."""
        return self.signal.needs_pairs or (
            self.objective is not None and self.objective.needs_pairs
        )

    @property
    def ema_decay(self) -> float | None:
        """Return the decay of the objective's target networks; None without any."""
        return None if self.objective is None else self.objective.ema_decay


def apply_encoder(
    encoder: Encoder,
    weights: Params,
    frames: Shaped[Array, "B *frame"],
    action: Int[Array, " B"] | None = None,
) -> tuple[Float[Array, "B d"], Float[Array, "B I J C"]]:
    """Return features z and the local map of a batch of preprocessed frames.

    Args:
      encoder: the network.
      weights: its weights.
      frames: what it reads.
      action: for encoders that take the action as input.
    """
    return cast(tuple[Array, Array], encoder.apply(weights, match_dtype(frames, weights), action))


def view_encoder(
    parts: Parts, params: ModuleParams, state: ModuleState, weights: Params | None = None
) -> EncoderView:
    """Return how the module sees frames now.

    Args:
      parts: what it is made of.
      params: of the module.
      state: of the module.
      weights: of the encoder; None: its own.
    """
    preprocess = make_preprocess(parts.preprocess, state.moments)
    if weights is None:
        weights = state.encoder if parts.objective is None else params.encoder

    def encode(
        frames: Shaped[Array, "B *frame"], action: Int[Array, " B"] | None = None
    ) -> tuple[Float[Array, "B d"], Float[Array, "B I J C"]]:
        return apply_encoder(parts.encoder, weights, preprocess(frames), action)

    return EncoderView(preprocess=preprocess, encode=encode)


def encode_batch(parts: Parts, view: EncoderView, batch: Transition) -> Features:
    """Return the features of a minibatch, of s_t+1 too where a loss reads them.

    Args:
      parts: what the module is made of.
      view: the encoder.
      batch: the minibatch.
    """
    if parts.needs_pairs:
        z, local = view.encode(batch.frames)
        return Features(
            z=batch.at_t(z),
            z_next=batch.at_next(z),
            local=batch.at_t(local),
            local_next=batch.at_next(local),
        )
    z, local = view.encode(batch.frame, batch.action)
    return Features(z=z, z_next=z, local=local, local_next=local)
