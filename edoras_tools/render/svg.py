"""Pictures of the views, for documentation."""

from __future__ import annotations

import io
import re
from typing import TYPE_CHECKING, Final

from rich.console import Console
from rich.text import Text

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rich.console import RenderableType

_FONTS: Final = re.compile(r"\s*@font-face \{.*?\}", re.DOTALL)


def terminal_picture(views: Iterable[str | RenderableType], *, width: int, title: str) -> str:
    """Return an SVG of a terminal that shows views one below the other.

    It loads nothing from elsewhere and is the same for the same views.

    Args:
        views: lines with ANSI styles, or rich renderables.
        width: columns of the terminal; longer lines are cut.
        title: in the window's bar.
    """
    console = Console(
        record=True, width=width, file=io.StringIO(), force_terminal=True, color_system="standard"
    )
    for view in views:
        shown = Text.from_ansi(view) if isinstance(view, str) else view
        console.print(shown, no_wrap=isinstance(view, str), crop=True, highlight=False)
    return without_fonts(console.export_svg(title=title, unique_id="edoras"))


def without_fonts(svg: str) -> str:
    """Return a picture that rich made so that it loads nothing from elsewhere."""
    return _FONTS.sub("", svg)
