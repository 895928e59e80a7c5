"""Follows one message of a capture, or one topic through the rounds of its queue.

The way of a message is a view of the ledger, the matched streams and the rounds of queues. Rules:

1. A message is followed by its values: back to its first capture, and on to where it comes out. Times of
   datagrams are measured; all other times lie between two of these, and are marked with their evidence.
2. Its ending is that of the ledger. An entry with as many messages as candidates proves the ending of each.
   So does a single kind of ending that is left for all undecided messages.
3. In other cases the queue model may explain the ending: ``by model``. Else it is unknown, and the possible
   endings are listed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, Final, Literal

import msgspec
import numpy as np
from msgspec.structs import asdict, replace

from edoras_tools.addons.trace.rounds import Rounds, Timing, TopicRates, rounds_into, rounds_out, topic_rates
from edoras_tools.diagnosis.accounting.losses import Among
from edoras_tools.diagnosis.case import Case
from edoras_tools.diagnosis.evidence.instances import NOBODY
from edoras_tools.diagnosis.evidence.relays import proxied
from edoras_tools.diagnosis.examination import Chapter, Diagnosis, Examination, judge_single
from edoras_tools.diagnosis.ledger import APPLICATION, CAPTURE, ENDING_TEXTS, LedgerEntry, LedgerWay
from edoras_tools.diagnosis.matching.crossing import Hop, Latency, latency_of
from edoras_tools.diagnosis.missing import Missing, missing
from edoras_tools.errors import RouteError
from edoras_tools.model import NO_MSG_ID
from edoras_tools.sessions.sequence import MODULUS
from edoras_tools.words import did_you_mean, plural

if TYPE_CHECKING:
    from edoras_tools.decode import Context
    from edoras_tools.diagnosis.evidence.table import Recorder
    from edoras_tools.diagnosis.matching.streams import Stream

Witness = Literal["proven", "measured", "by model", "unknown"]
"""Proven: by counters, counts or values. Measured: the time of a datagram. By model: queues explain it."""
_NOT_SEEN: Final = "not seen in a capture: give doctor the --bag of its side"
PASSED_ON: Final = "passed on by the application, and lost behind it"


class TraceStep(msgspec.Struct, frozen=True):
    """One place on the way of a message.

    Attributes:
        hop: name of the place.
        text: event there.
        witness: evidence.
        time_ns: time, ns since 1970; None if unknown.
        packet: number of its datagram in the capture, from 1; None if there is none.
        waiting: messages of its MsgId that waited in front of it; None if unknown.
        limit: number of them that may wait.
    """

    hop: str
    text: str
    witness: Witness
    time_ns: int | None = None
    packet: int | None = None
    waiting: int | None = None
    limit: int | None = None


class MessageEnd(msgspec.Struct, frozen=True):
    """The end of a message's way.

    Attributes:
        ending: ``delivered``, ``sent_out`` (captured on its way out; nothing shows its reception), an ending
            of the ledger, or ``open``: one of several.
        hop: name of the place.
        text: the ending for people.
        witness: evidence.
        cause: cause of a loss.
        one_of: number of messages of which some ended like this, if they are not identified; else None.
    """

    ending: str
    hop: str
    text: str
    witness: Witness
    cause: str = ""
    one_of: int | None = None


class MessageTrace(msgspec.Struct, frozen=True):
    """The way of one message.

    Attributes:
        topic: configured topic, else the packet's name, or None.
        link: label of the link on which it is first seen.
        msg_id: cFE MsgId there.
        nth: number among the messages of that stream, from 1, including missing ones.
        of: number of these messages.
        steps: places on its way, in order.
        ended: end of the way.
        delay_ns: time from the first to the last known time, ns; None if there is only one.
        usual: latency of all messages on this way, as in ``doctor -v``; None if there are none.
        also: its further ways, if it came out more than once.
    """

    topic: str | None
    link: str
    msg_id: int
    nth: int
    of: int
    steps: tuple[TraceStep, ...]
    ended: MessageEnd
    delay_ns: int | None
    usual: Latency | None
    also: tuple[MessageTrace, ...] = ()

    @property
    def delay_witness(self) -> Witness:
        """Evidence of ``delay_ns``: by model if other messages had equal values, or if a queue ended it."""
        timed = [step.witness for step in self.steps if step.time_ns is not None]
        is_guess = any(step.hop == APPLICATION and step.witness == "by model" for step in self.steps)
        return "by model" if is_guess or timed[-1] == "by model" else "measured"

    @property
    def after_ns(self) -> list[int | None]:
        """For each step, the time since the previous step that has one, ns; they add up to ``delay_ns``."""
        out: list[int | None] = []
        before: int | None = None
        for step in self.steps:
            out.append(None if step.time_ns is None or before is None else step.time_ns - before)
            before = before if step.time_ns is None else step.time_ns
        return out

    def as_json(self) -> dict[str, Any]:
        """Return the trace in the shape of ``trace --json``."""
        return {
            **asdict(self),
            "msg_id": None if self.msg_id == NO_MSG_ID else f"0x{self.msg_id:04x}",
            "steps": [
                {**asdict(step), "after_ns": after_ns}
                for step, after_ns in zip(self.steps, self.after_ns, strict=True)
            ],
            "ended": asdict(self.ended),
            "delay_witness": None if self.delay_ns is None else self.delay_witness,
            "usual": self.usual.as_json() if self.usual else None,
            "also": [item.as_json() for item in self.also],
        }


class _Leg(msgspec.Struct, frozen=True):
    """A message in one stream: its row, or its position behind a row if it is missing."""

    stream: Stream
    row: int
    behind: int = 0

    @property
    def at(self) -> int:
        """Row in the capture of the message, or of the one before it."""
        return int(self.stream.rows[self.row])


class Tracer:
    """Follows messages of a capture that is judged."""

    def __init__(self, case: Case) -> None:
        self._case = case

    def packet(self, number: int) -> MessageTrace | None:
        """Return the way of the message in a packet; None if it is no message of a link.

        Args:
            number: number of the packet in the capture, from 1.
        """
        rows = np.flatnonzero(self._case.rows.number == number)
        for stream in (*self._case.streams, *self._case.robots) if len(rows) else ():
            place = int(np.searchsorted(stream.rows, rows[0]))
            if place < len(stream) and stream.rows[place] == rows[0]:
                return self.follow(_Leg(stream, place))
        return None

    def missing(self, link: str, msg_id: int, time_ns: int, first: int | None) -> MessageTrace | None:
        """Return the way of a missing message, by the packet before it and its own count."""
        for stream in self._case.streams:
            if (stream.link.label, stream.msg_id) == (link, msg_id):
                for row in np.flatnonzero(self._case.rows.time_ns[stream.rows] == time_ns).tolist():
                    if stream.missing[row]:
                        count = int(self._case.rows.sequence_count[stream.rows[row]])
                        behind = 1 if first is None else (first - count) % MODULUS
                        return self.follow(_Leg(stream, row, min(behind, int(stream.missing[row]))))
        return None

    def nth(self, streams: Sequence[Stream], nth: int) -> MessageTrace | None:
        """Return the way of the n-th message of some streams, one after the other, or None."""
        first = np.cumsum([0, *(messages_in(item) for item in streams)])
        which = int(np.searchsorted(first, nth, side="left")) - 1
        if not 0 <= which < len(streams):
            return None
        stream = streams[which]
        counts = np.cumsum(stream.counts)
        place = nth - int(first[which]) - 1
        row = int(np.searchsorted(counts, place, side="right"))
        return self.follow(_Leg(stream, row, place - (int(counts[row - 1]) if row else 0)))

    def follow(self, leg: _Leg) -> MessageTrace:
        """Return the way of a message, with its other ways if it came out more than once."""
        before = [*reversed(list(self._before(leg)))]
        every = [self._along([*before, *way]) for way in self._behind(leg)]
        every.sort(key=lambda item: item.ended.ending != "delivered")
        return replace(every[0], also=tuple(every[1:]))

    def _along(self, legs: Sequence[_Leg]) -> MessageTrace:
        """Return one way of a message."""
        head, last, case = legs[0], legs[-1], self._case
        steps = [*self._origin(head)]
        for place, item in enumerate(legs):
            if place:
                steps += self._out(item, steps)
            if item.stream in case.commands.fates:
                steps += self._inside(item, legs[place + 1] if place + 1 < len(legs) else None)
        ended = self._ended(last, steps)
        if len(legs) > 1 and any(step.hop == APPLICATION and step.witness == "by model" for step in steps):
            # Which of several messages with equal values came this far is the model's result, not the
            # counters'.
            ended = ended if ended.witness == "unknown" else replace(ended, witness="by model")
        times = [step.time_ns for step in steps if step.time_ns is not None]
        counts = head.stream.counts
        return MessageTrace(
            topic=case.topic(head.stream.msg_id) or case.packet_name(head.stream.msg_id) or None,
            link=head.stream.link.label,
            msg_id=head.stream.msg_id,
            nth=int(counts[: head.row].sum()) + head.behind + 1,
            of=int(counts.sum()),
            steps=tuple(steps),
            ended=ended,
            delay_ns=times[-1] - times[0] if len(times) > 1 else None,
            usual=self._usual(legs),
        )

    def _before(self, leg: _Leg) -> Iterator[_Leg]:
        """Yield the earlier forms of a message, the latest first."""
        while not leg.behind and (before := self._way_in(leg)) is not None:
            leg = before
            yield leg

    def _way_in(self, leg: _Leg) -> _Leg | None:
        for hop in self._case.hops:
            place = int(np.searchsorted(hop.out.rows, leg.at))
            if place < len(hop.out) and hop.out.rows[place] == leg.at and hop.origin[place] >= 0:
                return _Leg(hop.into, int(hop.origin[place]))
        return None

    def _behind(self, leg: _Leg) -> Iterator[list[_Leg]]:
        """Yield each way of a message to its end: itself, and its later forms."""
        queue = [[leg]]
        while queue:
            way = queue.pop()
            streams = {item.stream for item in way}
            every = self._ways_out(way[-1]) if not way[-1].behind else ()
            onward = [target for _, target in every if target.stream not in streams]
            queue += [[*way, target] for target in reversed(onward)]
            if not onward:
                yield way

    def _ways_out(self, leg: _Leg) -> Iterator[tuple[Hop, _Leg]]:
        for hop in self._case.hops:
            if hop.into is leg.stream:
                for place in np.flatnonzero(hop.in_rows == leg.row).tolist():
                    yield hop, _Leg(hop.out, int(hop.out_rows[place]))

    def _time(self, leg: _Leg) -> int:
        return int(self._case.rows.time_ns[leg.at])

    def _origin(self, leg: _Leg) -> Iterator[TraceStep]:
        """Yield the origin of a message: a bridge, or an application of cFS."""
        stream = leg.stream
        if stream.link.only_from_cfs or (stream.link.peers and stream.instance != NOBODY):
            yield from self._published(leg)
        elif stream.link.last_hop:
            yield self._captured(leg, "sender")
        else:
            yield TraceStep("publisher", _NOT_SEEN, "unknown")
            yield self._captured(leg, "bridge")

    def _published(self, leg: _Leg) -> Iterator[TraceStep]:
        """Yield the publishing of a message, the messages in front of it in the pipe, and its departure."""
        rounds = rounds_out(self._case, leg.stream)
        place = rounds.place(leg.row, leg.behind)
        if leg.behind:
            text = "its count never came: published between the one before it and the one behind it"
            yield TraceStep(APPLICATION, text, "by model", int(rounds.time_ns[place]))
            yield self._pipe(rounds, place)
            return
        mission, when = int(self._case.rows.mission_time_ns[leg.at]), None
        if leg.stream.instance != NOBODY and mission > 0:
            offset = self._case.instances.items[leg.stream.instance].offset_ns
            when = min(mission + offset, self._time(leg))
        text = "published; its header has no time" if when is None else "published, by the time in its header"
        yield TraceStep(APPLICATION, text, "unknown" if when is None else "measured", when)
        yield from self._departure(leg, rounds, place, when)

    def _out(self, leg: _Leg, steps: Sequence[TraceStep]) -> Iterator[TraceStep]:
        """Yield the steps of a message that entered and came out again."""
        before = next((item.time_ns for item in reversed(steps) if item.time_ns is not None), None)
        if leg.stream.link.last_hop:
            step = self._captured(leg, "robot")
            # Times of two interfaces, or of a busy host: the doctor has no delays below 0 either.
            yield replace(step, time_ns=max(step.time_ns or 0, before or 0))
            return
        rounds = rounds_out(self._case, leg.stream)
        yield from self._departure(leg, rounds, rounds.place(leg.row), before)

    def _departure(self, leg: _Leg, rounds: Rounds, place: int, since_ns: int | None) -> Iterator[TraceStep]:
        """Yield the pipe of a captured message, with those in front of it, the wake-up, and the datagram."""
        yield self._pipe(rounds, place)
        wake = int(rounds.wake[place])
        if 0 <= wake < len(rounds.wakes_ns):
            when = int(np.clip(rounds.wakes_ns[wake], since_ns or 0, self._time(leg)))
            yield TraceStep(rounds.queue, _woke(rounds, place), "measured", when)
        yield self._captured(leg, CAPTURE)

    def _captured(self, leg: _Leg, hop: str) -> TraceStep:
        rows, row = self._case.rows, leg.at
        who, whom = (self._case.endpoints[int(end[row])] for end in (rows.source, rows.destination))
        name = f"0x{leg.stream.msg_id:04x} " if hop == CAPTURE else ""
        text = f"{name}{who} to {whom}"
        return TraceStep(hop, text, "measured", int(rows.time_ns[row]), int(rows.number[row]))

    @staticmethod
    def _pipe(rounds: Rounds, place: int) -> TraceStep:
        """Return the step with the messages that waited in front of a message."""
        waiting, limit = rounds.waiting(place), rounds.limit
        if waiting is None:
            text = f"it keeps {limit} of this MsgId ({rounds.limit_from}); what waited is not seen"
            return TraceStep(rounds.pipe, text, "unknown", limit=limit)
        if waiting > limit or (waiting == limit and rounds.out[place]):
            text = f"{waiting} of this MsgId waited: the limit is not {limit}, as {rounds.limit_from}"
            return TraceStep(rounds.pipe, text, "measured", waiting=waiting)
        text = f"{waiting} of {limit} waited (limit {rounds.limit_from})"
        if not rounds.out[place]:
            text += ": full" if waiting >= limit else ": there was room"
        witness: Witness = "measured" if rounds.out[place] else "by model"
        return TraceStep(rounds.pipe, text, witness, waiting=waiting, limit=limit)

    def _inside(self, leg: _Leg, onward: _Leg | None) -> Iterator[TraceStep]:
        """Yield the wake-up that read a message, the waiting messages, and the application."""
        rounds = rounds_into(self._case, leg.stream)
        place = rounds.place(leg.row)
        sent, wake = self._time(leg), int(rounds.wake[place])
        every = f"every {rounds.round_ns / 1e6:.0f} ms"
        if 0 <= wake < len(rounds.wakes_ns):
            when = max(sent, int(rounds.wakes_ns[wake]))
            witness: Witness = "measured" if rounds.out[place] else "by model"
            yield TraceStep(rounds.queue, _woke(rounds, place), witness, when)
            yield self._pipe(rounds, place)
        elif leg.stream.link.only_to_cfs:
            yield TraceStep(rounds.queue, f"reads {every} (assumed); when is not seen", "unknown")
        if onward is None:
            return
        same = "the same packet" if onward.stream.msg_id == leg.stream.msg_id else "the same values"
        hop = next(hop for hop, target in self._ways_out(leg) if target.at == onward.at)
        single = self._is_single(hop, leg)
        text = f"{same} came out" + ("" if single else "; others had them too: the latest is taken")
        yield TraceStep(APPLICATION, text, "proven" if single else "by model")

    @staticmethod
    def _is_single(hop: Hop, leg: _Leg) -> bool:
        """Return whether no other message into cFS has the same values."""
        rows = np.flatnonzero(hop.known)
        place = int(np.searchsorted(rows, leg.row))
        return bool(place < len(rows) and rows[place] == leg.row and hop.single[place])

    def _ended(self, leg: _Leg, steps: list[TraceStep]) -> MessageEnd:
        """Return the end of a message's way, by the ledger."""
        stream = leg.stream
        if stream.link.last_hop:
            return MessageEnd("delivered", "robot", "came out to the robot", "measured")
        way, fate = self._case.ledger.way(stream), self._case.commands.fates.get(stream)
        full = any(step.witness == "by model" and (step.waiting or 0) >= (step.limit or 1) for step in steps)
        is_seen, nobody = fate is None or fate.seen, np.zeros(len(stream), bool)
        absent = nobody if fate is None else ~fate.arrived if is_seen else ~nobody
        ending = _decided(way, leg, absent, full=full and is_seen, case=self._case)
        if ending is not None:
            return ending
        if not is_seen:
            rows, text = way.rows(), "handed to the software bus; nothing here shows what the application did"
            witness: Witness = "proven" if all(row.observed for row in rows) else "unknown"
            return MessageEnd("sent_out", rows[-1].hop, text, witness)
        if leg.behind or absent[leg.row]:
            text = "never came, and nothing shows what became of it"
            return MessageEnd("open", way.rows()[-1].hop, text, "unknown")
        where = "SBN peer" if stream.link.peers else "bridge"
        return MessageEnd("sent_out", where, f"left for the {where}; nothing shows who took it", "measured")

    def _usual(self, legs: Sequence[_Leg]) -> Latency | None:
        """Return the latency of all messages on the same way, from the first to the last step."""
        if len(legs) == 2:
            return next((h.latency for h, target in self._ways_out(legs[0]) if target.at == legs[1].at), None)
        stream = legs[0].stream
        mission = self._case.rows.mission_time_ns[stream.rows]
        if len(legs) > 2 or stream.link.to_cfs or stream.instance == NOBODY or not (mission > 0).any():
            return None
        offset = self._case.instances.items[stream.instance].offset_ns
        timed = mission > 0
        return latency_of(self._case.rows.time_ns[stream.rows][timed] - mission[timed] - offset)


