"""A page of pictures and tables: one HTML file with everything in it, for `file://` and phones."""

import base64
import csv
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from ..storage.run_directory import write_atomically


@dataclass
class Table:
    """A head and its rows; cells are text. With a name it is written as a CSV file too."""

    head: Sequence[str]
    rows: Sequence[Sequence[Any]]
    caption: str = ""
    name: str = ""


@dataclass
class Section:
    """A title with text, pictures (a PNG and its caption) and tables."""

    title: str
    text: str = ""
    pictures: list[tuple[Path, str]] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)


def inline_png(picture: Path) -> str:
    """A PNG as part of a page."""
    return "data:image/png;base64," + base64.b64encode(picture.read_bytes()).decode()


def write_csv(path: Path, head: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Write a table as a CSV file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", errors="replace") as file:
        csv.writer(file, lineterminator="\n").writerows([head, *rows])


def write_page(
    path: Path, title: str, lead: str, sections: list[Section], refresh: int = 0
) -> None:
    """Write a page, and the CSV file of each table that has a name beside it.

    Args:
      path: of the HTML file.
      title, lead: what stands at its head.
      sections: what follows.
      refresh: seconds after which a browser loads it again; 0: never.
    """
    loader = Environment(
        loader=FileSystemLoader(Path(__file__).parents[1] / "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    for section in sections:
        for table in section.tables:
            if table.name:
                write_csv(path.parent / f"{table.name}.csv", table.head, table.rows)
    text = loader.get_template("page.html").render(
        title=title, lead=lead, sections=sections, inline=inline_png, refresh=refresh
    )
    write_atomically(path, text)
