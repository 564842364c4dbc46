"""How docstrings become Markdown: examples and indented equations are code."""

import linecache
import re

import griffe


def to_markdown(text: str) -> str:
    """Return a docstring with its examples fenced, and `::` before indented text as a colon.

    >>> to_markdown("The equation is::\\n\\n    r = 0")
    'The equation is:\\n\\n    r = 0'
    """
    text = re.sub(r"::\n", ":\n", text)
    example = r"^( *)(>>> .*(?:\n\1\S.*)*)"  # up to a blank line
    fence = lambda found: f"{found[1]}```pycon\n{found[0]}\n{found[1]}```"
    return re.sub(example, fence, text, flags=re.MULTILINE)


def sentence(comment: str) -> str:
    """Return a comment with a capital and a full stop.

    >>> sentence("frames[t] opens an episode")
    'Frames[t] opens an episode.'
    """
    return comment[:1].upper() + comment[1:] + "."


class Docstrings(griffe.Extension):
    """Converts the docstring of every object, and lists the fields of records."""

    def on_object(self, *, obj: griffe.Object, **options: object) -> None:
        """Convert the docstring of an object, in place."""
        if not obj.is_alias and obj.docstring:
            obj.docstring.value = to_markdown(obj.docstring.value)

    def on_class_members(self, *, cls: griffe.Class, **options: object) -> None:
        """Add the fields of a class, with the comments beside them, to its docstring."""
        fields = [one for one in cls.members.values() if one.is_attribute and one.annotation]
        if not (fields and cls.docstring) or "Attributes:" in cls.docstring.value:
            return
        lines = ["", "", "Attributes:"]
        for one in fields:
            line = linecache.getline(str(one.filepath), one.endlineno or one.lineno)
            comment = line.partition("  # ")[2].strip()
            lines.append(f"  {one.name}: {sentence(comment) if comment else 'See above.'}")
        cls.docstring.value += "\n".join(lines)
