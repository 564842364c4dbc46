"""sndjax: intrinsic motivation in JAX as pure functions, objectives x novelty signals.

>>> import jax, jax.numpy as jnp
>>> import sndjax
>>> module = sndjax.snd_vic(num_actions=3, size=sndjax.VECTOR)
>>> params, state = module.init(jax.random.key(0), jnp.zeros((1, 2)))
"""

from sndjax.algorithms import rnd, snd_std, snd_vic
from sndjax.networks import ATARI, PROCGEN, VECTOR, ActorCritic, Architecture, Encoder
from sndjax.objectives.st_dim import st_dim, st_dim_loss
from sndjax.objectives.vicreg import vicreg, vicreg_loss
from sndjax.ppo import Hyperparameters, clipped_surrogate
from sndjax.returns import generalized_advantage
from sndjax.rollout import Stack, transitions
from sndjax.scaling import scale_reward
from sndjax.signals.distillation import distillation, distillation_error, distillation_loss
from sndjax.train import Actor, Agent, Decision, Motivation, act, init, make_train_step
from sndjax.types import (
    Experience,
    Features,
    IntrinsicModule,
    Moments,
    Objective,
    ReturnScale,
    Rollout,
    TrainState,
    Transition,
)
from sndjax.version import __version__

__all__ = [
    "ATARI",
    "PROCGEN",
    "VECTOR",
    "Actor",
    "ActorCritic",
    "Agent",
    "Architecture",
    "Decision",
    "Encoder",
    "Experience",
    "Features",
    "Hyperparameters",
    "IntrinsicModule",
    "Moments",
    "Motivation",
    "Objective",
    "ReturnScale",
    "Rollout",
    "Stack",
    "TrainState",
    "Transition",
    "__version__",
    "act",
    "clipped_surrogate",
    "distillation",
    "distillation_error",
    "distillation_loss",
    "generalized_advantage",
    "init",
    "make_train_step",
    "rnd",
    "scale_reward",
    "snd_std",
    "snd_vic",
    "st_dim",
    "st_dim_loss",
    "transitions",
    "vicreg",
    "vicreg_loss",
]
