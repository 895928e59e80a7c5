"""Domains of Cyclone DDS, configured once a process: the user's ``CYCLONEDDS_URI``, then our options.

Cyclone DDS's own defaults are those of a ROS 2 node: the first interface that it finds fit, discovery by
multicast. So without options nothing is configured here.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from threading import Lock
from typing import TYPE_CHECKING, Final
from xml.sax.saxutils import quoteattr

from cyclonedds.core import DDSException
from cyclonedds.domain import Domain

from edoras_tools.errors import ConfigError
from edoras_tools.middleware.names import unknown_options

if TYPE_CHECKING:
    from collections.abc import Mapping

OPTIONS: Final = ("interface", "peers", "multicast")
MOST_DOMAIN: Final = 232
"""The highest domain whose ports exist (RTPS 9.6.1.1)."""
_URI: Final = "CYCLONEDDS_URI"
_TRUTH: Final = ("true", "false")


@dataclass(slots=True)
class _Held:
    domain: Domain | None
    config: str
    holders: int = 0


_held: dict[int, _Held] = {}
_lock = Lock()


def configuration(options: Mapping[str, str]) -> str:
    """Return what options say as Cyclone DDS's XML; empty where there are none.

    Raises:
        ConfigError: all mistakes at once.
    """
    mistakes = unknown_options("dds", options, OPTIONS)
    multicast = options.get("multicast", _TRUTH[0])
    if multicast not in _TRUTH:
        mistakes.append(f"dds: multicast cannot be {multicast!r}; write {' or '.join(_TRUTH)}")
    if mistakes:
        raise ConfigError(*mistakes)

    general, discovery = "", ""
    if interface := options.get("interface"):
        general += f"<Interfaces><NetworkInterface name={quoteattr(interface)}/></Interfaces>"
    if "multicast" in options:
        general += f"<AllowMulticast>{multicast}</AllowMulticast>"
    if peers := [item.strip() for item in options.get("peers", "").split(",") if item.strip()]:
        # a participant that is looked for by unicast must be on one of the ports that are looked at
        inner = "".join(f"<Peer Address={quoteattr(item)}/>" for item in peers)
        discovery = f"<ParticipantIndex>auto</ParticipantIndex><Peers>{inner}</Peers>"
    parts = (("General", general), ("Discovery", discovery))
    body = "".join(f"<{name}>{text}</{name}>" for name, text in parts if text)
    return body and f"<CycloneDDS><Domain>{body}</Domain></CycloneDDS>"


def hold(number: int, config: str) -> None:
    """Have a domain that is configured as told; each call wants its ``release``.

    Raises:
        ConfigError: the domain does not exist, is configured otherwise in this process, or Cyclone DDS
            refuses the configuration.
    """
    if not 0 <= number <= MOST_DOMAIN:
        raise ConfigError(f"dds: domain {number} does not exist; they are 0 to {MOST_DOMAIN}")
    with _lock:
        held = _held.get(number)
        if held is None:
            held = _held[number] = _Held(_create(number, config), config)
        elif held.config != config:
            raise ConfigError(f"dds: domain {number} is open in this process with other options")
        held.holders += 1


def release(number: int) -> None:
    """Give up one hold; the last one ends the domain."""
    with _lock:
        held = _held[number]
        held.holders -= 1
        if not held.holders:
            del _held[number]


def _create(number: int, config: str) -> Domain | None:
    """Return a new domain; None where the one that another part of the process opened will do."""
    users = os.environ.get(_URI, "")
    try:
        return Domain(number, ",".join(filter(None, (users, config))))
    except DDSException as error:
        if error.code == DDSException.DDS_RETCODE_PRECONDITION_NOT_MET:
            if not config:
                return None
            raise ConfigError(f"dds: domain {number} is open in this process without options") from error
        asked = " or ".join(filter(None, (users and f"${_URI}", config and "the options")))
        raise ConfigError(
            f"dds: Cyclone DDS opens no domain {number}"
            + (f"; it has said above what of {asked} it cannot honour" if asked else f": {error.msg}")
        ) from error
