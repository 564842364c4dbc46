"""The named algorithms as functions: every method of the thesis is one cell, objective x signal.

What each is made of stands in `sndjax.algorithm_table`. Each takes the number of actions and an
`Architecture`, returns an `IntrinsicModule`, and passes further options on to
`sndjax.make_module`: `preprocess`, `activation`, `objective_options`, `signal_options`, and
`pairing` for those with a predictor.
"""

from collections.abc import Callable
from typing import Any

from sndjax.algorithm_table import ALGORITHMS
from sndjax.architectures import ATARI, Architecture
from sndjax.grid import make_module
from sndjax.intrinsic_module import IntrinsicModule


def make_named(
    name: str, num_actions: int, size: Architecture = ATARI, **options: Any
) -> IntrinsicModule:
    """Make the module of a named algorithm.

    Args:
      name: a name in `ALGORITHMS` that has an intrinsic module.
      num_actions: A.
      size: the sizes of the networks.
      **options: over those of the table.

    Raises:
      ValueError: there is no such algorithm, or it has no module; those that have are named.

    >>> make_named("snd_vic", 18).has_published_scale
    True
    """
    row = ALGORITHMS.get(name)
    if row is None or row.objective is None or row.signal is None:
        known = ", ".join(name for name, make in NAMED.items() if make)
        raise ValueError(
            f"no intrinsic module is called '{name}'; there is {known}; in a bonus also "
            "objective+signal, such as none+noveld"
        )
    return make_module(
        row.objective,
        row.signal,
        num_actions,
        size,
        **{
            **row.options,
            **options,
            "objective_options": {**row.objective_options, **options.get("objective_options", {})},
            "signal_options": {**row.signal_options, **options.get("signal_options", {})},
        },
    )


def rnd(num_actions: int, size: Architecture = ATARI, **options: Any) -> IntrinsicModule:
    """Make random network distillation (section 4.1.2; Burda et al., 2018).

    Its frames go through `preprocess="mean"`. The published networks are ELU throughout, so that
    `activation="published"` is "elu".

    Args:
      num_actions: A.
      size: the sizes of the networks.
      **options: see the module's docstring.

    >>> import jax, jax.numpy as jnp
    >>> params, state = rnd(18).init(jax.random.key(0), jnp.zeros((1, 96, 96, 1), jnp.uint8))
    >>> params.encoder is None
    True
    """
    return make_named("rnd", num_actions, size, **options)


def qrnd(num_actions: int, size: Architecture = ATARI, **options: Any) -> IntrinsicModule:
    """Make RND of state and action: the action, one-hot, joins the flattened features (ch. 6).

    Args:
      num_actions: A.
      size: the sizes of the networks.
      **options: see the module's docstring.
    """
    return make_named("qrnd", num_actions, size, **options)


def snd_v(num_actions: int, size: Architecture = ATARI, **options: Any) -> IntrinsicModule:
    """Make SND with contrastive pairs of augmented states (article arXiv 2302.11563).

    Args:
      num_actions: A.
      size: the sizes of the networks.
      **options: see the module's docstring.
    """
    return make_named("snd_v", num_actions, size, **options)


def snd_std(num_actions: int, size: Architecture = ATARI, **options: Any) -> IntrinsicModule:
    """Make SND with ST-DIM, its logit norm and feature std regularised (5.1.1, eq. 5.6).

    Args:
      num_actions: A.
      size: the sizes of the networks.
      **options: see the module's docstring.
    """
    return make_named("snd_std", num_actions, size, **options)


def snd_vic(num_actions: int, size: Architecture = ATARI, **options: Any) -> IntrinsicModule:
    """Make SND with VICReg on consecutive states (section 5.1.2, eq. 5.7).

    Args:
      num_actions: A.
      size: the sizes of the networks.
      **options: see the module's docstring.

    >>> import jax, jax.numpy as jnp
    >>> from sndjax import VECTOR
    >>> params, _ = snd_vic(3, VECTOR).init(jax.random.key(0), jnp.zeros((1, 2)))
    >>> params._fields
    ('encoder', 'objective', 'signal')
    """
    return make_named("snd_vic", num_actions, size, **options)


def snd_vinv(num_actions: int, size: Architecture = ATARI, **options: Any) -> IntrinsicModule:
    """Make SND with VICReg and inverse dynamics (section 5.1.3, eq. 5.9).

    Args:
      num_actions: A.
      size: the sizes of the networks.
      **options: see the module's docstring.
    """
    return make_named("snd_vinv", num_actions, size, **options)


def snd_barlow(num_actions: int, size: Architecture = ATARI, **options: Any) -> IntrinsicModule:
    """Make SND with Barlow Twins on consecutive states (section 3.2.2, eq. 3.11).

    Args:
      num_actions: A.
      size: the sizes of the networks.
      **options: see the module's docstring.
    """
    return make_named("snd_barlow", num_actions, size, **options)


def snd_byol(num_actions: int, size: Architecture = ATARI, **options: Any) -> IntrinsicModule:
    """Make SND with BYOL on consecutive states (section 3.2.1, eq. 3.9, 3.10).

    Args:
      num_actions: A.
      size: the sizes of the networks.
      **options: see the module's docstring.
    """
    return make_named("snd_byol", num_actions, size, **options)


def icm(num_actions: int, size: Architecture = ATARI, **options: Any) -> IntrinsicModule:
    """Make the intrinsic curiosity module: 0.8 inverse + 0.2 forward (4.1.1; Pathak et al., 2017).

    No gradient of the forward loss reaches z_t+1: the signal's `gradient` is "detached".

    Args:
      num_actions: A.
      size: the sizes of the networks.
      **options: see the module's docstring.
    """
    return make_named("icm", num_actions, size, **options)


def sp(num_actions: int, size: Architecture = ATARI, **options: Any) -> IntrinsicModule:
    """Make the self-supervised predictor on ST-DIM (section 5.1.4, eq. 5.10-5.12).

    ST-DIM with its norm term and no std term, as the published runs.

    Args:
      num_actions: A.
      size: the sizes of the networks.
      **options: see the module's docstring.
    """
    return make_named("sp", num_actions, size, **options)


def sp_vic(num_actions: int, size: Architecture = ATARI, **options: Any) -> IntrinsicModule:
    """Make the self-supervised predictor on VICReg, named in chapter 6 as never tried.

    Args:
      num_actions: A.
      size: the sizes of the networks.
      **options: see the module's docstring.
    """
    return make_named("sp_vic", num_actions, size, **options)


def sp_vinv(num_actions: int, size: Architecture = ATARI, **options: Any) -> IntrinsicModule:
    """Make the self-supervised predictor on VICReg with inverse dynamics, named in chapter 6.

    Args:
      num_actions: A.
      size: the sizes of the networks.
      **options: see the module's docstring.
    """
    return make_named("sp_vinv", num_actions, size, **options)


NAMED: dict[str, Callable[..., IntrinsicModule] | None] = {
    "ppo": None,  # the baseline has no module
    "rnd": rnd,
    "qrnd": qrnd,
    "snd_v": snd_v,
    "snd_std": snd_std,
    "snd_vic": snd_vic,
    "snd_vinv": snd_vinv,
    "snd_barlow": snd_barlow,
    "snd_byol": snd_byol,
    "icm": icm,
    "sp": sp,
    "sp_vic": sp_vic,
    "sp_vinv": sp_vinv,
}
