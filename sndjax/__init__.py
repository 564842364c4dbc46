"""sndjax: intrinsic motivation in JAX as pure functions, objectives x novelty signals.

A module is four pure functions: `init`, `reward`, `loss` and `update`; see `IntrinsicModule`.

>>> import jax, jax.numpy as jnp
>>> import sndjax
>>> module = sndjax.snd_vic(num_actions=3, size=sndjax.VECTOR)
>>> params, state = module.init(jax.random.key(0), jnp.zeros((1, 2)))
"""

from sndjax.acting import Actor, ActorMemory, ActOutput, AgentSpec, act
from sndjax.actor_critic import ActorCritic
from sndjax.algorithm_table import ALGORITHMS
from sndjax.algorithms import (
    icm,
    make_named,
    qrnd,
    rnd,
    snd_barlow,
    snd_byol,
    snd_std,
    snd_v,
    snd_vic,
    snd_vinv,
    sp,
    sp_vic,
    sp_vinv,
)
from sndjax.architectures import ATARI, PROCGEN, SMALL, VECTOR, Architecture, size_for
from sndjax.autoreset import from_autoreset
from sndjax.bonus_record import Bonus, BonusSettings, BonusState
from sndjax.checks import check_rollout
from sndjax.collecting import (
    LiveEnvironments,
    collect,
    init_environments,
    step_environments,
)
from sndjax.grid import ObjectiveRecipe, make_module
from sndjax.guard import all_finite, skip_nonfinite
from sndjax.intrinsic_module import IntrinsicModule
from sndjax.intrinsic_training import IntrinsicConfig
from sndjax.jax_environment import JaxEnvironment
from sndjax.module import make_intrinsic_module
from sndjax.networks import MLP, Encoder
from sndjax.objectives.barlow_twins import barlow_twins, barlow_twins_loss
from sndjax.objectives.byol import byol, byol_distance
from sndjax.objectives.contrastive import contrastive, contrastive_loss
from sndjax.objectives.inverse_dynamics import inverse_dynamics, inverse_dynamics_loss
from sndjax.objectives.st_dim import st_dim, st_dim_loss
from sndjax.objectives.vicreg import vicreg, vicreg_loss
from sndjax.objectives.vicreg_inverse import vicreg_inverse
from sndjax.own_loop import bonus
from sndjax.ppo import Hyperparameters, clipped_surrogate
from sndjax.protocols import Encode, EncoderView, Objective, Signal, TargetNetwork
from sndjax.returns import generalized_advantage
from sndjax.rollout import FrameStack, gather_transitions, slice_transitions
from sndjax.scaling import scale_reward
from sndjax.signals.disagreement import disagreement, ensemble_variance
from sndjax.signals.distillation import distillation, distillation_error, distillation_loss
from sndjax.signals.e3b import e3b, elliptical_bonus
from sndjax.signals.ngu import ngu
from sndjax.signals.noveld import noveld, noveld_reward
from sndjax.signals.prediction import prediction, prediction_error, prediction_loss
from sndjax.signals.re3 import neighbour_distance, re3
from sndjax.signals.simhash import simhash
from sndjax.statistics import masked_mean
from sndjax.train import init_train_state, make_train_step
from sndjax.types import (
    Experience,
    Features,
    Loss,
    ModuleParams,
    ModuleState,
    Params,
    ReturnStatistics,
    Rollout,
    RunningStatistics,
    State,
    TrainState,
    Transition,
)
from sndjax.version import __version__
from sndjax.visits import Visits
from sndjax.weighted_sum import weighted_sum

__all__ = [
    "ALGORITHMS",
    "ATARI",
    "MLP",
    "PROCGEN",
    "SMALL",
    "VECTOR",
    "ActOutput",
    "Actor",
    "ActorCritic",
    "ActorMemory",
    "AgentSpec",
    "Architecture",
    "Bonus",
    "BonusSettings",
    "BonusState",
    "Encode",
    "Encoder",
    "EncoderView",
    "Experience",
    "Features",
    "FrameStack",
    "Hyperparameters",
    "IntrinsicConfig",
    "IntrinsicModule",
    "JaxEnvironment",
    "LiveEnvironments",
    "Loss",
    "ModuleParams",
    "ModuleState",
    "Objective",
    "ObjectiveRecipe",
    "Params",
    "ReturnStatistics",
    "Rollout",
    "RunningStatistics",
    "Signal",
    "State",
    "TargetNetwork",
    "TrainState",
    "Transition",
    "Visits",
    "__version__",
    "act",
    "all_finite",
    "barlow_twins",
    "barlow_twins_loss",
    "bonus",
    "byol",
    "byol_distance",
    "check_rollout",
    "clipped_surrogate",
    "collect",
    "contrastive",
    "contrastive_loss",
    "disagreement",
    "distillation",
    "distillation_error",
    "distillation_loss",
    "e3b",
    "elliptical_bonus",
    "ensemble_variance",
    "from_autoreset",
    "gather_transitions",
    "generalized_advantage",
    "icm",
    "init_environments",
    "init_train_state",
    "inverse_dynamics",
    "inverse_dynamics_loss",
    "make_intrinsic_module",
    "make_module",
    "make_named",
    "make_train_step",
    "masked_mean",
    "neighbour_distance",
    "ngu",
    "noveld",
    "noveld_reward",
    "prediction",
    "prediction_error",
    "prediction_loss",
    "qrnd",
    "re3",
    "rnd",
    "scale_reward",
    "simhash",
    "size_for",
    "skip_nonfinite",
    "slice_transitions",
    "snd_barlow",
    "snd_byol",
    "snd_std",
    "snd_v",
    "snd_vic",
    "snd_vinv",
    "sp",
    "sp_vic",
    "sp_vinv",
    "st_dim",
    "st_dim_loss",
    "step_environments",
    "vicreg",
    "vicreg_inverse",
    "vicreg_loss",
    "weighted_sum",
]
