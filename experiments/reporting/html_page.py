"""Self-contained HTML pages of pictures and tables, for `file://` and phones."""

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
    """A table: a header and rows of text. A table with a name is also written as a CSV file."""

    head: Sequence[str]
    rows: Sequence[Sequence[Any]]
    caption: str = ""
    name: str = ""


@dataclass
class Section:
    """A section of a page: a title, text, pictures (a PNG and its caption) and tables."""

    title: str
    text: str = ""
    pictures: list[tuple[Path, str]] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)


def inline_png(picture: Path) -> str:
    """Return a PNG file as a data URL, to be embedded in a page."""
    return "data:image/png;base64," + base64.b64encode(picture.read_bytes()).decode()


def write_csv(path: Path, head: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Write a table as a CSV file.

    Args:
      path: of the CSV file; missing directories are created.
      head: the header, one name for each column.
      rows: the cells of each row.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", errors="replace") as file:
        csv.writer(file, lineterminator="\n").writerows([head, *rows])


def write_page(
    path: Path, title: str, lead: str, sections: list[Section], refresh: int = 0
) -> None:
    """Write a page, and beside it a CSV file for each table that has a name.

    Args:
      path: of the HTML file.
      title: the title at the top of the page.
      lead: the text below the title.
      sections: the sections, in order.
      refresh: seconds after which a browser reloads the page; 0: never.
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
