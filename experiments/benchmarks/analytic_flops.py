"""The operations of an environment step, derived by hand from the networks and the loops.

They count acting, the intrinsic rewards, the PPO epochs and one pass of the intrinsic module: a
forward pass once, a backward pass twice; a multiply-add is two operations. The number does not
depend on what a program shares or computes twice, so that two programs can be compared by it.
"""

import itertools
from collections.abc import Sequence
from math import prod

from sndjax.architectures import Architecture
from sndjax.convolution import Convolution
from sndjax.grid import OBJECTIVES, make_encoder_and_predictor
from sndjax.networks import Encoder

TRAINED = 3  # forward 1 and backward 2


def mlp_flops(*widths: int) -> float:
    """Return the operations of consecutive linear layers with these widths."""
    return sum(2.0 * a * b for a, b in itertools.pairwise(widths))


def torso_flops(
    convolutions: Sequence[Convolution], hidden: Sequence[int], shape: tuple[int, ...]
) -> tuple[float, int, tuple[int, int]]:
    """Return the operations on one frame, the number of outputs and the local map's (IJ, C).

    Args:
      convolutions: the convolutions; none for vectors.
      hidden: the widths of the hidden layers for vectors.
      shape: the shape of a frame.
    """
    if not convolutions:
        return mlp_flops(prod(shape), *hidden), hidden[-1], (1, hidden[-1])
    height, width, channels = shape
    total, local = 0.0, (0, 0)
    for i, layer in enumerate(convolutions):
        height = (height + 2 * layer.padding - layer.size) // layer.stride + 1
        width = (width + 2 * layer.padding - layer.size) // layer.stride + 1
        total += 2.0 * height * width * layer.channels * layer.size**2 * channels
        channels = layer.channels
        if i == 2:
            local = (height * width, channels)
    return total, height * width * channels, local


def encoder_flops(network: Encoder, shape: tuple[int, ...]) -> float:
    """Return the operations of an encoder on one frame."""
    total, out, _ = torso_flops(network.convolutions, network.hidden, shape)
    d = network.features
    return total + mlp_flops(out + network.num_actions, *[d] * (1 + network.extra))


def policy_flops(size: Architecture, stack: tuple[int, ...], num_actions: int, heads: int) -> float:
    """Return the operations of the actor-critic on one stack.

    Args:
      size: the sizes of the networks.
      stack: the shape of a stack.
      num_actions: A, the number of actions.
      heads: K, the number of value heads.
    """
    total, out, _ = torso_flops(size.convolutions(size.last), size.hidden, stack)
    d = size.features
    return total + mlp_flops(out, d) + mlp_flops(d, d, num_actions) + mlp_flops(d, d, heads)


def objective_flops(
    name: str, size: Architecture, shape: tuple[int, ...], num_actions: int, rows: int
) -> float | None:
    """Return the operations of an objective's loss per row, without its encodings.

    Args:
      name: the name of the objective.
      size: the sizes of the networks.
      shape: the shape of a frame.
      num_actions: A, the number of actions.
      rows: the number of rows of a minibatch.

    Returns:
      The operations; None for objectives whose operations were not derived.
    """
    d = size.features
    positions, channels = torso_flops(size.convolutions(size.last), size.hidden, shape)[2]
    return {
        "none": 0.0,
        "contrastive": 0.0,
        # Logits of all rows against all rows at every position, twice, and the two linear maps.
        "st_dim": positions * (2 * mlp_flops(channels, rows) + mlp_flops(channels, channels))
        + mlp_flops(d, channels),
        "vicreg": 2 * mlp_flops(d, d),  # the covariance of both views
        "barlow_twins": mlp_flops(d, d),
        "inverse_dynamics": mlp_flops(2 * d, d, d, num_actions),
        "vicreg_inverse": 2 * mlp_flops(d, d) + mlp_flops(2 * d, d, d // 2, num_actions),
    }.get(name)


def intrinsic_flops(
    of: str,
    signal: str,
    size: Architecture,
    shape: tuple[int, ...],
    num_actions: int,
    rows: int,
    action_input: bool = False,
) -> float | None:
    """Return the operations of the intrinsic module per environment step: rewards and training.

    Args:
      of: the name of the objective.
      signal: the name of the signal.
      size: the sizes of the networks.
      shape: the shape of a frame.
      num_actions: A, the number of actions.
      rows: the number of rows of a minibatch.
      action_input: whether the networks take the action as input.

    Returns:
      The operations; None where they were not derived: for signals other than distillation and
      prediction, for BYOL and further objectives, and for prediction where the objective does not
      read pairs.
    """
    # Encodings per row: a frozen encoder reads s_t; SND-V's reads both views of every eighth row
    # too; the other encoders are trained on s_t and s_t+1.
    encodings = {"none": 1.0, "contrastive": 1 + TRAINED / 4}
    shaping = objective_flops(of, size, shape, num_actions, rows)
    unpaired = signal == "prediction" and of in encodings
    if signal not in ("distillation", "prediction") or shaping is None or unpaired:
        return None
    inputs = num_actions if action_input else 0
    own, learned = make_encoder_and_predictor(OBJECTIVES[of], size, "elu", "asymmetric", inputs)
    d, encode, copy = size.features, encoder_flops(own, shape), encoder_flops(learned, shape)
    rewards, trained = encode + copy, copy
    if signal == "prediction":
        forward_model = mlp_flops(d + num_actions, d, d, d)
        rewards, trained = 2 * encode + forward_model, forward_model
    trained += shaping
    return rewards + encodings.get(of, 2.0 * TRAINED) * encode + TRAINED * trained


def flops_per_step(
    of: str | None,
    signal: str,
    size: Architecture,
    shape: tuple[int, ...],
    stack: int,
    num_actions: int,
    epochs: int = 4,
    rows: int = 512,
    action_input: bool = False,
) -> float | None:
    """Return the operations per environment step.

    Args:
      of: the name of the objective; None for the baseline without a module.
      signal: the name of the signal.
      size: the sizes of the networks.
      shape: the shape of a frame.
      stack: the number of frames in a stack.
      num_actions: A, the number of actions.
      epochs: the number of PPO epochs.
      rows: the number of rows of a minibatch.
      action_input: whether the networks take the action as input.

    Returns:
      The operations; None where `intrinsic_flops` returns None.

    >>> from sndjax import ATARI
    >>> f"{flops_per_step('vicreg', 'distillation', ATARI, (96, 96, 1), 4, 18) / 1e9:.2f}"
    '1.83'
    """
    stacked = (*shape[:-1], shape[-1] * stack)
    acting = policy_flops(size, stacked, num_actions, 1 if of is None else 2)
    learning = acting * (1 + TRAINED * epochs)
    if of is None:
        return learning
    more = intrinsic_flops(of, signal, size, shape, num_actions, rows, action_input)
    return None if more is None else learning + more
