"""VICReg with inverse dynamics: the objective of SND-VINV (eq. 5.9)."""

from sndjax.objectives.inverse_dynamics import inverse_dynamics
from sndjax.objectives.vicreg import vicreg
from sndjax.protocols import Objective
from sndjax.weighted_sum import weighted_sum


def vicreg_inverse(iota: float = 1 / 2) -> Objective:
    """Add to VICReg (5.7) iota times the inverse model's cross-entropy (5.8): eq. 5.9.

    The inverse model is 2d -> d -> d/2 -> A. See `vicreg_loss` and `inverse_dynamics_loss`.

    >>> vicreg_inverse()
    vicreg_inverse(iota=0.5)
    """
    both = weighted_sum((1, vicreg()), (iota, inverse_dynamics(last=1 / 2)))
    return both._replace(name="vicreg_inverse", settings={"iota": iota})
