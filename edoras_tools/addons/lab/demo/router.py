"""The Zenoh router that nodes with rmw_zenoh use to find each other: a running one, or the demo's own."""

from __future__ import annotations

import socket
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

from edoras_tools.errors import CaptureError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

ROUTER_PORT: Final = 7447
"""The port where rmw_zenoh's nodes expect it."""
_PATIENCE_S: Final = 1.0


@contextmanager
def router(ros: str, options: Mapping[str, str], say: Callable[[str], None] | None = None) -> Iterator[None]:
    """Run a Zenoh router, unless this machine has one or the user names one.

    Raises:
        CaptureError: it cannot listen.
    """
    if ros != "zenoh" or {"router", "config"} & options.keys() or _is_there():
        yield
        return
    try:
        import zenoh
    except ImportError:
        yield  # joining the graph reports the missing package
        return
    config = zenoh.Config()
    for key, value in (
        ("mode", '"router"'),
        ("listen/endpoints", f'["tcp/localhost:{ROUTER_PORT}"]'),
        ("scouting/multicast/enabled", "false"),
        ("timestamping/enabled", "true"),
    ):
        config.insert_json5(key, value)
    try:
        session = zenoh.open(config)
    except zenoh.ZError as error:
        raise CaptureError(
            f"TCP localhost:{ROUTER_PORT}: cannot start a Zenoh router: {error}; start rmw_zenohd"
        ) from None
    with session:
        if say is not None:
            say(f"no Zenoh router is running on this machine; this demo runs one at localhost:{ROUTER_PORT}")
        yield


def _is_there() -> bool:
    try:
        socket.create_connection(("localhost", ROUTER_PORT), timeout=_PATIENCE_S).close()
    except OSError:
        return False
    return True