def messages_in(stream: Stream) -> int:
    """Return the number of messages in a stream, including missing ones."""
    return int(stream.counts.sum())


def _woke(rounds: Rounds, place: int) -> str:
    many = int((rounds.wake == rounds.wake[place]).sum())
    return f"wakes up every {rounds.round_ns / 1e6:.0f} ms; {plural(many, 'message')} of it this time"


def _decided(way: LedgerWay, leg: _Leg, absent: Any, *, full: bool, case: Case) -> MessageEnd | None:
    """Return the ending of a message by the entries of its way; None if it can be in none of them.

    Args:
        absent: bool (rows,), whether a message of the stream did not come out.
        full: whether its queue was full, by the model.
        case: case with the names of this cFS's applications.
    """
    entries = [(entry, _members(entry, leg)) for entry in [*way.entries(), *_passed_on(way, leg, case)]]
    own = [entry for entry, members in entries if members and members[0]]
    exact = [entry for entry, members in entries if members and members[1] == entry.number]
    if own and all(entry in exact for entry in own):
        return _ending(own[0], "proven", case, _texts(own, case, " or ", "{text}"))
    is_absent = bool(leg.behind or absent[leg.row])
    may_be = own + [entry for entry, members in entries if members is None and is_absent]
    if not may_be:
        return None
    # For telemetry the ledger has no rows of missing messages, so no sum of them either.
    pool = 0 if leg.behind or not is_absent else _undecided(absent, exact)
    is_limit = [entry.cause == "limit" for entry in own]
    if full and any(is_limit):
        return _ending(own[is_limit.index(True)], "by model", case)
    return _open(way, may_be, pool, case)


