"""Checks before sending: the allowed targets and messages."""

from __future__ import annotations

from fnmatch import fnmatchcase
from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.cfs.names import message_name
from edoras_tools.errors import ConfigError
from edoras_tools.io.net.address import is_loopback
from edoras_tools.model import NO_MSG_ID, Endpoint

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from edoras_tools.mission import Mission
    from edoras_tools.sessions.outgoing import Outgoing


def names_of(msg_id: int, mission: Mission) -> list[str]:
    """Return all names of a MsgId: hex, cFE's, topics with and without the leading slash, keys."""
    found = [f"0x{msg_id:04x}", f"0x{msg_id:x}", message_name(mission.msg_ids.known(msg_id)) or "-"]
    for route in mission.routes:
        if route.msg_id == msg_id:
            found += [route.topic, route.topic.removeprefix("/"), route.key]
    return found


def fits(pattern: str, msg_id: int, mission: Mission) -> bool:
    """Return whether a shell pattern matches a MsgId (e.g. ``0x18*``), its topic or its key."""
    pattern = pattern.lower() if pattern[:2].lower() == "0x" else pattern
    return any(fnmatchcase(name, pattern) for name in names_of(msg_id, mission))


def called(msg_id: int, mission: Mission) -> str:
    """Return a MsgId with its topic, for the user."""
    if msg_id == NO_MSG_ID:
        return "datagrams without a MsgId"
    topic = next((route.topic for route in mission.routes if route.msg_id == msg_id), "")
    return f"0x{msg_id:04x}{f' ({topic})' if topic else ''}"


def check_allowed(out: Outgoing, allow: Sequence[str], mission: Mission) -> None:
    """Refuse datagrams that the allow-list does not name; an empty list allows all.

    Raises:
        ConfigError: something would be sent that is not on the list.
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


def check_target(target: Endpoint, *, confirmed: bool, confirm: Callable[[str], bool] | None = None) -> None:
    """Refuse another machine unless the user confirms it.

    Args:
        target: where datagrams would go.
        confirmed: the user has already confirmed another machine.
        confirm: asks a question and returns the answer; None if the user cannot be asked.

    Raises:
        ConfigError: it is not confirmed.
    """
    if confirmed or is_loopback(target.address):
        return
    if confirm is None or not confirm(f"Send to {target}, another machine?"):
        raise ConfigError(
            f"{target} is not on this machine's loopback; nothing was sent; confirm the target with --yes"
        )
