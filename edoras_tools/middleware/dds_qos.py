"""ROS's quality of service as DDS policies, the way rmw_cyclonedds maps it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from cyclonedds.qos import Policy, Qos
from cyclonedds.util import duration

if TYPE_CHECKING:
    from edoras_tools.middleware import graph

LEAST_WAITING: Final = 1000
"""Samples that may wait for the thread that hands them on: some 50 ms at 20,000 a second."""
BLOCKING_MS: Final = 100
"""How long a write waits for readers that are behind: DDS's own default. ROS waits for ever."""
_UNLIMITED: Final = -1


def writer_qos(qos: graph.Qos) -> Qos:
    """Return the policies of a writer."""
    history = _history(qos.depth)
    kept = Policy.DurabilityService(0, history, _UNLIMITED, _UNLIMITED, _UNLIMITED)
    lifecycle = Policy.WriterDataLifecycle(autodispose=False)
    return Qos(*_common(qos), history, lifecycle, *((kept,) if qos.transient_local else ()))


def reader_qos(qos: graph.Qos) -> Qos:
    """Return the policies of a reader.

    The depth bounds how far behind a subscriber may be. Here nobody is behind for longer than a thread takes
    to wake up, and a burst must not be cut by that; only of what was before us no more than asked for comes.
    """
    depth = qos.depth if qos.transient_local or not qos.depth else max(qos.depth, LEAST_WAITING)
    return Qos(*_common(qos), _history(depth))


def _common(qos: graph.Qos) -> tuple[Any, ...]:
    return (
        Policy.Reliability.Reliable(duration(milliseconds=BLOCKING_MS))
        if qos.reliable
        else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if qos.transient_local else Policy.Durability.Volatile,
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.IgnoreLocal.Participant,
    )


def _history(depth: int) -> Any:
    return Policy.History.KeepLast(depth) if depth else Policy.History.KeepAll
