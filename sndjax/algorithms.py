"""The named algorithms: every method of the thesis is one cell, objective x signal.

| name          | objective of the encoder         | signal        | where                    |
|---------------|----------------------------------|---------------|--------------------------|
| `rnd`         | none, it stays as it was drawn   | distillation  | 4.1.2                    |
| `qrnd`        | none; the action is an input too | distillation  | ch. 6                    |
| `snd_v`       | contrastive pairs                | distillation  | arXiv 2302.11563         |
| `snd_std`     | ST-DIM, regularised              | distillation  | 5.1.1, eq. 5.6           |
| `snd_vic`     | VICReg                           | distillation  | 5.1.2, eq. 5.7           |
| `snd_vinv`    | VICReg + 1/2 inverse dynamics    | distillation  | 5.1.3, eq. 5.9           |
| `snd_barlow`  | Barlow Twins                     | distillation  | 3.2.2, eq. 3.11          |
| `snd_byol`    | BYOL                             | distillation  | 3.2.1, eq. 3.10          |
| `icm`         | inverse dynamics                 | prediction    | 4.1.1                    |
| `sp`          | ST-DIM, its norm regularised     | prediction    | 5.1.4, eq. 5.12          |
| `sp_vic`      | VICReg                           | prediction    | ch. 6                    |
| `sp_vinv`     | VICReg + 1/2 inverse dynamics    | prediction    | ch. 6                    |

Each takes the number of actions and an `Architecture`, gives an `IntrinsicModule`, and
passes the options of `sndjax.grid` on: `preprocess`, `activation`, `pairing` for those that
distil, `gradient` for those that predict.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

from sndjax.grid import OBJECTIVES, cell, grid
from sndjax.networks import ATARI, Architecture
from sndjax.objectives.st_dim import st_dim
from sndjax.types import IntrinsicModule


def rnd(num_actions: int, size: Architecture = ATARI, **options: Any) -> IntrinsicModule:
    """Random network distillation (section 4.1.2; Burda et al., 2018); `preprocess` is "mean".

    The published networks are ELU throughout, so that "published" is "elu".

    >>> import jax, jax.numpy as jnp
    >>> params, state = rnd(18).init(jax.random.key(0), jnp.zeros((1, 96, 96, 1), jnp.uint8))
    >>> sorted(params)
    ['signal']
    """
    return grid("none", "distillation", num_actions, size, **{"preprocess": "mean"} | options)


def qrnd(num_actions: int, size: Architecture = ATARI, **options: Any) -> IntrinsicModule:
    """RND of state and action: the action, one-hot, joins the flattened features (chapter 6).

    >>> qrnd(18)  # doctest: +ELLIPSIS
    IntrinsicModule(init=...)
    """
    options = {"preprocess": "mean"} | options
    recipe = OBJECTIVES["none"]
    return cell(recipe, "distillation", num_actions, size, action_input=True, **options)


def snd_v(num_actions: int, size: Architecture = ATARI, **options: Any) -> IntrinsicModule:
    """SND with contrastive pairs of augmented states (article arXiv 2302.11563).

    >>> snd_v(18)  # doctest: +ELLIPSIS
    IntrinsicModule(init=...)
    """
    return grid("contrastive", "distillation", num_actions, size, **options)


def snd_std(num_actions: int, size: Architecture = ATARI, **options: Any) -> IntrinsicModule:
    """SND with ST-DIM, logit-norm and feature-spread regularised (section 5.1.1, eq. 5.6).

    >>> snd_std(18)  # doctest: +ELLIPSIS
    IntrinsicModule(init=...)
    """
    return grid("st_dim", "distillation", num_actions, size, **options)


def snd_vic(num_actions: int, size: Architecture = ATARI, **options: Any) -> IntrinsicModule:
    """SND with VICReg on consecutive states (section 5.1.2, eq. 5.7).

    >>> import jax, jax.numpy as jnp
    >>> from sndjax import VECTOR
    >>> params, _ = snd_vic(3, VECTOR).init(jax.random.key(0), jnp.zeros((1, 2)))
    >>> sorted(params)
    ['encoder', 'objective', 'signal']
    """
    return grid("vicreg", "distillation", num_actions, size, **options)


def snd_vinv(num_actions: int, size: Architecture = ATARI, **options: Any) -> IntrinsicModule:
    """SND with VICReg and inverse dynamics (section 5.1.3, eq. 5.9).

    >>> snd_vinv(18)  # doctest: +ELLIPSIS
    IntrinsicModule(init=...)
    """
    return grid("vicreg_inverse", "distillation", num_actions, size, **options)


def snd_barlow(num_actions: int, size: Architecture = ATARI, **options: Any) -> IntrinsicModule:
    """SND with Barlow Twins on consecutive states (section 3.2.2, eq. 3.11).

    >>> snd_barlow(18)  # doctest: +ELLIPSIS
    IntrinsicModule(init=...)
    """
    return grid("barlow_twins", "distillation", num_actions, size, **options)


def snd_byol(num_actions: int, size: Architecture = ATARI, **options: Any) -> IntrinsicModule:
    """SND with BYOL on consecutive states (section 3.2.1, eq. 3.9, 3.10).

    >>> snd_byol(18)  # doctest: +ELLIPSIS
    IntrinsicModule(init=...)
    """
    return grid("byol", "distillation", num_actions, size, **options)


def icm(num_actions: int, size: Architecture = ATARI, **options: Any) -> IntrinsicModule:
    """The intrinsic curiosity module: 0.8 inverse + 0.2 forward (4.1.1; Pathak et al., 2017).

    The forward model's target is detached: `gradient` is "detached".

    >>> icm(18)  # doctest: +ELLIPSIS
    IntrinsicModule(init=...)
    """
    options = {"gradient": "detached", "weights": (0.8, 0.2)} | options
    return grid("inverse_dynamics", "prediction", num_actions, size, **options)


def sp(num_actions: int, size: Architecture = ATARI, **options: Any) -> IntrinsicModule:
    """The self-supervised predictor on ST-DIM (section 5.1.4, eq. 5.10-5.12).

    ST-DIM with its norm term and no spread term, as the published runs.

    >>> sp(18, gradient="asymmetric")  # doctest: +ELLIPSIS
    IntrinsicModule(init=...)
    """
    recipe = OBJECTIVES["st_dim"]._replace(objective=partial(st_dim, spread_weight=0.0))
    return cell(recipe, "prediction", num_actions, size, **options)


def sp_vic(num_actions: int, size: Architecture = ATARI, **options: Any) -> IntrinsicModule:
    """The self-supervised predictor on VICReg, named in chapter 6 as never tried.

    >>> sp_vic(18)  # doctest: +ELLIPSIS
    IntrinsicModule(init=...)
    """
    return grid("vicreg", "prediction", num_actions, size, **options)


def sp_vinv(num_actions: int, size: Architecture = ATARI, **options: Any) -> IntrinsicModule:
    """The self-supervised predictor on VICReg with inverse dynamics, named in chapter 6.

    >>> sp_vinv(18)  # doctest: +ELLIPSIS
    IntrinsicModule(init=...)
    """
    return grid("vicreg_inverse", "prediction", num_actions, size, **options)


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
