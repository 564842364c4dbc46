"""Pictures of feature spaces: Fig. 5.7 to 5.10 of the thesis."""

from pathlib import Path

import numpy as np

from ..reporting.plot_style import display_name, line_style, make_panels, plt, save_figure
from ..system.display import ProgressBars
from . import feature_geometry as geometry

SHOWN = 1000  # states of the distance matrices and of t-SNE

Spaces = dict[str, np.ndarray]  # features float[M, d] by the name of their run


def evenly_spaced(x: np.ndarray) -> np.ndarray:
    """Return `SHOWN` of the states, evenly spaced."""
    return x if len(x) <= SHOWN else x[np.linspace(0, len(x) - 1, SHOWN).astype(int)]


def plot_distances(frames: np.ndarray, spaces: Spaces, out: Path) -> Path:
    """Draw Fig. 5.7: pairwise distances of states and of features, each with its own scale.

    Args:
      frames: [M, *frame], the states.
      spaces: the features by run.
      out: the directory of the picture.

    Returns:
      The path of the picture.
    """
    shown = {"states": frames} | spaces
    columns = min(3, len(shown))
    rows = -(-len(shown) // columns)
    figure, axes = make_panels(rows, columns, 3.4 * columns, 3.2 * rows)
    for one in axes.flat[len(shown) :]:
        one.axis("off")
    for one, (name, x) in zip(axes.flat, shown.items(), strict=False):
        x = evenly_spaced(x)
        found = geometry.pairwise_distances(x / 255 if x.dtype == np.uint8 else x)
        image = one.imshow(found, cmap="coolwarm", interpolation="nearest")
        one.set_title(display_name(name))
        one.set_xlabel("state, in order")
        figure.colorbar(image, ax=one, shrink=0.8, label="L2 distance")
    return save_figure(figure, out, "distances")


def plot_tsne(
    spaces: Spaces, room: np.ndarray | None, seed: int, out: Path, bars: ProgressBars
) -> Path:
    """Draw Fig. 5.8: t-SNE of the features, coloured by room, or by order without rooms.

    Args:
      spaces: the features by run.
      room: int[M], the room of each state; None without rooms.
      seed: the seed of t-SNE.
      out: the directory of the picture.
      bars: the progress display.

    Returns:
      The path of the picture.
    """
    from sklearn.manifold import TSNE

    columns = min(3, len(spaces))
    rows = -(-len(spaces) // columns)
    figure, axes = make_panels(rows, columns, 3.4 * columns, 3.2 * rows)
    for one in axes.flat:
        one.axis("off")
    for i, name in enumerate(bars.track("t-SNE", list(spaces))):
        one, z = axes.flat[i], evenly_spaced(spaces[name])
        perplexity = min(30, (len(z) - 1) // 3)
        points = TSNE(random_state=seed, perplexity=perplexity, init="pca").fit_transform(z)
        if room is None:
            dots = one.scatter(*points.T, c=np.arange(len(z)), s=5, cmap="viridis")
            if i == 0:
                figure.colorbar(dots, ax=one, label="state, in order")
        else:
            for k, number in enumerate(np.unique(evenly_spaced(room))):
                own = evenly_spaced(room) == number
                colour = plt.get_cmap("tab20")(k % 20)
                one.scatter(*points[own].T, s=5, color=colour, label=f"room {number}")
            if i == 0:
                figure.legend(loc="outside right center", fontsize=8, markerscale=2, frameon=False)
        one.set_title(display_name(name))
    return save_figure(figure, out, "tsne")


def plot_eigenvalues(spaces: Spaces, algos: dict[str, str], out: Path) -> Path:
    """Draw Fig. 5.9 and 5.10: the eigenvalues in descending order, on a logarithmic axis.

    Args:
      spaces: the features by run.
      algos: the algorithm of each run, for its line style.
      out: the directory of the picture.

    Returns:
      The path of the picture.
    """
    figure, ((axes,),) = make_panels(1, 1)
    for name, z in spaces.items():
        spectrum = geometry.eigenvalues(z[: geometry.COMPARED])
        shown = np.maximum(spectrum, 1e-12 * spectrum[0])
        axes.plot(shown, label=display_name(name), linewidth=1.8, **line_style(algos[name]))
    axes.set_yscale("log")
    axes.set_xlabel("index, in descending order")
    axes.set_ylabel(f"eigenvalue ({min(geometry.COMPARED, len(z)):,} states)")
    axes.legend(frameon=False)
    return save_figure(figure, out, "eigenvalues")
