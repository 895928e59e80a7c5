"""Keys of the terminal that control playback, for clients that have no controls of their own."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from edoras_tools.io.foxglove.playback import PlaybackRequest, PlaybackState
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Iterator


HELP: Final = "space, ←→ 5 s, ↑↓ speed, Home, q"
_KEY: Final = re.compile(r"\x1b[\[o]\d*~?[a-z]?|.", re.DOTALL)
_STEPS_NS: Final = {"\x1b[c": 5 * SECOND, "\x1boc": 5 * SECOND, "\x1b[d": -5 * SECOND, "\x1bod": -5 * SECOND}
_FACTORS: Final = {"\x1b[a": 2.0, "\x1boa": 2.0, "+": 2.0, "\x1b[b": 0.5, "\x1bob": 0.5, "-": 0.5}
_HOME: Final = ("\x1b[h", "\x1boh", "\x1b[1~", "0")


def split_keys(text: str) -> Iterator[str]:
    """Yield the keys in what a terminal sent, in lower case: characters, and sequences (``ESC [ a``)."""
    yield from _KEY.findall(text)


def request_of(key: str, state: PlaybackState, start_ns: int) -> PlaybackRequest | None:
    """Return what a key asks for; None for a key without a meaning.

    Args:
        key: from ``split_keys``.
        start_ns: start of the recording, ns since 1970.
    """
    playing = state.status == "Playing"
    if key == " ":
        return PlaybackRequest(not playing, state.speed)
    if key in _STEPS_NS:
        return PlaybackRequest(playing, state.speed, max(state.time_ns + _STEPS_NS[key], start_ns))
    if key in _FACTORS:
        return PlaybackRequest(playing, state.speed * _FACTORS[key])
    if key in _HOME:
        return PlaybackRequest(playing, state.speed, start_ns)
    return None
