"""The summary of a Foxglove server, and the state of its playback, as text."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from edoras_tools.io.foxglove.requests import PlaybackState


def served(summary: Mapping[str, Any]) -> Iterator[str]:
    """Yield one line for all clients, and one for each client that was too slow.

    Args:
        summary: as ``FoxgloveServer.summary`` gives it.
    """
    clients = summary["clients"]
    words = [
        f"Foxglove: {plural(summary['connections'], 'client')}",
        f"{plural(summary['sent'], 'message')} sent",
    ]
    if summary["published"] or summary["refused"]:
        words.append(f"{summary['published']:,} taken from them, {summary['refused']:,} refused")
    yield ", ".join(words)
    for client in clients:
        if client["dropped"]:
            of = client["dropped"] + client["sent"] + client["waiting"]
            yield f"{client['address']} was too slow for {client['dropped']:,} of {of:,} messages"


def playback_line(state: PlaybackState, range_ns: tuple[int, int], clients: int, *, waiting: bool) -> str:
    """Return a line such as ``playing 0:12.3 of 1:40.0, 2x, 1 client``.

    Args:
        range_ns: start and end of the recording, ns since 1970.
        waiting: whether it waits for the first client.
    """
    start, end = range_ns
    status = "waits for a client at" if waiting else state.status.lower()
    return (
        f"{status} {_clock(state.time_ns - start)} of {_clock(end - start)}, {state.speed:g}x, "
        f"{plural(clients, 'client')}"
    )


def _clock(time_ns: int) -> str:
    tenths = time_ns // 100_000_000
    return f"{tenths // 600}:{tenths % 600 / 10:04.1f}"
