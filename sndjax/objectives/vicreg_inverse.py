"""VICReg with inverse dynamics: the objective of SND-VINV (eq. 5.9)."""

from sndjax.objectives.inverse_dynamics import inverse_dynamics
from sndjax.objectives.vicreg import vicreg
from sndjax.protocols import Objective
from sndjax.ranges import Weight
from sndjax.weighted_sum import weighted_sum


def vicreg_inverse(
    inverse_weight: Weight = 1 / 2,
    invariance_weight: Weight = 1.0,
    variance_weight: Weight = 1.0,
    covariance_weight: Weight = 1 / 25,
) -> Objective:
    """Add to VICReg (5.7) iota times the inverse model's cross-entropy (5.8): eq. 5.9.

    The inverse model is 2d -> d -> d/2 -> A. See `vicreg_loss` and `inverse_dynamics_loss`.

    Args:
      inverse_weight: iota, the weight of the inverse model's loss.
      invariance_weight: lambda, see `vicreg`.
      variance_weight: mu, see `vicreg`.
      covariance_weight: nu, see `vicreg`.

    >>> vicreg_inverse().settings["inverse_weight"]
    0.5
    """
    regularised = vicreg(invariance_weight, variance_weight, covariance_weight)
    both = weighted_sum((1, regularised), (inverse_weight, inverse_dynamics(last=1 / 2)))
    settings = {"inverse_weight": inverse_weight, **regularised.settings}
    return both._replace(name="vicreg_inverse", settings=settings)
