"""Results that are expected after sending: an event, a packet, or a counter that grows."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final

import msgspec

from edoras_tools.errors import ConfigError, TruncatedError
from edoras_tools.pipelines.names import find_packets
from edoras_tools.structs.table import Structs
from edoras_tools.wire import cfe
from edoras_tools.words import did_you_mean

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.decode import Context

_NOBODY: Final = (0, 0, 0, 0, 0)
"""Origin of a packet whose origin does not matter."""


class Expectation(msgspec.Struct):
    """One expected result.

    Attributes:
        words: expectation as it was written.
        msg_ids: MsgIds of packets that can show the result.
        text: expected part of an event's text; empty if no event is expected.
        field: path of a counter; empty if no counter is expected to grow.
        growth: least growth of the counter.
        met: whether the result has come.
        outcome: text on what has come.
    """

    words: str
    msg_ids: frozenset[int]
    text: str = ""
    field: str = ""
    growth: int = 1
    met: bool = False
    outcome: str = "nothing came"
    _count: int = 0
    _base: int | None = None

    def take(self, data: bytes, structs: Structs, *, counts: bool) -> None:
        """Process a packet with one of the MsgIds.

        Args:
            data: a telemetry packet.
            structs: structs of the counters.
            counts: whether sending has begun; before that, counters only get their base value.
        """
        if self.text:
            self._event(data, counts=counts)
        elif self.field:
            self._counter(data, structs, counts=counts)
        elif counts:
            self._count += 1
            self.met = True
            self.outcome = f"came {self._count:,} times" if self._count > 1 else "came once"

    def _event(self, data: bytes, *, counts: bool) -> None:
        if not counts or self.met:
            return
        values = cfe.EVENT.parse(data, cfe.TELEMETRY_HEADER_BYTES)
        text = f"{values['app_name']} {values['event_id']}: {values['message'].strip()}"
        self._count += 1
        self.met = self.text in text
        self.outcome = text if self.met else f"other events came: {self._count:,}"

    def _counter(self, data: bytes, structs: Structs, *, counts: bool) -> None:
        body = data[cfe.TELEMETRY_HEADER_BYTES :]
        bound = structs.find(structs.msg_ids.of(data), None, len(body))
        if bound is None or not bound.fits(len(body)):
            return
        values: Any = structs.types.decode(bound.type, bound.encode_one(body, _NOBODY))
        for name in self.field.split("."):
            values = values[name]
        value = int(values)
        if not counts or self._base is None:
            self._base = value
        self.outcome = f"{self._base} → {value}"
        self.met = self.met or (counts and value - self._base >= self.growth)


class AwaitedResults(msgspec.Struct):
    """All expected results, and the time to wait for them.

    Attributes:
        items: expected results.
        within_ns: time to wait after the last datagram, ns.
    """

    items: Sequence[Expectation] = ()
    within_ns: int = 0
    _structs: Structs = msgspec.field(default_factory=Structs)
    _running: bool = False

    @classmethod
    def of(cls, texts: Sequence[str], within_ns: int, context: Context) -> AwaitedResults:
        """Read expectations: ``event:TEXT``, ``counter:NAME.FIELD[+N]``, or a name that tables show.

        Raises:
            ConfigError: one is not of these forms, or there is no such counter.
            RouteError: a name has no packets.
        """
        return cls([_read(text, context) for text in texts], within_ns, context.structs)

    @property
    def missing(self) -> list[Expectation]:
        """Expected results that have not come."""
        return [item for item in self.items if not item.met]

    def begin(self) -> None:
        """Record that sending begins."""
        self._running = True

    def take(self, data: bytes) -> None:
        """Process a received packet; any bytes are accepted."""
        msg_id = self._structs.msg_ids.of(data)
        for item in self.items:
            if msg_id in item.msg_ids:
                with suppress(TruncatedError):
                    item.take(data, self._structs, counts=self._running)

    def as_json(self) -> list[dict[str, Any]]:
        """Return ``expected`` of ``replay --json``."""
        return [{"expect": item.words, "met": item.met, "found": item.outcome} for item in self.items]


def _read(words: str, context: Context) -> Expectation:
    kind, colon, rest = words.partition(":")
    if kind == "event" and rest:
        return Expectation(words, frozenset({context.msg_ids.of_known(cfe.EVENT_MSG_ID)}), text=rest)
    if kind == "counter" and rest:
        return _counter(words, rest, context)
    if colon or not words:
        raise ConfigError(
            f"--expect {words!r} is not known; there are event:TEXT, counter:NAME.FIELD[+N], "
            "and topics, MsgIds and names that tables show"
        )
    kinds = find_packets(words, context)
    ids = frozenset(kinds.msg_ids(context.mission))
    if not ids:
        raise ConfigError(f"--expect {words!r}: it has no MsgId, so nothing that is received can show it")
    return Expectation(words, ids)


def _counter(words: str, text: str, context: Context) -> Expectation:
    path, plus, number = text.partition("+")
    name, dot, member = path.partition(".")
    form = "write counter:TO_HK.command_counter, or +3 behind it"
    if not (dot and member) or (plus and not number.isdecimal()):
        raise ConfigError(f"--expect {words!r} names no counter: {form}")
    ids = frozenset(find_packets(name, context).msg_ids(context.mission))
    bound = next((item for item in context.structs.all if item.key.msg_id in ids), None)
    if bound is None:
        raise ConfigError(
            f"--expect {words!r}: no C struct is known for {name}; name its layout with --set structs"
        )
    values = context.structs.types.decode(bound.type, bound.encode_one(bytes(bound.size), _NOBODY))
    fields = [path for path, value, *_ in bound.spans(values, bound.size) if isinstance(value, int)]
    if member not in fields:
        hint = did_you_mean(member, fields, 1) or f"there are {', '.join(fields)}"
        raise ConfigError(f"--expect {words!r}: {member!r} is no counter of {bound.name}; {hint}")
    return Expectation(words, ids, field=member, growth=int(number or 1))
