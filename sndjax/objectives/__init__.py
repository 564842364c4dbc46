"""Objectives: what shapes an encoder. Each file has one constructor, of its own name.

An objective knows nothing of signals, agents or training steps.
"""

from sndjax.objectives.barlow_twins import barlow_twins as barlow_twins
from sndjax.objectives.byol import byol as byol
from sndjax.objectives.contrastive import contrastive as contrastive
from sndjax.objectives.inverse_dynamics import inverse_dynamics as inverse_dynamics
from sndjax.objectives.st_dim import st_dim as st_dim
from sndjax.objectives.vicreg import vicreg as vicreg
from sndjax.objectives.vicreg_inverse import vicreg_inverse as vicreg_inverse
