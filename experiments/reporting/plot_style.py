"""How every picture looks; an algorithm has one colour everywhere."""

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

# Okabe and Ito's palette, its yellow darkened to be seen on white. A second algorithm of the
# same colour is dashed.
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
    """The line of an algorithm; one of the reader's own gets a dotted one from its name."""
    if algo in STYLES:
        return {"linestyle": "-"} | STYLES[algo]
    return {"color": OTHERS[sum(map(ord, algo)) % len(OTHERS)], "linestyle": ":"}


def display_name(algo: str) -> str:
    """What the thesis calls it.

    >>> display_name("snd_vic"), display_name("my_bonus")
    ('SND-VIC', 'my_bonus')
    """
    if algo in LABELS:
        return LABELS[algo]
    return algo.upper().replace("_", "-") if algo in STYLES else algo


def display_title(algo: str, name: str) -> str:
    """A group's name with its algorithm's label.

    >>> display_title("rnd", "rnd (eta=2)")
    'RND (eta=2)'
    """
    return name.replace(algo, display_name(algo), 1)


def make_panels(
    rows: int, columns: int, width: float = 7.2, height: float = 4.2, **options: Any
) -> tuple[Figure, Any]:
    """A figure with a grid of axes, [rows, columns], nothing at their top and right."""
    figure, axes = plt.subplots(
        rows, columns, figsize=(width, height), layout="constrained", squeeze=False, **options
    )
    for one in axes.flat:
        one.spines[["top", "right"]].set_visible(False)
    return figure, axes


def label_steps_axis(axes: Any) -> None:
    """Steps on the horizontal axis, in millions."""
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x / 1e6:g}"))
    axes.set_xlabel("agent steps per seed, millions")
    axes.set_xlim(left=0)


def save_figure(figure: Figure, out: Path, name: str, vector: bool = True) -> Path:
    """Write PNG and, unless told otherwise, SVG; the path of the PNG."""
    out.mkdir(parents=True, exist_ok=True)
    if vector:
        figure.savefig(out / f"{name}.svg")
    figure.savefig(out / f"{name}.png", dpi=150)
    plt.close(figure)
    return out / f"{name}.png"
