"""What keeps sending safe: who may be sent to, and what."""

from __future__ import annotations

import ipaddress
import socket
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.errors import ConfigError
from edoras_tools.model import NO_MSG_ID

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from edoras_tools.mission import Mission
    from edoras_tools.model import Endpoint
    from edoras_tools.sessions.outgoing import Outgoing


def is_loopback(host: str) -> bool:
    """Tell whether a host is this machine's loopback; a name that is not known is not."""
    try:
        found = socket.getaddrinfo(host, None, type=socket.SOCK_DGRAM)
    except (OSError, UnicodeError):
        return False
    return all(ipaddress.ip_address(str(item[4][0]).partition("%")[0]).is_loopback for item in found)


def names_of(msg_id: int, mission: Mission) -> list[str]:
    """Return all that a MsgId goes by: hex, topics with and without the leading slash, keys."""
    found = [f"0x{msg_id:04x}", f"0x{msg_id:x}"]
    for route in mission.routes:
        if route.msg_id == msg_id:
            found += [route.topic, route.topic.removeprefix("/"), route.key]
    return found


def fits(pattern: str, msg_id: int, mission: Mission) -> bool:
    """Tell whether a shell pattern fits a MsgId, as ``0x18*``, or a topic or key of it."""
    pattern = pattern.lower() if pattern[:2].lower() == "0x" else pattern
    return any(fnmatchcase(name, pattern) for name in names_of(msg_id, mission))


def called(msg_id: int, mission: Mission) -> str:
    """Return a MsgId with its topic, for people."""
    if msg_id == NO_MSG_ID:
        return "datagrams without a MsgId"
    topic = next((route.topic for route in mission.routes if route.msg_id == msg_id), "")
    return f"0x{msg_id:04x}{f' ({topic})' if topic else ''}"


def check_allowed(out: Outgoing, allow: Sequence[str], mission: Mission) -> None:
    """Refuse what the allow-list does not name; an empty list allows all.

    Raises:
        ConfigError: something would be sent that is not on it.
    """
    refused = [
        item
        for item in (np.unique(out.msg_id).tolist() if allow else ())
        if item == NO_MSG_ID or not any(fits(pattern, item, mission) for pattern in allow)
    ]
    if refused:
        raise ConfigError(
            f"not on the allow-list ({', '.join(allow)}): "
            f"{', '.join(called(item, mission) for item in refused)}; nothing was sent; "
            "leave it out with --route, or allow it with --allow"
        )


def check_target(target: Endpoint, *, yes: bool, confirm: Callable[[str], bool] | None = None) -> None:
    """Refuse another machine that nobody said yes to.

    Args:
        target: where datagrams would go.
        yes: it is meant.
        confirm: asks a question and returns the answer; None where there is nobody to ask.

    Raises:
        ConfigError: nobody said yes.
    """
    if yes or is_loopback(target.address):
        return
    if confirm is None or not confirm(f"Send to {target}, another machine?"):
        raise ConfigError(
            f"{target} is not on this machine's loopback; nothing was sent; --yes says that it is meant"
        )
