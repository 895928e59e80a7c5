"""The summary of a Foxglove server as text."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping


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