def _open(way: LedgerWay, may_be: Sequence[LedgerEntry], pool: int, case: Case) -> MessageEnd:
    """Return the ending of a message in one of several entries; proven if all have the same ending.

    Args:
        pool: number of messages that no other entry decides; 0 if unknown.
    """
    number = sum(entry.number for entry in may_be)
    if len({(entry.ending, entry.hop, entry.cause) for entry in may_be}) == 1 and number >= pool > 0:
        return _ending(may_be[0], "proven", case)
    where = may_be[0].hop if len({entry.hop for entry in may_be}) == 1 else way.rows()[-1].hop
    text = f"may be one of {_texts(may_be, case, ', ', '{number:,} ({text})')}"
    return MessageEnd("open", where, text, "unknown", one_of=max(pool, number))


def _texts(entries: Sequence[LedgerEntry], case: Case, between: str, form: str) -> str:
    """Return the texts of several entries, each text once."""
    return between.join(
        dict.fromkeys(form.format(number=item.number, text=_text(item, case)) for item in entries)
    )


def _undecided(absent: Any, exact: Sequence[LedgerEntry]) -> int:
    """Return the number of rows that did not come out, and are in no entry with as many messages as rows."""
    undecided = absent.copy()
    for entry in exact:
        if isinstance(entry.among, Among) and entry.among.missing is None:
            undecided[entry.among.rows] = False
    return int(undecided.sum())


