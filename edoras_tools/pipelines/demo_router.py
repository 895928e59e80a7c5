"""The router that nodes on rmw_zenoh find each other by: the one that runs, or one of a demo's own."""

from __future__ import annotations

import socket
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

from edoras_tools.errors import CaptureError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

PORT: Final = 7447
"""Where rmw_zenoh's nodes look for it."""
_PATIENCE_S: Final = 1.0


@contextmanager
def router(ros: str, options: Mapping[str, str], say: Callable[[str], None] | None = None) -> Iterator[None]:
    """Be the Zenoh router of this machine, where there is none and the user names none.

    Raises:
        CaptureError: it cannot listen.
    """
    if ros != "zenoh" or {"router", "config"} & options.keys() or _is_there():
        yield
        return
    try:
        import zenoh
    except ImportError:
        yield  # said by whoever joins the graph
        return
    config = zenoh.Config()
    for key, value in (
        ("mode", '"router"'),
        ("listen/endpoints", f'["tcp/localhost:{PORT}"]'),
        ("scouting/multicast/enabled", "false"),
        ("timestamping/enabled", "true"),
    ):
        config.insert_json5(key, value)
    try:
        session = zenoh.open(config)
    except zenoh.ZError as error:
        raise CaptureError(f"TCP localhost:{PORT}: no Zenoh router: {error}; start rmw_zenohd") from None
    with session:
        if say is not None:
            say(f"no Zenoh router ran on this machine; this demo is one, at localhost:{PORT}")
        yield


def _is_there() -> bool:
    try:
        socket.create_connection(("localhost", PORT), timeout=_PATIENCE_S).close()
    except OSError:
        return False
    return True
