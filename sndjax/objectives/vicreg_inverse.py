"""VICReg with inverse dynamics: the objective of SND-VINV (eq. 5.9)."""

from sndjax.objectives.inverse_dynamics import inverse_dynamics
from sndjax.objectives.vicreg import vicreg
from sndjax.types import Objective
from sndjax.weighted_sum import weighted_sum


def vicreg_inverse(iota: float = 1 / 2) -> Objective:
    """VICReg (5.7) plus iota times the inverse model's cross-entropy (5.8): eq. 5.9.

    The inverse model is 2d -> d -> d/2 -> A. See `vicreg_loss` and `inverse_dynamics_loss`.

    >>> vicreg_inverse()  # doctest: +ELLIPSIS
    Objective(init=...)
    """
    return weighted_sum((1, vicreg()), (iota, inverse_dynamics(last=1 / 2)))
