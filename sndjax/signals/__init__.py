"""Signals: the novelty that is read off an encoder. Each file has one, of its own name."""

from sndjax.signals.disagreement import disagreement as disagreement
from sndjax.signals.distillation import distillation as distillation
from sndjax.signals.e3b import e3b as e3b
from sndjax.signals.ngu import ngu as ngu
from sndjax.signals.noveld import noveld as noveld
from sndjax.signals.prediction import prediction as prediction
from sndjax.signals.re3 import re3 as re3
from sndjax.signals.simhash import simhash as simhash
