"""Pictures of the views, for documentation; SVG as PNG."""

from __future__ import annotations

from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Callable


_DEJAVU: Final = {
    "serif_family": "DejaVu Serif",
    "sans_serif_family": "DejaVu Sans",
    "monospace_family": "DejaVu Sans Mono",
}
"""Fonts for systems without fontconfig, such as small containers, where resvg finds no ``sans-serif``."""


def need_png() -> Callable[..., Any]:
    """Return ``resvg_py.svg_to_bytes`` after a test drawing of one letter.

    Raises:
        ConfigError: it is not installed, or this system has no font.
    """
    try:
        resvg = import_module("resvg_py")
    except ImportError:
        raise ConfigError(
            "PNG needs resvg, which is not installed: pip install 'edoras-tools[plot]', or write SVG"
        ) from None
    box = '<svg xmlns="http://www.w3.org/2000/svg" width="20" height="20">{}</svg>'
    texts = ("", '<text y="15" font-family="sans-serif">W</text>')
    for names in ({}, _DEJAVU):
        draw = partial(resvg.svg_to_bytes, **names)
        blank, letter = (draw(svg_string=box.format(text)) for text in texts)
        if blank != letter:
            return draw
    raise ConfigError("PNG needs a font, and this system has none: install fonts-dejavu-core, or write SVG")


def png(svg: str, width: int) -> bytes:
    """Return an SVG picture as PNG.

    Args:
        svg: the picture; its size is that of its view box.
        width: pixels.

    Raises:
        ConfigError: see ``need_png``.
    """
    return bytes(need_png()(svg_string=svg, width=width))
