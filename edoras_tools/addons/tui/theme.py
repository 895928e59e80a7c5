"""The dark and the light theme, and the terminal's sixteen colours in each."""

from __future__ import annotations

from typing import Final

from rich.terminal_theme import TerminalTheme
from textual.theme import Theme


def _rgb(text: str) -> tuple[int, int, int]:
    return int(text[:2], 16), int(text[2:4], 16), int(text[4:], 16)


def _sixteen(background: str, foreground: str, *colours: str) -> TerminalTheme:
    table = [_rgb(item) for item in colours]
    return TerminalTheme(_rgb(background), _rgb(foreground), table[:8], table[8:])


DARK: Final = Theme(
    name="edoras-dark",
    primary="#4c9fd4",
    secondary="#7a8fa6",
    warning="#d7a846",
    error="#e0616b",
    success="#6cb272",
    accent="#e0a95c",
    foreground="#d5dbe3",
    background="#10141a",
    surface="#141920",
    panel="#1d242e",
    dark=True,
)
LIGHT: Final = Theme(
    name="edoras-light",
    primary="#1f6fa8",
    secondary="#5b6b7c",
    warning="#a86f00",
    error="#c0323e",
    success="#2f7d3a",
    accent="#b06a00",
    foreground="#22272e",
    background="#fbfbf9",
    surface="#f5f5f2",
    panel="#e6e8ea",
    dark=False,
)


def of_terminal(colours: str) -> Theme:
    """Return the theme that matches a terminal.

    Args:
        colours: numbers of its text and background colours among the sixteen, as in ``COLORFGBG``, which
            rxvt, Konsole and others set: ``0;15``, ``15;default;0``.
    """
    return LIGHT if colours.rpartition(";")[2] in _LIGHT_GROUNDS else DARK


_LIGHT_GROUNDS: Final = ("7", *map(str, range(9, 16)))
DARK_SIXTEEN: Final = _sixteen(
    *("10141a", "d5dbe3"),
    *("1d242e", "e0616b", "7fc38a", "d9b25f", "6aa5e8", "c792d9", "5fc3cf", "c3cbd5"),
    *("6b7787", "f07f88", "98d6a2", "ecc97e", "8bbdf5", "dcaeea", "84dbe5", "ffffff"),
)
LIGHT_SIXTEEN: Final = _sixteen(
    *("fbfbf9", "22272e"),
    *("22272e", "b8262f", "2b7a37", "93670a", "1d5fae", "8b3fa3", "0c7480", "6b7480"),
    *("8a939e", "d0404a", "3a8f47", "a9790f", "2f74c8", "a054b8", "138a98", "3a424c"),
)