def _passed_on(way: LedgerWay, leg: _Leg, case: Case) -> Iterator[LedgerEntry]:
    """Yield the entry of messages that the application passed on, and that were lost behind it."""
    fate = case.commands.fates.get(leg.stream)
    if fate is not None and fate.seen and fate.ends["passed_on"]:
        yield LedgerEntry(way.traffic, APPLICATION, "lost", fate.ends["passed_on"], "passed_on", PASSED_ON)


def _members(entry: LedgerEntry, leg: _Leg) -> tuple[bool, int] | None:
    """Return whether a message is a candidate of an entry, and the number of candidates; None if unknown."""
    among = entry.among
    if not isinstance(among, Among):
        return None
    inside = among.stream is leg.stream and (among.missing is None) == (not leg.behind)
    size = len(among.rows) if among.missing is None else int(among.missing.sum())
    return inside and bool(np.isin(leg.row, among.rows)), size


def _text(entry: LedgerEntry, case: Case) -> str:
    return case.called(entry.text) or ENDING_TEXTS[entry.ending]


def _ending(entry: LedgerEntry, witness: Witness, case: Case, wording: str = "") -> MessageEnd:
    text = wording or _text(entry, case)
    text = f"lost: {text}" if entry.ending == "lost" and not text.startswith("lost") else text
    return MessageEnd(entry.ending, case.called(entry.hop), text, witness, entry.cause)


