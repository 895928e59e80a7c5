"""Every kind of fault: its options, and the stage at which it acts."""

from __future__ import annotations

from enum import IntEnum
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from edoras_tools.sessions.faults import values as read

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

REQUIRED: Final = object()
"""Default of an option that must be given."""


class Stage(IntEnum):
    """The order in which faults act, independent of the order of the rules."""

    LOSS = 0
    CONTENT = 1
    RATE = 2
    COPIES = 3
    ORDER = 4
    LINE = 5
    """The line: bandwidth first, then delay, then jitter."""
    DELAY = 6
    JITTER = 7


class Option(NamedTuple):
    """One option of a kind.

    Attributes:
        read: converts text to the value; raises ValueError with a text of the allowed values.
        default: value if the option is missing; ``REQUIRED`` if it must be present.
        doc: description, one line.
    """

    read: Callable[[str], Any]
    default: Any
    doc: str


class FaultKind(msgspec.Struct, frozen=True):
    """One kind of fault.

    Attributes:
        name: name in a rule and in ``/edoras/faults``.
        stage: stage at which it acts.
        doc: description, one line.
        value: name of the option that the text after the colon sets.
        options: options of this kind, besides those of every rule.
    """

    name: str
    stage: Stage
    doc: str
    value: str = "p"
    options: Mapping[str, Option] = msgspec.field(default_factory=dict)


def _one_of(*words: str) -> Callable[[str], str]:
    def choose(text: str) -> str:
        if text not in words:
            raise ValueError(f"one of {', '.join(words)} is needed")
        return text

    return choose


def _field(name: str, doc: str, default: str = "+1") -> FaultKind:
    return FaultKind(
        name,
        Stage.CONTENT,
        doc,
        "value",
        {"value": Option(read.change, read.change(default), f"the new value, or the difference; {default}")},
    )


FAULT_KINDS: Final[Mapping[str, FaultKind]] = {
    kind.name: kind
    for kind in (
        FaultKind("drop", Stage.LOSS, "the datagram is lost"),
        FaultKind(
            "silence",
            Stage.LOSS,
            "nothing passes for this time, like a peer that is down",
            "time",
            {"time": Option(read.time_ns, REQUIRED, "how long")},
        ),
        FaultKind(
            "corrupt",
            Stage.CONTENT,
            "bits are turned over",
            "p",
            {"bits": Option(read.natural, 1, "how many bits; 1")},
        ),
        FaultKind(
            "truncate",
            Stage.CONTENT,
            "the datagram is cut",
            "bytes",
            {"bytes": Option(read.byte_count, REQUIRED, "how many bytes are left")},
        ),
        FaultKind(
            "pad",
            Stage.CONTENT,
            "zero bytes follow the datagram",
            "bytes",
            {"bytes": Option(read.byte_count, REQUIRED, "how many bytes are added")},
        ),
        _field("packet-length", "the packet data length is wrong"),
        FaultKind("checksum", Stage.CONTENT, "the command checksum is wrong"),
        FaultKind(
            "sequence",
            Stage.CONTENT,
            "the sequence count skips ahead and continues from there",
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
        FaultKind(
            "duplicate",
            Stage.COPIES,
            "the datagram arrives more than once",
            "p",
            {"copies": Option(read.natural, 1, "how many more; 1")},
        ),
        FaultKind(
            "rate",
            Stage.RATE,
            "at most so many a second; the others are lost",
            "hz",
            {
                "hz": Option(read.hertz, REQUIRED, "messages a second"),
                "keep": Option(_one_of("first", "latest"), "first", "which ones pass: first, latest"),
                "per": Option(
                    _one_of("msg_id", "link"), "msg_id", "what is limited: each msg_id, or the link"
                ),
            },
        ),
        FaultKind(
            "burst",
            Stage.ORDER,
            "datagrams are collected and sent together",
            "time",
            {"time": Option(read.time_ns, REQUIRED, "how long they are collected")},
        ),
        FaultKind(
            "reorder",
            Stage.ORDER,
            "other datagrams overtake it",
            "p",
            {
                "by": Option(read.natural, 1, "how many overtake it; 1"),
                "within": Option(read.time_ns, 1_000_000_000, "the longest time that it waits; 1s"),
            },
        ),
        FaultKind(
            "bandwidth",
            Stage.LINE,
            "the line transmits so many bits a second",
            "rate",
            {
                "rate": Option(
                    read.bits_per_second, REQUIRED, "bits a second, UDP and IPv4 headers included"
                ),
                "queue": Option(read.volume, 1 << 20, "bytes that may wait for it; more are lost; 1048576"),
            },
        ),
        FaultKind(
            "delay",
            Stage.DELAY,
            "the datagram arrives late",
            "time",
            {"time": Option(read.time_ns, REQUIRED, "how late")},
        ),
        FaultKind(
            "jitter",
            Stage.JITTER,
            "the datagram arrives up to this much later, never before the previous one",
            "time",
            {"time": Option(read.time_ns, REQUIRED, "the largest delay")},
        ),
    )
}
"""The kinds by name."""

PROFILES: Final[Mapping[str, tuple[str, ...]]] = {
    "leo": ("delay:8ms", "jitter:4ms", "bandwidth:2M", "drop:0.001"),
    "geo": ("delay:250ms", "jitter:5ms", "bandwidth:1M", "drop:0.0005"),
    "lunar": ("delay:1282ms", "jitter:2ms", "bandwidth:256k", "drop:0.001"),
    "mars": ("delay:182s", "bandwidth:32k", "drop:0.001"),
}
"""Typical space links, for each direction. Light takes 1.282 s from the Moon at its mean distance, 182 s from
Mars at its nearest, 250 ms up to a geostationary satellite and down again."""
