"""Domains of Cyclone DDS, configured once in a process.

What comes later in this list holds:

1. ``IgnoreTypeInformation`` for Fast DDS 3 (ROS 2 Kilted): its type objects are of a form that Cyclone DDS
   refuses, so that endpoints whose type has a sequence or an array would never match, silently.
2. ROS's own variables of discovery (docs.ros.org, Improved Dynamic Discovery), as rmw_cyclonedds obeys them;
   but with ``LOCALHOST`` and no other peers only ``lo`` is used.
3. ``CYCLONEDDS_URI``.
4. Our options.

Interfaces would add up, and one that is named twice is refused: the last that names some replaces the others.
Beside these Cyclone DDS's own defaults hold: the first interface that it finds fit, discovery by multicast.
But where nothing else is said it also uses ``lo``, and listens on one of the ports that the standard gives to
participants of a machine (RTPS 9.6.1.1): there a node with ``LOCALHOST`` looks for others.
"""

from __future__ import annotations

import os
import re
import sys
import tempfile
from contextlib import contextmanager, suppress
from pathlib import Path
from socket import SO_RCVBUF, SOCK_DGRAM, SOL_SOCKET, socket
from threading import Lock
from typing import TYPE_CHECKING, Final
from xml.sax.saxutils import quoteattr

import msgspec
from cyclonedds.core import DDSException
from cyclonedds.domain import Domain

from edoras_tools.errors import ConfigError
from edoras_tools.middleware import MOST_DOMAIN
from edoras_tools.middleware.names import unknown_options

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

_OPTIONS: Final = ("interface", "peers", "multicast")
_URI: Final = "CYCLONEDDS_URI"
_TRUTH: Final = ("true", "false")
_RANGE: Final = "ROS_AUTOMATIC_DISCOVERY_RANGE"
_RANGES: Final = ("SUBNET", "LOCALHOST", "OFF", "SYSTEM_DEFAULT")
_PEERS: Final = "ROS_STATIC_PEERS"
_LOCAL_ONLY: Final = "ROS_LOCALHOST_ONLY"
_MOST_PARTICIPANTS: Final = 32
"""Participants of a machine that discovery by unicast finds, as rmw_cyclonedds has it."""
_WITH_LO: Final = (
    '<Interfaces><NetworkInterface autodetermine="true"/><NetworkInterface name="lo"/></Interfaces>'
)
_INDEX: Final = (
    "<ParticipantIndex>auto</ParticipantIndex>"
    f"<MaxAutoParticipantIndex>{_MOST_PARTICIPANTS}</MaxAutoParticipantIndex>"
)
_FAST_DDS_3: Final = "1.15"
"""The vendor id of eProsima; Cyclone DDS then matches its types by name, as rmw_fastrtps itself does."""
_PREFIX: Final = re.compile(r"^\d+\.\d+ \[\d*\]\s+\S+:\s*")
"""What Cyclone DDS puts before a line: time, domain and thread."""
_TABLES: Final = ("/proc/thread-self/net/udp", "/proc/thread-self/net/udp6")
_DESCRIPTORS: Final = "/proc/self/fd"
_SOCKET: Final = re.compile(r"socket:\[(\d+)\]")
_SO_RCVBUFFORCE: Final = 33
_RECEIVE_BYTES: Final = 8 << 20
_CHOICE: Final = re.compile(r"<(Interfaces|NetworkInterfaceAddress)\b.*?</\1\s*>", re.DOTALL | re.IGNORECASE)
_FILE: Final = "file://"
UNACKNOWLEDGED_BYTES: Final = 8 << 20
"""Where a writer begins to wait for its readers, of whatever history; Cyclone DDS's own value is 500 kB."""
_BUFFER: Final = f'<SocketReceiveBufferSize max="{_RECEIVE_BYTES} B"/>'
_COMPATIBLE: Final = f"<IgnoreTypeInformation>{_FAST_DDS_3}</IgnoreTypeInformation>"


class _Held(msgspec.Struct):
    domain: Domain | None
    config: str
    inodes: frozenset[int]
    holders: int = 0


_domains: dict[int, _Held] = {}
_lock = Lock()


def compatible() -> str:
    """Return what every domain is configured with, as XML.

    Fast DDS learns that an endpoint is gone only where its key's hash is sent, too.
    """
    marks = f"<Watermarks><WhcHigh>{UNACKNOWLEDGED_BYTES} B</WhcHigh></Watermarks>"
    return _domain(
        Compatibility=_COMPATIBLE, Internal=f"{marks}{_BUFFER}<GenerateKeyhash>true</GenerateKeyhash>"
    )


