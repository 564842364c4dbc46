"""The eigenvalues of features, the measure of their geometry in section 5.4 of the thesis."""

import numpy as np

PERCENTILES = (25, 50, 75, 95)
COMPARED = 1000  # states, a fixed number, because squared singular values grow with it


def eigenvalues(z: np.ndarray) -> np.ndarray:
    """Return the squared singular values of the centered features in float64, the largest first.

    Args:
      z: the features of M states, float[M, d].

    >>> eigenvalues(np.array([[1.0, 0.0], [-1.0, 0.0]])).round(6).tolist()
    [2.0, 0.0]
    """
    centred = np.asarray(z, np.float64) - np.mean(z, axis=0, dtype=np.float64)
    return np.linalg.svd(centred, compute_uv=False) ** 2
