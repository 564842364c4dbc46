"""Signals: what is read off an encoder. Each file has one constructor, of its own name.

A signal knows nothing of objectives, agents or training steps. Its constructor takes a `predictor`
network if it distils the encoder; the grid and the
configuration read that from its parameters.
"""

from sndjax.signals.disagreement import disagreement as disagreement
from sndjax.signals.distillation import distillation as distillation
from sndjax.signals.e3b import e3b as e3b
from sndjax.signals.ngu import ngu as ngu
from sndjax.signals.noveld import noveld as noveld
from sndjax.signals.prediction import prediction as prediction
from sndjax.signals.re3 import re3 as re3
from sndjax.signals.simhash import simhash as simhash
