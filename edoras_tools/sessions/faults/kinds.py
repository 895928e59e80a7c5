"""Every kind of fault: its options, the stage at which it acts, and the record of one that struck.

The times, probabilities, counts, rates and field changes of a rule are read from text. Each function that
reads one raises ValueError for another text; the message says which texts are allowed.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from edoras_tools.model import NO_MSG_ID, Link

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping


class Fault(NamedTuple):
    """One fault of one datagram, as it is recorded.

    Attributes:
        time_ns: time at which the datagram came, on the caller's clock.
        kind: name of the kind, or ``overflow`` if ``HOLD_BYTES`` were exceeded.
        detail: description of the change.
        original: bytes of the datagram as it came.
        link: link of the datagram.
        to_cfs: whether it went to cFS.
        msg_id: its MsgId; ``NO_MSG_ID`` if it has none.
        rule: text of the rule.
        stream: number of the sender.
    """

    time_ns: int
    kind: str
    detail: str
    original: bytes
    link: Link
    to_cfs: bool
    msg_id: int = NO_MSG_ID
    rule: str = ""
    stream: int = 0


_TIMES = {"ns": 1, "us": 10**3, "ms": 10**6, "s": 10**9, "m": 60 * 10**9, "h": 3600 * 10**9}
_MULTIPLES = {"k": 10**3, "M": 10**6, "G": 10**9}
_LONGEST_NS = 1 << 60


class NumberChange(NamedTuple):
    """A change of a number: ``+3`` and ``-3`` are added, ``12`` replaces it.

    Attributes:
        amount: number to add, or the new value.
        relative: whether to add it.
    """

    amount: int
    relative: bool

    def apply(self, value: int) -> int:
        """Return the changed number."""
        return value + self.amount if self.relative else self.amount


def time_ns(text: str) -> int:
    """Read a length of time in ns: ``200ms``, ``1.5s``, ``2m``; a bare number is seconds."""
    unit = next((name for name in sorted(_TIMES, key=len, reverse=True) if text.endswith(name)), "")
    value = _decimal(text.removesuffix(unit)) * _TIMES.get(unit, 10**9)
    if not 0 <= value < _LONGEST_NS:  # also if it is not a number
        raise ValueError("a length of time is needed, as 200ms, 1.5s or 2m")
    return int(value)


def probability(text: str) -> float:
    """Read a probability: ``0.1``, ``10%``."""
    value = _decimal(text.removesuffix("%")) / (100 if text.endswith("%") else 1)
    if not 0 <= value <= 1:
        raise ValueError("a probability is needed, from 0 to 1 or from 0% to 100%")
    return value


def natural(text: str) -> int:
    """Read a count, 1 or more, decimal or hex."""
    value = _integer(text)
    if value is None or not 1 <= value < 1 << 32:
        raise ValueError("a whole number is needed, 1 or more")
    return value


def byte_count(text: str) -> int:
    """Read a number of bytes, 0 to 65,507: ``40``, ``0x40``."""
    value = _integer(text)
    if value is None or not 0 <= value <= 65507:
        raise ValueError("a number of bytes is needed, from 0 to 65507")
    return value


def volume(text: str) -> int:
    """Read an amount of bytes: ``65536``, ``64k``, ``2M``."""
    value = _decimal(text.removesuffix(text[-1:] if text[-1:] in _MULTIPLES else "")) * _MULTIPLES.get(
        text[-1:], 1
    )
    if not 1 <= value < 1 << 40:
        raise ValueError("an amount of bytes is needed, as 65536, 64k or 2M")
    return int(value)


def hertz(text: str) -> float:
    """Read a rate in messages a second: ``30``, ``0.5``, ``30Hz``."""
    value = _decimal(text.removesuffix("Hz").removesuffix("hz"))
    if not 1e-6 <= value <= 1e9:
        raise ValueError("a rate is needed, above 0, as 30 or 0.5Hz")
    return value


def bits_per_second(text: str) -> float:
    """Read a bandwidth in bits a second: ``9600``, ``128k``, ``2M``, with or without ``bit/s``."""
    text = text.removesuffix("bit/s").removesuffix("bit")
    unit = text[-1:] if text[-1:] in _MULTIPLES else ""
    value = _decimal(text.removesuffix(unit)) * _MULTIPLES.get(unit, 1)
    if not 1 <= value <= 1e15:
        raise ValueError("a bandwidth in bits a second is needed, as 9600, 128k or 2M")
    return value


def change(text: str) -> NumberChange:
    """Read a change of a field: ``+3``, ``-3``, ``12``, ``0xFFFF``."""
    value = _integer(text)
    if value is None or abs(value) >= 1 << 64:
        raise ValueError("a number to set is needed, as 12, or one to add, as +3 or -3")
    return NumberChange(value, text[:1] in {"+", "-"})


def _decimal(text: str) -> float:
    """Return a number, or NaN, which fits no limits."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def _integer(text: str) -> int | None:
    try:
        return int(text, 0)
    except ValueError:
        return None


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
        {"value": Option(change, change(default), f"the new value, or the difference; {default}")},
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
            {"time": Option(time_ns, REQUIRED, "how long")},
        ),
        FaultKind(
            "corrupt",
            Stage.CONTENT,
            "bits are turned over",
            "p",
            {"bits": Option(natural, 1, "how many bits; 1")},
        ),
        FaultKind(
            "truncate",
            Stage.CONTENT,
            "the datagram is cut",
            "bytes",
            {"bytes": Option(byte_count, REQUIRED, "how many bytes are left")},
        ),
        FaultKind(
            "pad",
            Stage.CONTENT,
            "zero bytes follow the datagram",
            "bytes",
            {"bytes": Option(byte_count, REQUIRED, "how many bytes are added")},
        ),
        _field("packet-length", "the packet data length is wrong"),
        FaultKind("checksum", Stage.CONTENT, "the command checksum is wrong"),
        FaultKind(
            "sequence",
            Stage.CONTENT,
            "the sequence count skips ahead and continues from there",
            "by",
            {"by": Option(natural, 1, "how many counts are skipped; 1")},
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
            {"copies": Option(natural, 1, "how many more; 1")},
        ),
        FaultKind(
            "rate",
            Stage.RATE,
            "at most so many a second; the others are lost",
            "hz",
            {
                "hz": Option(hertz, REQUIRED, "messages a second"),
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
            {"time": Option(time_ns, REQUIRED, "how long they are collected")},
        ),
        FaultKind(
            "reorder",
            Stage.ORDER,
            "other datagrams overtake it",
            "p",
            {
                "by": Option(natural, 1, "how many overtake it; 1"),
                "within": Option(time_ns, 1_000_000_000, "the longest time that it waits; 1s"),
            },
        ),
        FaultKind(
            "bandwidth",
            Stage.LINE,
            "the line transmits so many bits a second",
            "rate",
            {
                "rate": Option(bits_per_second, REQUIRED, "bits a second, UDP and IPv4 headers included"),
                "queue": Option(volume, 1 << 20, "bytes that may wait for it; more are lost; 1048576"),
            },
        ),
        FaultKind(
            "delay",
            Stage.DELAY,
            "the datagram arrives late",
            "time",
            {"time": Option(time_ns, REQUIRED, "how late")},
        ),
        FaultKind(
            "jitter",
            Stage.JITTER,
            "the datagram arrives up to this much later, never before the previous one",
            "time",
            {"time": Option(time_ns, REQUIRED, "the largest delay")},
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
