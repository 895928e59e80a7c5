"""ROS's quality of service as DDS policies, mapped as in rmw_cyclonedds."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from cyclonedds.qos import Policy, Qos
from cyclonedds.util import duration

if TYPE_CHECKING:
    from edoras_tools.middleware import graph

LEAST_WAITING: Final = 1000
"""Samples that may wait for the thread that reads them: about 50 ms at 20,000 a second."""
BLOCKING_MS: Final = 100
"""How long a write waits for readers that are behind: DDS's own default. ROS waits for ever."""
_UNLIMITED: Final = -1


def writer_qos(qos: graph.Qos, user_data: bytes = b"") -> Qos:
    """Return the policies of a writer, and what others are told of it."""
    history = _history(qos.depth)
    kept = Policy.DurabilityService(0, history, _UNLIMITED, _UNLIMITED, _UNLIMITED)
    lifecycle = Policy.WriterDataLifecycle(autodispose=False)
    durable = (kept,) if qos.transient_local else ()
    return Qos(*_common(qos), history, lifecycle, *durable, Policy.Userdata(user_data))


def reader_qos(qos: graph.Qos, user_data: bytes = b"") -> Qos:
    """Return the policies of a reader, and what others are told of it.

    The depth limits how far a subscriber may fall behind. Here that is only as long as a thread takes to wake
    up, and must not cut a burst, so more samples are kept. Of samples from before the subscription, no more
    than the depth are asked for.
    """
    depth = qos.depth if qos.transient_local or not qos.depth else max(qos.depth, LEAST_WAITING)
    return Qos(*_common(qos), _history(depth), Policy.Userdata(user_data))


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
