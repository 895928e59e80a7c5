"""Colours: one meaning each, from the terminal's own sixteen, so that light and dark themes both work."""

from __future__ import annotations

from functools import lru_cache
from typing import Final

from rich.color import ColorSystem
from rich.style import Style

from edoras_tools.model import Link

LINKS: Final = {Link.CI: "cyan", Link.TO: "green", Link.SBN: "magenta", Link.OTHER: "dim"}
"""Style of each link, the same in every view."""

DIM: Final = "dim"
STRONG: Final = "bold"
TITLE: Final = "bold underline"
CHOSEN: Final = "reverse"
"""Bytes that the user points at."""

_LAYERS: Final = {
    "sbn": "magenta",
    "ccsds": "cyan",
    "cfe": "blue",
    "edoras": "yellow",
    "cdr": "bright_cyan",
    "ethernet": "bright_black",
    "ip": "bright_black",
    "ipv4": "bright_black",
    "ipv6": "bright_black",
    "udp": "bright_black",
    "frame": "bright_black",
    "padding": "bright_black",
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
    """Puts styles on text, or leaves text as it is where there is to be no colour."""

    __slots__ = ("colour",)

    def __init__(self, colour: bool) -> None:
        self.colour = colour

    def __call__(self, text: str, style: str) -> str:
        """Return clean text in a rich style."""
        if not self.colour or not text or not style:
            return text
        before, after = escapes(style)
        return f"{before}{text}{after}"
