"""Colours: one meaning each, read on light and on dark.

Red, green, yellow, magenta, cyan and bright blue; dim, bold and reverse. Not plain blue, which is too dark on
black, and no other bright colour: cyan and yellow vanish on white, and Solarized's background is its bright
black. What a colour says is told by a word or a mark, too.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final

from rich.color import ColorSystem
from rich.style import Style

DIM: Final = "dim"
STRONG: Final = "bold"
GOOD: Final = "green"
CHOSEN: Final = "reverse"
"""Bytes that the user points at."""

_LAYERS: Final = {
    "sbn": "magenta",
    "ccsds": "cyan",
    "cfe": "bright_blue",
    "edoras": "yellow",
    "cdr": "bold bright_blue",
    "ethernet": DIM,
    "ip": DIM,
    "ipv4": DIM,
    "ipv6": DIM,
    "udp": DIM,
    "frame": DIM,
    "padding": DIM,
}
_BODY: Final = "green"


def layer(name: str) -> str:
    """Return the style of a layer; layers of one protocol (``cfe_command``, ``cfe_event``) share theirs."""
    return _LAYERS.get(name) or _LAYERS.get(name.partition("_")[0], _BODY)


@lru_cache(maxsize=256)
def escapes(style: str) -> tuple[str, str]:
    """Return the ANSI sequences that begin and end a rich style such as ``bold red``."""
    before, _, after = Style.parse(style).render("|", color_system=ColorSystem.STANDARD).partition("|")
    return before, after


class Paint:
    """Puts styles on text; without colour it returns the text as it is."""

    __slots__ = ("colour",)

    def __init__(self, colour: bool) -> None:
        self.colour = colour

    def __call__(self, text: str, style: str) -> str:
        """Return clean text in a rich style."""
        if not self.colour or not text or not style:
            return text
        before, after = escapes(style)
        return f"{before}{text}{after}"
