"""Follows one message of a capture, or one topic through the rounds of its queue."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec

from edoras_tools.addons.trace.rounds import Timing, TopicRates, rounds_into, rounds_out, topic_rates
from edoras_tools.addons.trace.tracer import (
    PASSED_ON,
    MessageEnd,
    MessageTrace,
    Tracer,
    TraceStep,
    messages_in,
    with_ending,
)
from edoras_tools.diagnosis.case import Case
from edoras_tools.diagnosis.evidence.relays import proxied
from edoras_tools.diagnosis.examination import Chapter, Diagnosis, Examination, judge_single
from edoras_tools.diagnosis.ledger import ENDING_TEXTS
from edoras_tools.diagnosis.missing import Missing, missing
from edoras_tools.errors import RouteError
from edoras_tools.words import did_you_mean, plural

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.decode import Context
    from edoras_tools.diagnosis.evidence.table import Recorder
    from edoras_tools.diagnosis.matching.streams import Stream


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
