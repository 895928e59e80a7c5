"""The kernel's counters of this host while a link is recorded, and the advice that follows from losses.

Everything is read from ``/proc``; no privilege is needed. The sockets are those of this network namespace.
"""

from __future__ import annotations

import os
import socket
import struct
import time
from collections.abc import Container, Iterator
from ipaddress import ip_address
from pathlib import Path
from typing import Final

from edoras_tools.cfs.profile import SimProfile
from edoras_tools.model import HostCounters, SocketCounters
from edoras_tools.units import SECOND
from edoras_tools.words import plural

ENOUGH_BYTES: Final = 4 << 20
"""Size of a socket buffer that holds some seconds of these links' traffic."""
ENOUGH_MESSAGES: Final = 256
"""Depth of a message queue that is not less than that of any pipe of cFS."""
MUCH_STEAL: Final = 0.05


class HostWatch:
    """Reads the counters once a second.

    Args:
        ports: UDP ports of the links.
    """

    def __init__(self, ports: Container[int]) -> None:
        self._ports, self._due = ports, 0

    def due(self) -> HostCounters | None:
        """Return the counters if a second has passed since the last time, else None."""
        return self.now() if time.monotonic_ns() >= self._due else None

    def now(self) -> HostCounters:
        """Return the counters now."""
        self._due = time.monotonic_ns() + SECOND
        return read_host(self._ports, time.time_ns())


def steal(host: HostCounters) -> float | None:
    """Return the share of processor time that the hypervisor took; None if unknown."""
    return host.steal_ticks / host.cpu_ticks if host.steal_ticks is not None and host.cpu_ticks else None


def advice(host: HostCounters) -> Iterator[str]:
    """Yield advice with its reason, one line each; a command is at the end of its line."""
    dropped = sum(item.drops for item in host.sockets)
    if dropped and host.rmem_default is not None and host.rmem_default < ENOUGH_BYTES:
        yield (
            f"{plural(dropped, 'datagram')} dropped in full sockets: make their buffers larger, then start "
            f"their programs again: sudo sysctl -w net.core.rmem_default={ENOUGH_BYTES}"
        )
    if host.rmem_max is not None and host.rmem_max < ENOUGH_BYTES:
        yield (
            "programs that ask for a larger buffer do not get it: "
            f"sudo sysctl -w net.core.rmem_max={ENOUGH_BYTES}"
        )
    deepest = SimProfile().to_pipe_depth
    if host.msg_max is not None and host.msg_max < deepest:
        yield (
            f"a cFS that runs here cuts its pipes to {host.msg_max} messages (Telemetry Output's has "
            f"{deepest}): sudo sysctl -w fs.mqueue.msg_max={ENOUGH_MESSAGES}"
        )
    share = steal(host)
    if share is not None and share > MUCH_STEAL:
        yield f"this machine waits for its own host in {share:.0%} of the time: give it processors of its own"


PROC: Final = Path("/proc")
_DROPS: Final = 12
"""Column of ``/proc/net/udp``; the inode is three before it."""
_INTERFACE_DROPS: Final = 3
_STEAL: Final = 7
_READ_BYTES: Final = 1 << 16
_PROTOCOLS: Final = ("Ip:", "Udp:")
"""Protocols whose counters are read."""


def read_host(ports: Container[int], time_ns: int, proc: Path = PROC) -> HostCounters:
    """Return the kernel's counters now.

    Args:
        ports: UDP ports whose sockets to read.
        time_ns: present time, ns since 1970.
        proc: folder of the kernel's files.
    """
    snmp, snmp6 = _pairs(_text(f"{proc}/net/snmp")), _text(f"{proc}/net/snmp6").split()
    later = dict(zip(snmp6[::2], snmp6[1::2], strict=False))
    ticks = [int(item) for item in _text(f"{proc}/stat").partition("\n")[0].split()[1:]]
    return HostCounters(
        time_ns,
        tuple(item for name in ("udp", "udp6") for item in _sockets(_text(f"{proc}/net/{name}"), ports)),
        receive_buffer_errors=_sum(snmp.get("Udp.RcvbufErrors"), later.get("Udp6RcvbufErrors")),
        reassembly_failures=_sum(snmp.get("Ip.ReasmFails"), later.get("Ip6ReasmFails")),
        interface_drops=_interface_drops(_text(f"{proc}/net/dev")),
        cpu_ticks=sum(ticks[: _STEAL + 1]) if ticks else None,
        steal_ticks=ticks[_STEAL] if len(ticks) > _STEAL else None,
        msg_max=_number(f"{proc}/sys/fs/mqueue/msg_max"),
        rmem_default=_number(f"{proc}/sys/net/core/rmem_default"),
        rmem_max=_number(f"{proc}/sys/net/core/rmem_max"),
    )


def _text(path: str) -> str:
    """Return a file's text, with as few system calls as possible: this runs once a second."""
    try:
        file = os.open(path, os.O_RDONLY)
    except OSError:
        return ""
    parts = []
    try:
        while part := os.read(file, _READ_BYTES):
            parts.append(part)
    except OSError:
        return ""
    finally:
        os.close(file)
    return b"".join(parts).decode("ascii", "replace")


def _number(path: str) -> int | None:
    text = _text(path).strip()
    return int(text) if text.isdecimal() else None


def _sum(*values: str | None) -> int | None:
    numbers = [int(item) for item in values if item is not None]
    return sum(numbers) if numbers else None


def _pairs(text: str) -> dict[str, str]:
    """Return counters of ``/proc/net/snmp``, where a line of names precedes each line of values."""
    lines = [line.split() for line in text.splitlines() if line.startswith(_PROTOCOLS)]
    return {
        names[0].replace(":", ".") + name: value
        for names, values in zip(lines[::2], lines[1::2], strict=False)
        for name, value in zip(names[1:], values[1:], strict=False)
    }


def _sockets(text: str, ports: Container[int]) -> Iterator[SocketCounters]:
    for line in text.splitlines()[1:]:
        cells = line.split()
        if len(cells) <= _DROPS:
            continue
        address, _, port = cells[1].partition(":")
        if int(port, 16) in ports:
            yield SocketCounters(
                int(port, 16),
                _address(address),
                inode=int(cells[_DROPS - 3]),
                queued=int(cells[4].partition(":")[2], 16),
                drops=int(cells[_DROPS]),
            )


def _address(text: str) -> str:
    """Return an address of ``/proc/net/udp``: words of 32 bits in the machine's byte order."""
    words = struct.pack(f"={len(text) // 8}I", *(int(text[at : at + 8], 16) for at in range(0, len(text), 8)))
    return str(ip_address(socket.inet_ntoa(words) if len(words) == 4 else words))


def _interface_drops(text: str) -> int | None:
    rows = [line.partition(":")[2].split() for line in text.splitlines() if ":" in line]
    return sum(int(row[_INTERFACE_DROPS]) for row in rows if len(row) > _INTERFACE_DROPS) if rows else None
