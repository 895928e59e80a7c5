"""The state of playback as a line of the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.words import plural

if TYPE_CHECKING:
    from edoras_tools.io.foxglove.playback import PlaybackState


def playback_line(state: PlaybackState, range_ns: tuple[int, int], clients: int, *, waiting: bool) -> str:
    """Return a line such as ``playing 0:12.3 of 1:40.0, 2x, 1 client``.

    Args:
        range_ns: start and end of the recording, ns since 1970.
        waiting: whether it waits for the first client.
    """
    start, end = range_ns
    what = "waits for a client at" if waiting else state.status.lower()
    return (
        f"{what} {_clock(state.time_ns - start)} of {_clock(end - start)}, {state.speed:g}x, "
        f"{plural(clients, 'client')}"
    )


def _clock(time_ns: int) -> str:
    tenths = time_ns // 100_000_000
    return f"{tenths // 600}:{tenths % 600 / 10:04.1f}"
