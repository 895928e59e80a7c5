"""Rules: a fault, the datagrams it strikes, and when; read from ``drop:0.1,msg_id=0x1827`` or a mapping."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

import msgspec

from edoras_tools.errors import ConfigError
from edoras_tools.links import table
from edoras_tools.sessions.faults import kinds as read
from edoras_tools.sessions.faults.kinds import FAULT_KINDS, PROFILES, REQUIRED, FaultKind, Option
from edoras_tools.wire.sbn import MsgType
from edoras_tools.words import did_you_mean

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from edoras_tools.model import Link

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
    "p": Option(read.probability, 1.0, "acts with this probability; 1"),
    "every": Option(read.natural, 0, "acts only on each N-th"),
    "from": Option(read.time_ns, 0, "from this time after the start"),
    "until": Option(read.time_ns, None, "up to this time after the start"),
    "period": Option(read.time_ns, 0, "from and until repeat in each period"),
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
