"""The geometry of a feature space, as measured in section 5.4. All in float64 NumPy."""

import numpy as np

from ..training.feature_spectrum import COMPARED, PERCENTILES, eigenvalues


def feature_rank(z: np.ndarray) -> int:
    """Return the rank of the features: the number of independent rows of R of a QR decomposition.

    Singular values below the rounding error of the features' dtype count as zero.

    >>> feature_rank(np.array([[1.0, 2.0], [2.0, 4.0], [3.0, 6.0]]))
    1
    """
    singular = np.linalg.svd(np.linalg.qr(np.asarray(z, np.float64), mode="r"), compute_uv=False)
    kind = z.dtype if np.issubdtype(z.dtype, np.floating) else np.dtype(np.float64)
    return int(np.sum(singular > singular[0] * max(z.shape) * np.finfo(kind).eps))


def pairwise_distances(x: np.ndarray) -> np.ndarray:
    """Compute pairwise L2 distances, float64[M, M].

    >>> pairwise_distances(np.array([[0.0, 0.0], [3.0, 4.0]])).tolist()
    [[0.0, 5.0], [5.0, 0.0]]
    """
    from scipy.spatial.distance import pdist, squareform

    return squareform(pdist(np.asarray(x, np.float64).reshape(len(x), -1)))


def geometry_figures(z: np.ndarray, follows: np.ndarray) -> dict[str, float]:
    """Compute a row of Tables 5.9 and 5.10.

    Args:
      z: float[M, d], the features of M states in order.
      follows: bool[M - 1], True where state m + 1 is the successor of state m.

    Returns:
      For the first `COMPARED` states: mean and standard deviation of ||z_t+1 - z_t|| and of ||z||,
      and percentiles of the eigenvalues. For all states: the rank, and the width d.
    """
    first = np.asarray(z[:COMPARED], np.float64)
    step = np.linalg.norm(np.diff(first, axis=0), axis=1)[follows[: len(first) - 1]]
    norm = np.linalg.norm(first, axis=1)
    spectrum = eigenvalues(first)
    return {
        "step_mean": float(step.mean()),
        "step_std": float(step.std()),
        "norm_mean": float(norm.mean()),
        "norm_std": float(norm.std()),
        **{f"q{p}": float(np.percentile(spectrum, p)) for p in PERCENTILES},
        "rank": feature_rank(z),
        "d": z.shape[1],
    }
