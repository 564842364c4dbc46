"""What a search over settings has found: its trials in order, and a picture of two of the keys."""

from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser

from experiments import cells


def trials(directory: Path, keys: tuple[str, ...], figure: str) -> list[tuple[float, list[float]]]:
    """The figure of every finished trial with its values, the best first."""
    found = []
    for cell, _ in cells.known(directory):
        steps, value = cells.figure(directory / cell.name, figure)
        if steps >= cell.total and value is not None:
            parsed = OverridesParser.create().parse_overrides(cell.overrides)
            values: Any = {override.get_key_element(): override.value() for override in parsed}
            found.append((value, [values[key] for key in keys]))
    return sorted(found, key=lambda trial: -trial[0])


def search_report(directory: Path, keys: tuple[str, ...], figure: str) -> str:
    """The trials as lines; also as search.csv and, of two numbers, as a picture, in report/."""
    found = trials(directory, keys, figure)
    out = directory / "report"
    out.mkdir(exist_ok=True)
    rows = [[f"{value:.4g}", *(f"{v:.4g}" for v in values)] for value, values in found]
    lines = [",".join([figure, *keys]), *(",".join(row) for row in rows)]
    (out / "search.csv").write_text("\n".join(lines) + "\n")
    if len(keys) == 2 and found:
        picture(found, keys, figure, out)
    widths = [
        max(len(cell) for cell in column) for column in zip([figure, *keys], *rows, strict=True)
    ]
    shown = ["  ".join(f"{c:>{w}}" for c, w in zip(row, widths, strict=True)) for row in rows]
    head = "  ".join(f"{c:>{w}}" for c, w in zip([figure, *keys], widths, strict=True))
    return "\n".join([head, *shown, f"in {out}"])


def picture(
    found: list[tuple[float, list[float]]], keys: tuple[str, ...], figure: str, out: Path
) -> None:
    """Where the trials lie, the better the darker."""
    from experiments.style import panels, save

    drawn, grid = panels(1, 1)
    axes = grid[0, 0]
    at = lambda k: [values[k] for _, values in found]
    points = axes.scatter(at(0), at(1), c=[value for value, _ in found], cmap="viridis_r", s=60)
    axes.set(xscale="log", yscale="log", xlabel=keys[0], ylabel=keys[1])
    axes.set_title(f"{len(found)} trials, the best {found[0][0]:.3g}")
    drawn.colorbar(points, label=figure)
    save(drawn, out, "search")