def with_ending(trace: MessageTrace, text: str, one_of: int | None) -> MessageTrace:
    """Return the trace of a message in the list of losses, with that list's ending if its way shows none.

    Args:
        text: ending in the list.
        one_of: number of messages among which it is not identified.
    """
    if trace.ended.ending == "lost":
        return trace
    witness: Witness = "proven" if one_of is None else "unknown"
    ended = replace(trace.ended, ending="lost", text=f"lost: {text}", witness=witness, one_of=one_of)
    return replace(trace, ended=ended)


class TraceRequest(msgspec.Struct, frozen=True):
    """The subject: a packet, the n-th message of a topic, the n-th lost one, or the topic itself.

    Attributes:
        packet: number of a packet in the capture, from 1.
        topic: topic, or name or MsgId that tables show.
        nth: number of the topic's message, from 1.
        lost: number among the lost messages of the topic, or of all, from 1.
        window: number of messages whose rates are requested; without a topic, for every topic.
    """

    packet: int | None = None
    topic: str | None = None
    nth: int | None = None
    lost: int | None = None
    window: int | None = None


class Tracing(Examination):
    """Takes batches as they come and keeps the requested trace; it gives no verdicts.

    Attributes:
        trace: way of the message, once it is found.
        timing: rounds of the topic, in the chapter that lost most.
        rates: rates of the topic, for each spacecraft in the last chapter that has it.
    """

    def __init__(self, context: Context, request: TraceRequest) -> None:
        super().__init__(context)
        self.request = request
        self.trace: MessageTrace | None = None
        self.timing: Timing | None = None
        self._rates: dict[int, list[TopicRates]] = {}
        self._passed = 0
        self._listed: list[tuple[Missing, Case]] = []
        self._names: dict[str, None] = {}

    def judged(self, recorder: Recorder, chapter: Chapter) -> Diagnosis:
        """Search for the message in a chapter."""
        case = Case(recorder, self.profile, chapter.capture, proxied(chapter.faults))
        packet = self.request.packet
        is_here = packet is None or (case.rows.number == packet).any()
        is_open = self.trace is None or (self.request.lost and self.context.spacecraft.several)
        if len(case.rows) and is_here and is_open:
            judge_single(case)
            self._look(case)
        return Diagnosis(
            (), (), [], [], len(case.rows), case.start_ns, case.end_ns, chapter.capture, case=None
        )

    @property
    def rates(self) -> list[TopicRates]:
        """See the class."""
        return [item for _, rates in sorted(self._rates.items()) for item in rates]

    def check(self) -> None:
        """Raise an error if the subject was not found.

        Raises:
            RouteError: it was not found.
        """
        request = self.request
        if self.trace is not None or self.timing is not None or self.rates:
            return
        if request.packet is not None:
            raise RouteError(
                f"packet {request.packet} is no message of a link, or a copy of one; edoras sniff shows it"
            )
        if request.lost is not None:
            of = f" of {request.topic}" if request.topic else ""
            raise RouteError(f"--lost {request.lost}: {plural(self._passed, 'message')}{of} were lost")
        if self._passed:
            raise RouteError(f"--nth {request.nth}: {request.topic} has {plural(self._passed, 'message')}")
        hint = did_you_mean(request.topic or "", list(self._names), 3) or "edoras info shows what is there"
        subject = repr(request.topic) if request.topic else "any topic"
        raise RouteError(f"no message of {subject} is there; {hint}")

    def _look(self, case: Case) -> None:
        request = self.request
        if request.packet is not None:
            self.trace = Tracer(case).packet(request.packet)
            return
        if request.lost is not None:
            lost = [
                (item, case) for item in missing(case) if request.topic in {None, *_names(case, item.msg_id)}
            ]
            # The list is in order of time; several spacecraft are judged separately.
            before = 0 if self.context.spacecraft.several else self._passed
            self._listed = sorted([*self._listed[before:], *lost], key=lambda item: item[0].time_ns)
            self._passed += len(lost)
            if 0 < request.lost - before <= len(self._listed):
                self.trace = self._lost(*self._listed[request.lost - before - 1])
            return
        streams = self._streams(case, request.topic or "")
        if request.nth is not None:
            self.trace = Tracer(case).nth(streams, request.nth - self._passed) if streams else None
            self._passed += sum(messages_in(item) for item in streams)
        elif request.window is not None:
            pairs = [(item, request.topic) for item in streams] if request.topic else self._every(case)
            if rates := [topic_rates(case, *item, request.window) for item in pairs]:
                self._rates[case.mission.number] = rates
        elif streams:
            timings = [_timing(case, item, request.topic or "") for item in streams]
            best = max([*timings, *filter(None, [self.timing])], key=lambda item: item.lost)
            self.timing = best

    def _streams(self, case: Case, name: str) -> list[Stream]:
        """Return the streams of a name at their first capture, in order of their begin."""
        self._names |= dict.fromkeys(item for stream in case.streams for item in _names(case, stream.msg_id))
        streams = [item for item in case.streams if name in _names(case, item.msg_id)]
        behind = {hop.out for hop in case.hops}
        streams.sort(key=lambda item: (item in behind, int(item.rows[0])))
        return [item for item in streams if item.link is streams[0].link]

    def _every(self, case: Case) -> list[tuple[Stream, str]]:
        """Return the streams of each topic, or without topics of each MsgId, with its name."""
        ids = list(dict.fromkeys(stream.msg_id for stream in case.streams))
        topics = [topic for item in ids if (topic := case.topic(item))]
        names = topics or [_names(case, item)[-1] for item in ids]
        return [(stream, name) for name in dict.fromkeys(names) for stream in self._streams(case, name)]

    @staticmethod
    def _lost(item: Missing, case: Case) -> MessageTrace:
        """Return the way of a message in the list of losses."""
        tracer = Tracer(case)
        if item.number is not None:
            trace = tracer.packet(item.number)
        else:
            trace = tracer.missing(item.link, item.msg_id, item.time_ns, item.first)
        if trace is not None:
            return with_ending(trace, item.what, item.one_of)
        text = f"no packet and no count of it is here, only that it was lost: {item.what}"
        step = TraceStep("capture", text, "unknown", item.time_ns)
        ended = MessageEnd("lost", "", f"lost: {item.what}", "proven")
        return MessageTrace(item.topic, item.link, item.msg_id, 0, 0, (step,), ended, None, None)


def _names(case: Case, msg_id: int) -> list[str]:
    """Return the names of a MsgId."""
    names = case.topic(msg_id), case.packet_name(msg_id), f"0x{msg_id:04x}"
    return [case.mission.own_name(item, case.mission.number) for item in names if item]


def _timing(case: Case, stream: Stream, name: str) -> Timing:
    is_into = stream in case.commands.fates
    rounds = rounds_into(case, stream) if is_into else rounds_out(case, stream)
    return Timing(name, stream.link.label, stream.msg_id, rounds, tuple(_endings(case, stream)))


def _endings(case: Case, stream: Stream) -> Sequence[tuple[int, str]]:
    """Return the endings of the messages of a stream that did not come out, by the ledger."""
    sums: dict[str, int] = {}
    for entry in case.ledger.way(stream).entries():
        text = case.called(entry.text) if entry.ending == "lost" else ENDING_TEXTS[entry.ending]
        sums[text] = sums.get(text, 0) + entry.number
    fate = case.commands.fates.get(stream)
    behind = fate.ends["passed_on"] if fate is not None else 0
    return [*((number, text) for text, number in sums.items()), *[(behind, PASSED_ON)] * bool(behind)]