def discovery(environ: Mapping[str, str]) -> str:
    """Return ROS's variables of discovery as XML for Cyclone DDS; empty for its own configuration.

    Raises:
        ConfigError: a variable has a value that ROS does not know.
    """
    reach = environ.get(_RANGE, "") or _RANGES[0]
    peers = [item.strip() for item in environ.get(_PEERS, "").split(";") if item.strip()]
    if environ.get(_LOCAL_ONLY) == "1":  # deprecated, and stronger than the other two
        reach, peers = "LOCALHOST", []
    if reach not in _RANGES:
        raise ConfigError(f"{_RANGE} cannot be {reach!r}; set it to {', '.join(_RANGES)}")
    if reach == "OFF":
        xml = f"<ParticipantIndex>none</ParticipantIndex><Tag>edoras_{os.getpid()}</Tag>"
        return _domain(General=_interface("lo") + "<AllowMulticast>false</AllowMulticast>", Discovery=xml)
    if reach == "LOCALHOST":
        alone = "" if peers else _interface("lo")
        general = alone + "<AllowMulticast>false</AllowMulticast>"
        return _domain(General=general, Discovery=_unicast(["localhost", *peers]))
    return _domain(Discovery=_unicast(peers) if peers else _INDEX) if reach == "SUBNET" else ""


def _domain(**sections: str) -> str:
    """Return the sections of a configuration that are not empty, as XML; empty if all are."""
    body = "".join(f"<{name}>{text}</{name}>" for name, text in sections.items() if text)
    return body and f"<CycloneDDS><Domain>{body}</Domain></CycloneDDS>"


def _interface(name: str) -> str:
    return f"<Interfaces><NetworkInterface name={quoteattr(name)}/></Interfaces>"


def _unicast(peers: Iterable[str]) -> str:
    """Return discovery by unicast: it finds a participant only on one of the ports that are tried."""
    inner = "".join(f"<Peer Address={quoteattr(item)}/>" for item in peers)
    return f"{_INDEX}<Peers>{inner}</Peers>"


def configuration(options: Mapping[str, str]) -> str:
    """Return the options as XML for Cyclone DDS; empty if there are none.

    Raises:
        ConfigError: all mistakes at once.
    """
    mistakes = unknown_options("dds", options, _OPTIONS)
    multicast = options.get("multicast", _TRUTH[0])
    if multicast not in _TRUTH:
        mistakes.append(f"dds: multicast cannot be {multicast!r}; write {' or '.join(_TRUTH)}")
    if mistakes:
        raise ConfigError(*mistakes)

    general = _interface(options["interface"]) if options.get("interface") else ""
    if "multicast" in options:
        general += f"<AllowMulticast>{multicast}</AllowMulticast>"
    peers = [item.strip() for item in options.get("peers", "").split(",") if item.strip()]
    return _domain(General=general, Discovery=_unicast(peers) if peers else "")


def hold(number: int, config: str) -> None:
    """Open a domain with this configuration, or share it; each call needs its ``release``.

    Raises:
        ConfigError: the domain does not exist, is configured otherwise in this process, or Cyclone DDS
            refuses the configuration.
    """
    if not 0 <= number <= MOST_DOMAIN:
        raise ConfigError(f"dds: domain {number} does not exist; they are 0 to {MOST_DOMAIN}")
    with _lock:
        domain = _domains.get(number)
        if domain is None:
            before = _sockets()
            opened = _create(number, config)
            inodes = _sockets()
            domain = _domains[number] = _Held(opened, config, frozenset(inodes.keys() - before.keys()))
            for inode in domain.inodes:
                _widen(inodes[inode])
        elif domain.config != config:
            raise ConfigError(f"dds: domain {number} is open in this process with other options")
        domain.holders += 1


def release(number: int) -> None:
    """Undo one ``hold``; the last one closes the domain."""
    with _lock:
        domain = _domains[number]
        domain.holders -= 1
        if not domain.holders:
            del _domains[number]


def one_choice(*layers: str) -> str:
    """Return layers of configuration as one, where only the last one that names interfaces does."""
    last = max((number for number, item in enumerate(layers) if _CHOICE.search(item)), default=0)
    return ",".join(filter(None, (*(_CHOICE.sub("", item) for item in layers[:last]), *layers[last:])))


def _of_user() -> str:
    """Return the user's own configuration; a file's content where it is one that can be read."""
    text = os.environ.get(_URI, "")
    if text.startswith(_FILE):
        with suppress(OSError, UnicodeDecodeError):
            return Path(text.removeprefix(_FILE)).read_text(encoding="utf-8")
    return text


