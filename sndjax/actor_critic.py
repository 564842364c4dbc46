"""The policy and its value heads, with or without a memory."""

from collections.abc import Callable
from typing import cast

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Shaped

from sndjax.activations import ACTIVATIONS
from sndjax.architectures import Architecture
from sndjax.networks import ROOT_2, Torso, linear, normalize, orthogonal
from sndjax.types import Params

Hidden = Float[Array, "N d"] | None  # the recurrent state of N environments
CELLS: dict[str, Callable[..., nn.RNNCellBase]] = {"gru": nn.GRUCell}


def remember(
    cell: nn.RNNCellBase, hidden: Float[Array, "N d"], x: Float[Array, "B d"], first: Array
) -> tuple[Float[Array, "N d"], Float[Array, "B d"]]:
    """Run a recurrent cell over T steps of N environments, B = T * N.

    Args:
      cell: the cell.
      hidden: its state before the first step.
      x: its inputs.
      first: [T, N], where the state is reset to zeros before the step.

    Returns:
      The state after the last step, and the outputs.
    """

    def step(cell: nn.RNNCellBase, hidden: Array, row: tuple[Array, Array]) -> tuple[Array, Array]:
        x, first = row
        hidden = jnp.where(first[:, None], jnp.zeros_like(hidden), hidden)
        return cast(tuple[Array, Array], cell(hidden, x))

    scan = nn.scan(step, variable_broadcast="params", split_rngs={"params": False})
    after, x = scan(cell, hidden.astype(x.dtype), (x.reshape(*first.shape, -1), first))
    return after.astype(hidden.dtype), x.reshape(first.size, -1)


class ActorCritic(nn.Module):
    """The policy and its value heads on one torso (Fig. 5.3a).

    Maps stacked frames `[B, H, W, C * S]` (or vectors `[B, D]`) to
    `(logits float32[B, A], value float32[B, K])`. With one head (the baseline) the
    critic stands behind an extra ReLU, as in the published experiments. The torso's features are
    sown as the intermediate "torso", see `torso_features`. With a `memory` in the architecture a
    recurrent cell stands between torso and heads, see `unroll`.
    """

    architecture: Architecture
    num_actions: int
    value_heads: int = 2

    def __call__(
        self, stacked: Shaped[Array, "B *stack"]
    ) -> tuple[Float[Array, "B A"], Float[Array, "B K"]]:
        """Return logits and values of rows that do not follow each other: each opens an episode.

        Args:
          stacked: frames of a stack on the last axis.
        """
        rows = stacked.shape[0]
        first = jnp.ones((1, rows), bool)
        logits, value, _ = self.unroll(stacked, self.initial_memory(rows), first)
        return logits, value

    def initial_memory(self, envs: int) -> Hidden:
        """Return the recurrent state before an episode, zeros [N, d]; None without a memory."""
        size = self.architecture
        return None if size.memory == "none" else jnp.zeros((envs, size.features), jnp.float32)

    @nn.compact
    def unroll(
        self, stacked: Shaped[Array, "B *stack"], hidden: Hidden, first: Bool[Array, "T N"]
    ) -> tuple[Float[Array, "B A"], Float[Array, "B K"], Hidden]:
        """Return logits and values of T steps of N environments, and the recurrent state after.

        Args:
          stacked: the rows, B = T * N, row t of environment n being t * N + n.
          hidden: the recurrent state before the first step; None without a memory.
          first: where an episode opens: the state is reset to zeros before that step.
        """
        size = self.architecture
        act = ACTIVATIONS[size.activation]
        norm = lambda x: normalize(x, size.layer_norm)
        convolutions = size.convolutions(size.last)
        torso = Torso(convolutions, size.hidden, ROOT_2, size.activation, size.layer_norm)
        x = norm(linear(size.features, ROOT_2)(torso(stacked)[0]))
        self.sow("intermediates", "torso", x)
        if (hidden is None) != (size.memory == "none"):
            raise ValueError(
                f"memory={size.memory!r} and {'no' if hidden is None else 'a'} recurrent state: "
                "begin with network.initial_memory(N), as init_environments(..., network=) does"
            )
        if hidden is not None:
            cell = CELLS[size.memory](size.features, recurrent_kernel_init=orthogonal(1.0))
            hidden, x = remember(cell, hidden, x, first)
        actor = act(norm(linear(size.features, 0.01)(act(x))))
        logits = linear(self.num_actions, 0.01)(actor)
        critic = act(x) if self.value_heads == 1 else x
        critic = act(norm(linear(size.features, 0.1)(critic)))
        heads = [linear(1, 0.01)(critic) for _ in range(self.value_heads)]
        return logits, jnp.concatenate(heads, axis=-1), hidden


def torso_features(
    network: ActorCritic, params: Params, stacked: Shaped[Array, "B *stack"]
) -> Float[Array, "B d"]:
    """Return what the policy's torso makes of stacks: the output of its linear layer.

    Args:
      network: the policy.
      params: its weights.
      stacked: frames of a stack on the last axis.
    """
    _, found = network.apply(params, stacked, mutable=["intermediates"])
    return found["intermediates"]["torso"][0]
