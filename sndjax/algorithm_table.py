"""The named algorithms as data: one objective, one signal and the published options each.

This is the one table. `sndjax.algorithms` makes its functions from it; the laboratory makes its
configurations and its help from it, and reads it without importing jax: this file imports nothing
but types.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple


class Algorithm(NamedTuple):
    """One row of the table.

    Attributes:
      objective: a file of `sndjax/objectives/`, or "none": the encoder stays random. None: the
        algorithm has no intrinsic module.
      signal: a file of `sndjax/signals/`.
      summary: what it is, in a few words.
      source: where the thesis (or the article) defines it.
      options: further arguments of `sndjax.make_module`.
      objective_options: arguments of the objective's constructor.
      signal_options: arguments of the signal's constructor.
    """

    objective: str | None
    signal: str | None
    summary: str
    source: str
    options: Mapping[str, Any] = {}
    objective_options: Mapping[str, Any] = {}
    signal_options: Mapping[str, Any] = {}


# How the published experiments of an objective reduce the distillation of its encoder: arguments
# of the signals that have a predictor.
DISTILLATION: dict[str, Mapping[str, Any]] = {
    "none": {"reward_reduction": "half_sum", "update_proportion": 0.25},  # Burda et al., 2018
    "contrastive": {"update_proportion": 0.25},
    "st_dim": {"loss_reduction": "sum"},
}

ALGORITHMS: dict[str, Algorithm] = {
    "ppo": Algorithm(
        None, None, "the baseline: external reward only, one value head", "section 2.4.5"
    ),
    "rnd": Algorithm(
        "none",
        "distillation",
        "random network distillation (Burda et al., 2018)",
        "section 4.1.2",
        options={"preprocess": "mean"},
    ),
    "qrnd": Algorithm(
        "none",
        "distillation",
        "RND of state and action (chapter 6)",
        "chapter 6",
        options={"preprocess": "mean", "action_input": True},
    ),
    "snd_v": Algorithm(
        "contrastive",
        "distillation",
        "SND, encoder trained on contrastive pairs",
        "arXiv 2302.11563",
    ),
    "snd_std": Algorithm(
        "st_dim",
        "distillation",
        "SND, encoder trained by ST-DIM, regularised (eq. 5.6)",
        "section 5.1.1, eq. 5.6",
    ),
    "snd_vic": Algorithm(
        "vicreg",
        "distillation",
        "SND, encoder trained by VICReg (eq. 5.7)",
        "section 5.1.2, eq. 5.7",
    ),
    "snd_vinv": Algorithm(
        "vicreg_inverse",
        "distillation",
        "SND, encoder trained by VICReg and inverse dynamics (eq. 5.9)",
        "section 5.1.3, eq. 5.9",
    ),
    "snd_barlow": Algorithm(
        "barlow_twins",
        "distillation",
        "SND, encoder trained by Barlow Twins (eq. 3.11)",
        "section 3.2.2, eq. 3.11",
    ),
    "snd_byol": Algorithm(
        "byol",
        "distillation",
        "SND, encoder trained by BYOL (eq. 3.10)",
        "section 3.2.1, eq. 3.10",
    ),
    "icm": Algorithm(
        "inverse_dynamics",
        "prediction",
        "intrinsic curiosity module (Pathak et al., 2017)",
        "section 4.1.1",
        options={"weights": (0.8, 0.2)},
        signal_options={"gradient": "detached"},
    ),
    "sp": Algorithm(
        "st_dim",
        "prediction",
        "self-supervised predictor on ST-DIM (eq. 5.12)",
        "section 5.1.4, eq. 5.12",
        objective_options={"spread_weight": 0.0},
    ),
    "sp_vic": Algorithm(
        "vicreg", "prediction", "self-supervised predictor on VICReg (chapter 6)", "chapter 6"
    ),
    "sp_vinv": Algorithm(
        "vicreg_inverse",
        "prediction",
        "self-supervised predictor on VICReg and inverse dynamics (chapter 6)",
        "chapter 6",
    ),
}