def missing_hint(environ: Mapping[str, str]) -> str:
    """Return what to look at where no other node was found."""
    reach = "LOCALHOST" if environ.get(_LOCAL_ONLY) == "1" else environ.get(_RANGE, "") or _RANGES[0]
    variable = _LOCAL_ONLY if environ.get(_LOCAL_ONLY) == "1" else _RANGE
    if reach == "OFF":
        return f"{_RANGE} is OFF here, so nobody is found; unset it"
    if reach == "LOCALHOST":
        return (
            f"{variable} limits ours to this machine; if the others are on another one, "
            f"unset it here, or name their addresses in {_PEERS}"
        )
    return (
        f"is ROS_DOMAIN_ID the same? If {_RANGE} is LOCALHOST there, they are found only from their own "
        "machine, through lo: write --ros-option interface=lo, or unset it there; if OFF, unset it there. "
        "If multicast does not reach the others, write --ros-option peers=ADDRESS"
    )


def dropped(number: int) -> int:
    """Return how many datagrams the kernel dropped because a socket of a domain was full, so far."""
    with _lock:
        domain = _domains.get(number)
    rows: list[list[str]] = []
    for table in _TABLES if domain else ():
        with suppress(OSError):
            rows += map(str.split, Path(table).read_text(encoding="ascii").splitlines()[1:])
    return sum(int(row[-1]) for row in rows if domain and int(row[9]) in domain.inodes)


def _sockets() -> dict[int, int]:
    """Return the sockets of this process: inode to descriptor; none where the system does not tell."""
    sockets = {}
    with suppress(OSError):
        for path in Path(_DESCRIPTORS).iterdir():
            with suppress(OSError):
                if match := _SOCKET.fullmatch(str(path.readlink())):
                    sockets[int(match[1])] = int(path.name)
    return sockets


def _widen(descriptor: int) -> None:
    """Give a socket a larger receive buffer, beyond the system's limit where this process may do that."""
    with suppress(OSError), socket(fileno=os.dup(descriptor)) as opened:
        if opened.type == SOCK_DGRAM and opened.getsockopt(SOL_SOCKET, SO_RCVBUF) < _RECEIVE_BYTES:
            with suppress(OSError):
                opened.setsockopt(SOL_SOCKET, _SO_RCVBUFFORCE, _RECEIVE_BYTES)


def _create(number: int, config: str) -> Domain | None:
    """Return a new domain; None if the one that is open in this process already fits."""
    users, variables = _of_user(), discovery(os.environ)
    lines: list[str] = []
    usual, has_interface = variables == discovery({}), bool(users) or "NetworkInterface" in config
    # Each asks for less than the one before: a machine may have no other interface, or no port left.
    beside = [] if has_interface else [f"{variables},{_domain(General=_WITH_LO)}"]
    reaches = [*beside, variables, ""] if usual else [variables]
    for reach in reaches:
        lines.clear()
        try:
            with _overheard(lines):
                return Domain(number, one_choice(compatible(), reach, users, config))
        except DDSException as error:
            failure = error
            if error.code == DDSException.DDS_RETCODE_PRECONDITION_NOT_MET:
                if not config and usual:
                    return None
                raise ConfigError(f"dds: domain {number} is open in this process without options") from error
    sources = users and f"${_URI}", "" if usual else "ROS's variables", config and "options"
    settings = ", ".join(filter(None, sources))
    why = "; ".join(dict.fromkeys(lines)) or failure.msg
    look = f"; look at: {settings}" if settings else ""
    raise ConfigError(f"dds: Cyclone DDS opens no domain {number}: {why}{look}") from failure


@contextmanager
def _overheard(output: list[str]) -> Iterator[None]:
    """Take what Cyclone DDS writes to the standard error stream while it fails: its errors say nothing.

    What it says and goes on is written there afterwards.
    """
    stderr = sys.__stderr__.fileno() if sys.__stderr__ else 2
    real_stderr = os.dup(stderr)
    try:
        with tempfile.TemporaryFile() as file:
            os.dup2(file.fileno(), stderr)
            try:
                yield
            except DDSException:
                file.seek(0)
                lines = file.read().decode("utf-8", "replace").splitlines()
                output += [_PREFIX.sub("", line).strip() for line in lines if line.strip()]
                raise
            else:
                file.seek(0)
                os.write(real_stderr, file.read())
            finally:
                os.dup2(real_stderr, stderr)
    finally:
        os.close(real_stderr)
