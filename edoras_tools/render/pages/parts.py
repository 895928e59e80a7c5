"""The parts of every page: its frame, sections, charts in cards, and its footer."""

from __future__ import annotations

import re
from html import escape
from importlib.resources import files
from typing import TYPE_CHECKING, Final, NamedTuple

from edoras_tools import __version__
from edoras_tools.render import units

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

_HEADING: Final = re.compile(r'<section id="([\w-]+)"><h2>(.*?)</h2>')


class Made(NamedTuple):
    """How and when a page was made: its footer.

    Attributes:
        command: the command line that makes it again.
        time_ns: time of making, ns since 1970-01-01 UTC.
    """

    command: str
    time_ns: int


def document(title: str, parts: Iterable[str]) -> str:
    """Return a whole page; it loads nothing from other places."""
    style = (files("edoras_tools.render.pages") / "style.css").read_text(encoding="utf-8")
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>\n{style}</style>\n</head>\n<body>\n"
        + "\n".join(part for part in parts if part)
        + "\n</body>\n</html>\n"
    )


def contents(sections: Sequence[str]) -> str:
    """Return links to the sections of the page."""
    headings = [match for section in sections for match in _HEADING.findall(section)]
    links = "".join(f'<a href="#{anchor}">{title}</a>' for anchor, title in headings)
    return f'<nav class="dim">{links}</nav>' if len(headings) > 1 else ""


def heading(name: str) -> str:
    """Return the page's heading; a path may break between its parts, and only where necessary."""
    return f"<h1>{escape(name).replace('/', '/<wbr>')}</h1>"


def footer(origin: Made) -> str:
    """Return the footer: how and when the page was made."""
    text = f"edoras-tools {__version__}, {units.utc(origin.time_ns, digits=0)} UTC"
    return f'<footer class="dim">{text}<br><code>{escape(origin.command)}</code></footer>'


def chart_card(title: str, svg: str, note: str = "") -> str:
    """Return a chart below its title, and a note on it."""
    note_html = f'<p class="dim">{escape(note)}</p>' if note else ""
    return f'<figure class="chart"><figcaption><h3>{escape(title)}</h3>{note_html}</figcaption>{svg}</figure>'


def section(title: str, inside: Iterable[str], lead: str = "") -> str:
    """Return a section; empty if it has no contents."""
    drawn = "".join(inside)
    anchor = title.lower().replace(" ", "-")
    return f'<section id="{anchor}"><h2>{title}</h2>{lead}{drawn}</section>' if drawn else ""


def html_table(heads: Iterable[str], rows: Iterable[Iterable[str]], style: str = "") -> str:
    """Return a table; empty without rows.

    Args:
        rows: cells as HTML: the caller escapes what is text.
        style: class of the table.
    """
    head = "".join(f"<th>{name}</th>" for name in heads)
    body = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in rows)
    kind = f' class="{style}"' if style else ""
    return f'<div class="scroll"><table{kind}><tr>{head}</tr>{body}</table></div>' if body else ""


def colour_key(entries: Sequence[tuple[str, str]], style: str = "") -> str:
    """Return the legend of colours: each with its text."""
    spans = "".join(f'<span style="background:var(--{colour})"></span>{text}' for colour, text in entries)
    return f'<p class="key dim {style}">{spans}</p>'
