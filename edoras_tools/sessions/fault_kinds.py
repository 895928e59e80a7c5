"""Every kind of fault: what it is told, in which words, and at which stage of a datagram's way it strikes."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from edoras_tools.sessions import fault_values as read

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

REQUIRED: Final = object()
"""Default of an option that must be given."""


class Stage(IntEnum):
    """When a fault strikes: whatever order rules are written in, they act in this one."""

    LOSS = 0
    CONTENT = 1
    RATE = 2
    COPIES = 3
    ORDER = 4
    LINE = 5
    """What the line itself takes: bandwidth, then delay, then jitter."""
    DELAY = 6
    JITTER = 7


class Option(NamedTuple):
    """One thing that a kind is told.

    Attributes:
        read: text to value; raises ValueError with what is allowed.
        default: the value where it is not given; ``REQUIRED`` where it must be.
        doc: one line.
    """

    read: Callable[[str], Any]
    default: Any
    doc: str


@dataclass(frozen=True, slots=True)
class Kind:
    """One kind of fault.

    Attributes:
        name: as in a rule and in ``/edoras/faults``.
        stage: when it strikes.
        doc: one line.
        value: which option the word behind the colon gives.
        options: what it is told besides what every rule takes.
    """

    name: str
    stage: Stage
    doc: str
    value: str = "p"
    options: Mapping[str, Option] = field(default_factory=dict)


def _one_of(*words: str) -> Callable[[str], str]:
    def choose(text: str) -> str:
        if text not in words:
            raise ValueError(f"one of {', '.join(words)} is needed")
        return text

    return choose


def _field(name: str, doc: str, default: str = "+1") -> Kind:
    return Kind(
        name,
        Stage.CONTENT,
        doc,
        "value",
        {
            "value": Option(
                read.change, read.change(default), f"what it becomes, or by how much it is off; {default}"
            )
        },
    )


KINDS: Final[Mapping[str, Kind]] = {
    kind.name: kind
    for kind in (
        Kind("drop", Stage.LOSS, "the datagram is gone"),
        Kind(
            "silence",
            Stage.LOSS,
            "nothing passes for so long: a peer that is gone",
            "time",
            {"time": Option(read.time_ns, REQUIRED, "how long")},
        ),
        Kind(
            "corrupt",
            Stage.CONTENT,
            "bits are turned over",
            "p",
            {"bits": Option(read.natural, 1, "how many bits; 1")},
        ),
        Kind(
            "truncate",
            Stage.CONTENT,
            "the datagram is cut",
            "bytes",
            {"bytes": Option(read.size, REQUIRED, "how many bytes are left")},
        ),
        Kind(
            "pad",
            Stage.CONTENT,
            "zero bytes follow the datagram",
            "bytes",
            {"bytes": Option(read.size, REQUIRED, "how many bytes are added")},
        ),
        _field("packet-length", "the packet data length is wrong"),
        Kind("checksum", Stage.CONTENT, "the command checksum is wrong"),
        Kind(
            "sequence",
            Stage.CONTENT,
            "the sequence count skips ahead, and goes on from there",
            "by",
            {"by": Option(read.natural, 1, "how many counts are skipped; 1")},
        ),
        _field("envelope-length", "the envelope's buffer_length is wrong"),
        _field("envelope-capacity", "the envelope's buffer_capacity is wrong", "0"),
        _field("encapsulation", "the CDR representation is wrong", "0xFFFF"),
        _field("sbn-size", "SBN's MsgSz is wrong"),
        _field("sbn-type", "SBN's MsgType is wrong", "0x07"),
        _field("sbn-processor", "SBN's ProcessorID is wrong"),
        _field("sbn-spacecraft", "SBN's SpacecraftID is wrong"),
        Kind(
            "duplicate",
            Stage.COPIES,
            "the datagram comes more than once",
            "p",
            {"copies": Option(read.natural, 1, "how many more; 1")},
        ),
        Kind(
            "rate",
            Stage.RATE,
            "no more than so many a second; the others are gone",
            "hz",
            {
                "hz": Option(read.hertz, REQUIRED, "messages a second"),
                "keep": Option(_one_of("first", "latest"), "first", "which of those too many: first, latest"),
                "per": Option(
                    _one_of("msg_id", "link"), "msg_id", "what is limited: each msg_id, or the link"
                ),
            },
        ),
        Kind(
            "burst",
            Stage.ORDER,
            "datagrams gather, and all go at once",
            "time",
            {"time": Option(read.time_ns, REQUIRED, "how long they gather")},
        ),
        Kind(
            "reorder",
            Stage.ORDER,
            "others overtake the datagram",
            "p",
            {
                "by": Option(read.natural, 1, "how many overtake it; 1"),
                "within": Option(read.time_ns, 1_000_000_000, "it waits so long at most; 1s"),
            },
        ),
        Kind(
            "bandwidth",
            Stage.LINE,
            "the line carries so many bits a second",
            "rate",
            {
                "rate": Option(
                    read.bits_per_second, REQUIRED, "bits a second, UDP and IPv4 headers included"
                ),
                "queue": Option(read.volume, 1 << 20, "bytes that may wait for it; more are gone; 1048576"),
            },
        ),
        Kind(
            "delay",
            Stage.DELAY,
            "the datagram comes late",
            "time",
            {"time": Option(read.time_ns, REQUIRED, "how late")},
        ),
        Kind(
            "jitter",
            Stage.JITTER,
            "the datagram comes up to so late, never before the one before it",
            "time",
            {"time": Option(read.time_ns, REQUIRED, "how late at most")},
        ),
    )
}
"""By name."""

PROFILES: Final[Mapping[str, tuple[str, ...]]] = {
    "leo": ("delay:8ms", "jitter:4ms", "bandwidth:2M", "drop:0.001"),
    "geo": ("delay:250ms", "jitter:5ms", "bandwidth:1M", "drop:0.0005"),
    "lunar": ("delay:1282ms", "jitter:2ms", "bandwidth:256k", "drop:0.001"),
    "mars": ("delay:182s", "bandwidth:32k", "drop:0.001"),
}
"""Links as they may be, each way: light takes 1.282 s from the Moon's mean distance, 182 s from Mars at its
nearest; 250 ms is up to a geostationary satellite and down again."""
