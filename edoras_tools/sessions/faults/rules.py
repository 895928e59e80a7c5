"""Rules: a fault, the datagrams it strikes, and when; read from ``drop:0.1,msg_id=0x1827`` or a mapping.

Also every kind of fault: its options, the stage at which it acts, and the record of one that struck.

The times, probabilities, counts, rates and field changes of a rule are read from text. Each function that
reads one raises ValueError for another text; the message says which texts are allowed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import msgspec

from edoras_tools.errors import ConfigError
from edoras_tools.links import table
from edoras_tools.model import NO_MSG_ID, Link
from edoras_tools.wire.sbn import MsgType
from edoras_tools.words import did_you_mean


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


DIRECTIONS: Final = {"cfs": True, "ground": False, "bridge": False}
"""Directions in ``to=``: towards cFS (True) or away from it; ``ground`` and ``bridge`` both mean away."""


class RuleScope(msgspec.Struct, frozen=True):
    """The datagrams that a rule applies to; empty is all.

    Attributes:
        links: links of the datagrams.
        to_cfs: direction: towards cFS, away from it, or both (None).
        msg_ids: MsgIds of the packets.
        sbn_types: MsgTypes of SBN datagrams.
        where: filter expression, in the language of ``--where``.
    """

    links: frozenset[Link] = frozenset()
    to_cfs: bool | None = None
    msg_ids: frozenset[int] = frozenset()
    sbn_types: frozenset[int] = frozenset()
    where: str = ""


class Schedule(msgspec.Struct, frozen=True):
    """The datagrams in its scope that a rule strikes.

    Attributes:
        probability: probability with which each one is struck.
        every: number N if only each N-th is struck; 0 for all.
        from_ns: time from which on it strikes, ns since the start.
        until_ns: time up to which it strikes; None for ever.
        period_ns: period in which the time from ``from_ns`` to ``until_ns`` repeats; 0 for never.
    """

    probability: float = 1.0
    every: int = 0
    from_ns: int = 0
    until_ns: int | None = None
    period_ns: int = 0

    def active(self, elapsed: int) -> bool:
        """Return whether the rule is in force ``elapsed`` ns after the start."""
        since = elapsed - self.from_ns
        if since < 0:
            return False
        if self.period_ns:
            since %= self.period_ns
        return self.until_ns is None or since < self.until_ns - self.from_ns


@dataclass(frozen=True, slots=True)
class Rule:
    """One fault, the datagrams it strikes, and when.

    Attributes:
        kind: kind of the fault.
        values: options of the kind, with defaults.
        scope: datagrams that the rule applies to.
        schedule: datagrams among these that it strikes.
        text: the rule as it was written.
        enabled: whether it is in force from the start.
    """

    kind: FaultKind
    values: Mapping[str, Any] = field(hash=False)
    scope: RuleScope = RuleScope()  # noqa: RUF009  frozen
    schedule: Schedule = Schedule()  # noqa: RUF009  frozen
    text: str = ""
    enabled: bool = True

    def __str__(self) -> str:
        return self.text


def _several(one: Callable[[str], Any]) -> Callable[[str], frozenset[Any]]:
    return lambda text: frozenset(one(word.strip()) for word in text.split("|"))


def _msg_id(text: str) -> int:
    try:
        value = int(text, 0)
    except ValueError:
        value = -1
    if not 0 <= value <= 0xFFFF:
        raise ValueError("MsgIds of 16 bits are needed, as 0x1827 or 0x1827|0x1828")
    return value


def _link(text: str) -> Link:
    by_label = {link.label: link for link in table.links() if link.bridge}
    if text.lower() not in by_label:
        raise ValueError(f"one of {', '.join(by_label)} is needed")
    return by_label[text.lower()]


def _direction(text: str) -> bool:
    if text.lower() not in DIRECTIONS:
        raise ValueError(f"one of {', '.join(DIRECTIONS)} is needed")
    return DIRECTIONS[text.lower()]


def _sbn_type(text: str) -> int:
    if text.upper() in MsgType.__members__:
        return int(MsgType[text.upper()])
    try:
        value = int(text, 0)
    except ValueError:
        value = -1
    if not 0 <= value <= 0xFF:
        raise ValueError(f"a number of 8 bits or one of {', '.join(MsgType.__members__)} is needed")
    return value


def _switch(text: str) -> bool:
    words = {"on": True, "off": False, "true": True, "false": False}
    if text.lower() not in words:
        raise ValueError("one of on, off is needed")
    return words[text.lower()]


COMMON: Final[Mapping[str, Option]] = {
    "p": Option(probability, 1.0, "acts with this probability; 1"),
    "every": Option(natural, 0, "acts only on each N-th"),
    "from": Option(time_ns, 0, "from this time after the start"),
    "until": Option(time_ns, None, "up to this time after the start"),
    "period": Option(time_ns, 0, "from and until repeat in each period"),
    "link": Option(_several(_link), frozenset(), "ci, to or sbn"),
    "to": Option(_direction, None, "cfs: towards it; ground: away from it"),
    "msg_id": Option(_several(_msg_id), frozenset(), "MsgId, or several: 0x1827|0x1828"),
    "sbn": Option(_several(_sbn_type), frozenset(), "SBN MsgType, or several: APP|PROTO"),
    "switch": Option(_switch, True, "off: not in force until switched on"),
    "where": Option(str, "", "filter expression; the last option, as it may hold commas"),
}
"""Options that every rule takes."""


def parse_rule(text: str) -> Rule:
    """Read a rule: ``KIND[:VALUE][,OPTION=VALUE]...``, as ``drop:0.1`` or ``delay:200ms,msg_id=0x1827``.

    Raises:
        ConfigError: the rule has mistakes; the text names all of them.
    """
    head, _, rest = text.partition(",")
    name, colon, value = (part.strip() for part in head.partition(":"))
    words: list[tuple[str, str | None]] = [("", value)] if colon else []
    while rest:
        if rest.lstrip().startswith("where"):
            item, rest = rest, ""
        else:
            item, _, rest = rest.partition(",")
        key, equals, value = (part.strip() for part in item.partition("="))
        words.append((key or ",", value if equals else None))
    rule, mistakes = make_rule(name, words, text)
    if rule is None:
        raise ConfigError(*(f"fault {text}: {text_}" for _, text_ in mistakes))
    return rule


def make_rule(
    name: str, words: Iterable[tuple[str, str | None]], text: str
) -> tuple[Rule | None, list[tuple[str, str]]]:
    """Make a rule of its kind and options.

    Args:
        name: name of the kind.
        words: option and text of its value, None if it had none; the option ``""`` is the kind's own.
        text: the rule as it was written.

    Returns:
        The rule, or None, and the mistakes: option and text.
    """
    kind = FAULT_KINDS.get(name)
    if kind is None:
        return None, [(name, f"no such fault {name!r}; {_choices(name, FAULT_KINDS)}")]
    options = {**COMMON, **kind.options}
    parsed: dict[str, Any] = {}
    mistakes = []
    for word, value in words:
        key = word or kind.value
        if key not in options:
            mistakes.append((word, f"{name} takes no {key!r}; {_choices(key, options)}"))
        elif key in parsed:
            mistakes.append((word, f"{key} is given twice; once is enough"))
        elif value is None:
            mistakes.append((word, f"{key} has no value; write {key}=VALUE"))
        else:
            parsed[key] = options[key].default
            try:
                parsed[key] = options[key].read(value)
            except ValueError as error:
                mistakes.append((word, f"{key} {value!r}: {error}"))
    missing = [key for key, option in options.items() if option.default is REQUIRED and key not in parsed]
    mistakes += [("", f"{name} needs {key}: {options[key].doc}") for key in missing]
    values = {key: parsed.get(key, option.default) for key, option in options.items()}
    if not mistakes:
        mistakes += _contradictions(values)
    if mistakes:
        return None, mistakes
    scope = RuleScope(values["link"], values["to"], values["msg_id"], values["sbn"], values["where"])
    schedule = Schedule(values["p"], values["every"], values["from"], values["until"], values["period"])
    parameters = MappingProxyType({key: values[key] for key in kind.options})
    return Rule(kind, parameters, scope, schedule, text, values["switch"]), []


def parse_profile(name: str) -> tuple[Rule, ...]:
    """Return the rules of a named link.

    Raises:
        ConfigError: there is none of that name.
    """
    if name not in PROFILES:
        raise ConfigError(f"no such profile {name!r}; {_choices(name, PROFILES)}")
    return tuple(parse_rule(text) for text in PROFILES[name])


def _contradictions(values: Mapping[str, Any]) -> list[tuple[str, str]]:
    until, period = values["until"], values["period"]
    if until is not None and until <= values["from"]:
        return [("until", "until is not later than from; the rule would never act")]
    if period and until is not None and until - values["from"] > period:
        return [("period", "period is shorter than from until to; lengthen it")]
    return []


def _choices(word: str, choices: Iterable[str]) -> str:
    names = list(choices)
    return f"{did_you_mean(word, names, 1)} there are {', '.join(names)}".lstrip()
