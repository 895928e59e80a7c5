"""Domains of Cyclone DDS, configured once in a process.

Configurations, of which later ones override earlier ones:

1. ``IgnoreTypeInformation`` for Fast DDS 3 (ROS 2 Kilted): Cyclone DDS refuses the form of its type objects.
   Without it, endpoints whose type has a sequence or an array would never match, without a message.
2. ROS's own variables of discovery (docs.ros.org, Improved Dynamic Discovery), as rmw_cyclonedds applies
   them; but with ``LOCALHOST`` and no other peers only ``lo`` is used.
3. ``CYCLONEDDS_URI``.
4. The options of this package.

Interfaces would add up, and Cyclone DDS refuses one that is named twice: so the last configuration that
names some replaces those of the others. For all else Cyclone DDS's defaults apply: the first suitable
interface, and discovery by multicast. But if nothing names interfaces, it also uses ``lo``, and listens on
one of the ports that the standard assigns to participants of a machine (RTPS 9.6.1.1): there a node with
``LOCALHOST`` searches for others.
"""

from __future__ import annotations

import os
import re
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from socket import SO_RCVBUF, SOCK_DGRAM, SOL_SOCKET, socket
from threading import Lock
from typing import Final
from xml.sax.saxutils import quoteattr

import msgspec
from cyclonedds.core import DDSException
from cyclonedds.domain import Domain

from edoras_tools.errors import ConfigError
from edoras_tools.middleware import MOST_DOMAIN
from edoras_tools.middleware.graph import unknown_options

_OPTIONS: Final = ("interface", "peers", "multicast")
_URI: Final = "CYCLONEDDS_URI"
_TRUTH: Final = ("true", "false")
_RANGE: Final = "ROS_AUTOMATIC_DISCOVERY_RANGE"
_RANGES: Final = ("SUBNET", "LOCALHOST", "OFF", "SYSTEM_DEFAULT")
_PEERS: Final = "ROS_STATIC_PEERS"
_LOCAL_ONLY: Final = "ROS_LOCALHOST_ONLY"
_MOST_PARTICIPANTS: Final = 32
"""Maximum number of participants of a machine that discovery by unicast finds, as in rmw_cyclonedds."""
_WITH_LO: Final = (
    '<Interfaces><NetworkInterface autodetermine="true"/><NetworkInterface name="lo"/></Interfaces>'
)
_INDEX: Final = (
    "<ParticipantIndex>auto</ParticipantIndex>"
    f"<MaxAutoParticipantIndex>{_MOST_PARTICIPANTS}</MaxAutoParticipantIndex>"
)
_FAST_DDS_3: Final = "1.15"
"""Vendor id of eProsima; with it Cyclone DDS matches types by name, as rmw_fastrtps does."""
_PREFIX: Final = re.compile(r"^\d+\.\d+ \[\d*\]\s+\S+:\s*")
"""Prefix of Cyclone DDS's log lines: time, domain and thread."""
_TABLES: Final = ("/proc/thread-self/net/udp", "/proc/thread-self/net/udp6")
_DESCRIPTORS: Final = "/proc/self/fd"
_SOCKET: Final = re.compile(r"socket:\[(\d+)\]")
_SO_RCVBUFFORCE: Final = 33
_RECEIVE_BYTES: Final = 8 << 20
_CHOICE: Final = re.compile(r"<(Interfaces|NetworkInterfaceAddress)\b.*?</\1\s*>", re.DOTALL | re.IGNORECASE)
_FILE: Final = "file://"
UNACKNOWLEDGED_BYTES: Final = 8 << 20
"""Unacknowledged bytes from which a writer waits for its readers, whatever its history; default: 500 kB."""
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
    """Return the configuration of every domain, as XML.

    Fast DDS notices that an endpoint has left only if its key's hash is sent, too.
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
    variable, reach = _reach(environ)
    peers = [item.strip() for item in environ.get(_PEERS, "").split(";") if item.strip()]
    peers = peers if variable == _RANGE else []
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


def _reach(environ: Mapping[str, str]) -> tuple[str, str]:
    """Return the variable that limits discovery, and its range."""
    if environ.get(_LOCAL_ONLY) == "1":  # deprecated, but it overrides the others
        return _LOCAL_ONLY, "LOCALHOST"
    return _RANGE, environ.get(_RANGE, "") or _RANGES[0]


def _domain(**sections: str) -> str:
    """Return the sections of a configuration that are not empty, as XML; empty if all are."""
    body = "".join(f"<{name}>{text}</{name}>" for name, text in sections.items() if text)
    return body and f"<CycloneDDS><Domain>{body}</Domain></CycloneDDS>"


def _interface(name: str) -> str:
    return f"<Interfaces><NetworkInterface name={quoteattr(name)}/></Interfaces>"


def _unicast(peers: Iterable[str]) -> str:
    """Return discovery by unicast: it finds only participants on one of the ports that it tries."""
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
        ConfigError: the domain does not exist, has another configuration in this process, or Cyclone DDS
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
    """Return layers of configuration as one, in which only the last one that names interfaces does."""
    last = max((number for number, item in enumerate(layers) if _CHOICE.search(item)), default=0)
    return ",".join(filter(None, (*(_CHOICE.sub("", item) for item in layers[:last]), *layers[last:])))


def _of_user() -> str:
    """Return the user's own configuration; the contents if it is a readable file."""
    text = os.environ.get(_URI, "")
    if text.startswith(_FILE):
        with suppress(OSError, UnicodeDecodeError):
            return Path(text.removeprefix(_FILE)).read_text(encoding="utf-8")
    return text


def missing_hint(environ: Mapping[str, str]) -> str:
    """Return advice for the case that no other node was found."""
    variable, reach = _reach(environ)
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
    """Return the number of datagrams that the kernel dropped so far because a socket of a domain was full."""
    with _lock:
        domain = _domains.get(number)
    rows: list[list[str]] = []
    for table in _TABLES if domain else ():
        with suppress(OSError):
            rows += map(str.split, Path(table).read_text(encoding="ascii").splitlines()[1:])
    return sum(int(row[-1]) for row in rows if domain and int(row[9]) in domain.inodes)


def _sockets() -> dict[int, int]:
    """Return the sockets of this process, inode to descriptor; empty if the system does not show them."""
    sockets = {}
    with suppress(OSError):
        for path in Path(_DESCRIPTORS).iterdir():
            with suppress(OSError):
                if match := _SOCKET.fullmatch(str(path.readlink())):
                    sockets[int(match[1])] = int(path.name)
    return sockets


def _widen(descriptor: int) -> None:
    """Give a socket a larger receive buffer, beyond the system's limit if this process may do that."""
    with suppress(OSError), socket(fileno=os.dup(descriptor)) as opened:
        if opened.type == SOCK_DGRAM and opened.getsockopt(SOL_SOCKET, SO_RCVBUF) < _RECEIVE_BYTES:
            with suppress(OSError):
                opened.setsockopt(SOL_SOCKET, _SO_RCVBUFFORCE, _RECEIVE_BYTES)


def _create(number: int, config: str) -> Domain | None:
    """Return a new domain; None if the one that is open in this process already fits."""
    users, variables = _of_user(), discovery(os.environ)
    lines: list[str] = []
    usual, has_interface = variables == discovery({}), bool(users) or "NetworkInterface" in config
    # Each configuration requires less than the one before: there may be no other interface, or no free port.
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
    """Capture Cyclone DDS's output on standard error when it fails: its errors have no text.

    The output of a successful call is written there afterwards.
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
