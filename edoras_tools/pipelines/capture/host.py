"""The kernel's counters of this host while a link is recorded, and the advice that follows from losses."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final

from edoras_tools.cfs.profile import SimProfile
from edoras_tools.io.host import read_host
from edoras_tools.units import SECOND
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Container, Iterator

    from edoras_tools.model import HostCounters

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
