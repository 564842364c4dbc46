"""The style of all pictures: an algorithm has the same color and label everywhere."""

from collections.abc import Iterator, Sequence
from itertools import count, product
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

Look = tuple[str, str, str]  # the color, the line style and the marker of a series

# The palette of Okabe and Ito, with a darker yellow that is visible on white. A second algorithm
# of the same color is dashed.
STYLES: dict[str, dict[str, Any]] = {
    "ppo": {"color": "#000000"},
    "rnd": {"color": "#E69F00"},
    "snd_v": {"color": "#56B4E9"},
    "snd_std": {"color": "#0072B2"},
    "snd_vic": {"color": "#009E73"},
    "snd_vinv": {"color": "#D55E00"},
    "icm": {"color": "#CC79A7"},
    "sp": {"color": "#A69A00"},
    "qrnd": {"color": "#E69F00", "linestyle": "--"},
    "snd_barlow": {"color": "#56B4E9", "linestyle": "--"},
    "snd_byol": {"color": "#0072B2", "linestyle": "--"},
    "sp_vic": {"color": "#009E73", "linestyle": "--"},
    "sp_vinv": {"color": "#D55E00", "linestyle": "--"},
}
OTHERS = ("#7F7F7F", "#000000", "#E69F00", "#56B4E9", "#0072B2", "#009E73", "#D55E00", "#CC79A7")
LINES = ("-", "--", ":", "-.")
MARKERS = ("", "o", "s", "^", "D", "v", "P", "<", ">", "p", "h", "d", "8")
LABELS = {
    "ppo": "PPO",
    "rnd": "RND",
    "qrnd": "QRND",
    "icm": "ICM",
    "sp": "SP",
    "snd_barlow": "SND-Barlow",
    "snd_byol": "SND-BYOL",
}


def line_style(algo: str) -> dict[str, Any]:
    """Return the line style of an algorithm: matplotlib's `color` and `linestyle`.

    An algorithm that is not in `STYLES` gets a dotted line, in a color chosen by its name.
    """
    if algo in STYLES:
        return {"linestyle": "-"} | STYLES[algo]
    return {"color": OTHERS[sum(map(ord, algo)) % len(OTHERS)], "linestyle": ":"}


def line_styles(series: Sequence[tuple[str, str]]) -> dict[str, dict[str, Any]]:
    """Return a line style for each series of a figure; no two are the same.

    The first series of an algorithm has the style of the algorithm, `line_style`. Up to four series
    of one algorithm have its color where they can, and differ in their lines. More series differ in
    color, then in line, then in marker. No series has the style of another algorithm of `STYLES`.

    Args:
      series: the algorithm and the name of each series; a name that is the algorithm is its first.

    Returns:
      The style of each name: matplotlib's `color`, `linestyle` and `marker`.
    """
    ordered = sorted(dict.fromkeys(series), key=lambda one: one[0] != one[1])
    counts = {algo: sum(other == algo for other, _ in ordered) for algo, _ in ordered}
    first = dict(reversed(ordered))
    found: dict[str, dict[str, Any]] = {}
    used: set[Look] = set()
    for algo, name in sorted(ordered, key=lambda one: first[one[0]] != one[1]):
        others = {plain_look(other) for other in STYLES if other != algo}
        candidates = style_candidates(algo, same_color=counts[algo] <= len(LINES))
        look = next(look for look in candidates if look not in used | others)
        used.add(look)
        found[name] = dict(zip(("color", "linestyle", "marker"), look, strict=True))
    return found


def plain_look(algo: str) -> Look:
    """Return the color and the line style of an algorithm, and no marker."""
    own = line_style(algo)
    return own["color"], own["linestyle"], ""


def style_candidates(algo: str, same_color: bool) -> Iterator[Look]:
    """Yield colors, line styles and markers for the series of an algorithm, the best first.

    Args:
      algo: the algorithm; its style comes first.
      same_color: whether the line varies before the color; otherwise the color varies first.
    """
    yield plain_look(algo)
    own_color, own_line, _ = plain_look(algo)
    colors = list(dict.fromkeys([own_color, *OTHERS]))
    lines = list(dict.fromkeys([own_line, *LINES]))
    for marker in MARKERS:
        for a, b in product(*((colors, lines) if same_color else (lines, colors))):
            color, line = (a, b) if same_color else (b, a)
            yield color, line, marker
    for number in count(1):  # a number as the marker
        yield own_color, own_line, f"${number}$"


def display_name(algo: str) -> str:
    """Return the name of an algorithm as the thesis writes it.

    >>> display_name("snd_vic"), display_name("my_bonus")
    ('SND-VIC', 'my_bonus')
    """
    if algo in LABELS:
        return LABELS[algo]
    return algo.upper().replace("_", "-") if algo in STYLES else algo


def display_title(algo: str, name: str) -> str:
    """Return the name of a group of runs, with the display name of its algorithm.

    >>> display_title("rnd", "rnd (eta=2)")
    'RND (eta=2)'
    """
    return name.replace(algo, display_name(algo), 1)


def make_panels(
    rows: int, columns: int, width: float = 7.2, height: float = 4.2, **options: Any
) -> tuple[Figure, Any]:
    """Make a figure with a grid of axes that have no top and right border.

    Args:
      rows: number of rows of axes.
      columns: number of columns of axes.
      width: of the figure, inches.
      height: of the figure, inches.
      **options: passed to `plt.subplots`.

    Returns:
      The figure, and its axes [rows, columns].
    """
    figure, axes = plt.subplots(
        rows, columns, figsize=(width, height), layout="constrained", squeeze=False, **options
    )
    for one in axes.flat:
        one.spines[["top", "right"]].set_visible(False)
    return figure, axes


def label_steps_axis(axes: Any) -> None:
    """Label the horizontal axis with agent steps, in millions."""
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x / 1e6:g}"))
    axes.set_xlabel("agent steps per seed, millions")
    axes.set_xlim(left=0)


def save_figure(figure: Figure, out: Path, name: str, vector: bool = True) -> Path:
    """Write a figure as PNG and SVG, and close the figure.

    Args:
      figure: the figure.
      out: the directory of the files; it is created if missing.
      name: of the files, without suffix.
      vector: whether to write the SVG.

    Returns:
      The path of the PNG.
    """
    out.mkdir(parents=True, exist_ok=True)
    if vector:
        figure.savefig(out / f"{name}.svg")
    figure.savefig(out / f"{name}.png", dpi=150)
    plt.close(figure)
    return out / f"{name}.png"
