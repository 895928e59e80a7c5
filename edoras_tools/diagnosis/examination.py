"""From batches to a diagnosis, in bounded memory.

Rules:

1. A capture is examined in chapters of a million datagrams. Messages are never matched across chapters.
2. If the records of a capture are out of order throughout, a chapter may grow to four times that size.
3. The diagnosis of the whole has the sums of all chapters, and all their verdicts. A verdict about the whole
   capture stands once.
4. Each spacecraft has an examination of its own. Their diagnoses stand side by side.
"""

from __future__ import annotations

import gc
from functools import cached_property
from itertools import chain
from operator import add, attrgetter, itemgetter
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol

import msgspec
from msgspec.structs import replace

from edoras_tools.decode.spacecraft import FIRST_SPACECRAFT
from edoras_tools.diagnosis.accounts import accounts
from edoras_tools.diagnosis.balance import Chain, Headline, WaySum, chains, headlines, not_counted, sent, ways
from edoras_tools.diagnosis.case import Capture, Case
from edoras_tools.diagnosis.evidence.relays import proxied
from edoras_tools.diagnosis.evidence.table import Recorder
from edoras_tools.diagnosis.ledger import CAPTURE, ENDINGS, Row, summed
from edoras_tools.diagnosis.missing import ALL, Missing, missing
from edoras_tools.diagnosis.rules import SINGLE, others, rules
from edoras_tools.diagnosis.rules.capture import too_many
from edoras_tools.diagnosis.rules.flight_software import note_silences
from edoras_tools.diagnosis.verdict import CAPTURE_RULES, WHOLE, Choice, Severity, Verdict
from edoras_tools.links.table import LinkStates
from edoras_tools.mission import Mission
from edoras_tools.model import NO_MSG_ID, NO_ROUTE, Columns, PacketBatch
from edoras_tools.wire.arrays import by_key, by_value

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from edoras_tools.cfs.profile import SimProfile
    from edoras_tools.decode import Context
    from edoras_tools.decode.conversations import Conversations, Flow, Unnamed
    from edoras_tools.sessions.faults.rules import Fault

    _Figures = Mapping[str, Callable[[Any, Any], Any]]

_FIGURES: Final = ("duplicated", *ENDINGS[1:-1])
"""Figures of the whole besides ``lost``; it shares nothing with others."""
CHAPTER: Final = 1_000_000
"""Number of datagrams in a chapter; their rows take 160 MB. Messages that cross into the next one are not
matched with their arrival there."""
MOST_SCATTERED: Final = 4
"""Largest size, in chapters, of a chapter whose records are out of order throughout."""


class Diagnosis(msgspec.Struct, frozen=True, dict=True):
    """The result of an examination.

    Attributes:
        verdicts: verdicts without habits, the gravest first.
        habits: verdicts about normal behaviour of these senders.
        routes: accounts of all streams, as in ``doctor --json``.
        peers: SBN connections over time, as in ``doctor --json``.
        datagrams: number of datagrams examined.
        start_ns: capture time of the first one.
        end_ns: capture time of the last one.
        capture: facts about the capture itself.
        case: evidence, for plots: that of the last chapter; None if other processes examined it.
        balance: rows of the ledger, for each traffic and hop.
        left_out: number of datagrams of no link, of another program, or outside the examined time.
        unnamed: ports among these whose traffic looks like a link's, and that no option names.
        topics: index of a configured route to its topic.
        choice: choice of what is shown; None for all.
        whole: diagnosis of which this is a part by ``choice``; None if it is the whole.
        missing: lost messages in order of time, if they were requested; else empty.
        parts: number of a spacecraft to its diagnosis; empty if there is only one spacecraft.
        mission: mission that has the names of the spacecraft.
    """

    verdicts: tuple[Verdict, ...]
    habits: tuple[Verdict, ...]
    routes: list[dict[str, Any]]
    peers: list[dict[str, Any]]
    datagrams: int
    start_ns: int
    end_ns: int
    capture: Capture = msgspec.field(default_factory=Capture)
    case: Case | None = None
    balance: tuple[Row, ...] = ()
    left_out: int = 0
    unnamed: tuple[Unnamed, ...] = ()
    topics: Mapping[int, str] = msgspec.field(default_factory=dict)
    choice: Choice | None = None
    whole: Diagnosis | None = None
    missing: tuple[Missing, ...] = ()
    parts: Mapping[int, Diagnosis] = msgspec.field(default_factory=dict)
    mission: Mission = msgspec.field(default_factory=Mission)

    @property
    def zero_ns(self) -> int:
        """The zero, in ns, of all times that people read."""
        return self.start_ns if self.capture.zero_ns is None else self.capture.zero_ns

    @property
    def lost(self) -> int:
        """Arrivals lost with a visible cause, in all; without frames that the capture itself lost."""
        return sum(row.all_lost for row in self.balance)

    @property
    def superseded(self) -> int:
        """Arrivals that a newer message replaced."""
        return sum(row.superseded for row in self.balance)

    @property
    def unaccounted(self) -> int:
        """Arrivals certainly missing without a visible cause."""
        return sum(row.unaccounted for row in self.balance)

    @property
    def uncertain(self) -> int:
        """Arrivals that are lost, or only not captured."""
        return sum(row.uncertain for row in self.balance)

    @property
    def messages_lost(self) -> int:
        """Messages proven lost: lost arrivals without the possible copies."""
        return sum(way.messages_lost for way in self.ways)

    @property
    def messages_uncertain(self) -> int:
        """Messages that may be lost, beyond those proven."""
        return sum(way.messages_uncertain for way in self.ways)

    @cached_property
    def ways(self) -> list[WaySum]:
        """The sum of each traffic over all its hops."""
        return ways(self.balance)

    @cached_property
    def headlines(self) -> list[Headline]:
        """One line of sums for each route."""
        return headlines(self.balance, self.topics)

    @property
    def chains(self) -> list[Chain]:
        """The chain of hops of each command, from its publisher to the robot."""
        return chains(self.balance, self.topics)

    @property
    def worst(self) -> Severity:
        """The severity of the gravest verdict; ``HABIT`` without any."""
        return max((item.severity for item in self.verdicts), default=Severity.HABIT)

    @property
    def without_evidence(self) -> bool:
        """Whether messages were sent, and no hop has a counter of losses."""
        sent_rows = [row for row in self.balance if row.came]
        return bool(sent_rows) and not any(row.observed for row in sent_rows)

    @property
    def bad(self) -> bool:
        """Whether the exit code is 3: proven loss, capture drops, an error, no datagram, or no evidence."""
        loss = self.lost or self.unaccounted or self.capture.drops or not self.datagrams
        return bool(loss) or self.without_evidence or self.worst is Severity.ERROR

    def beyond(self, share: float, *, strict: bool = False) -> list[str]:
        """Return the reasons for exit code 3, one sentence each, with a tolerated share of losses.

        The share applies to each route and to the sum of all. A route without a counter, an error without a
        number of messages, and drops of the capture are reasons too.

        Args:
            share: tolerated share of lost messages, 0 to 1.
            strict: whether uncertain messages count as lost.
        """
        rows = [row for row in self.balance if row.hop != CAPTURE]
        groups = by_key(rows, lambda row: (row.route, row.msg_id))
        reasons = []
        for (route, msg_id), own in {**groups, (NO_ROUTE, NO_MSG_ID): rows}.items():
            missing = sum(row.proven + row.uncertain * strict for row in own)
            unnamed = "messages of unknown MsgId" if msg_id is None else f"0x{msg_id:04x}"
            name = "messages in all" if msg_id == NO_MSG_ID else self.topics.get(route, unnamed)
            if missing > share * sent(own):
                how = "lost, or may be" if strict else "lost or unaccounted for"
                text = f"{missing:,} of {sent(own):,} {name} {how}"
                reasons.append(f"{text}: more than {share * 100:g} %")
            elif msg_id != NO_MSG_ID and (unseen := not_counted(own)):
                reasons.append(f"what was lost of {name} is {unseen}")
        reasons += [
            item.reason for item in self.verdicts if item.severity is Severity.ERROR and item.lost is None
        ]
        if self.capture.drops:
            reasons.append("the capture itself lost packets")
        return reasons if self.datagrams else ["nothing was examined"]

    def limited(self, choice: Choice) -> Diagnosis:
        """Return the chosen part of the diagnosis; verdicts about the capture itself stay in it."""

        def pick(verdicts: Iterable[Verdict]) -> tuple[Verdict, ...]:
            return tuple(
                item
                for item in verdicts
                if item.rule in CAPTURE_RULES or choice.takes(item.link, item.msg_id, item.topic or "")
            )

        if self.parts:
            parts = {number: part.limited(choice.of(number)) for number, part in self.parts.items()}
            return replace(side_by_side(parts, self.mission), choice=choice, whole=self)
        return replace(
            self,
            verdicts=pick(self.verdicts),
            habits=pick(self.habits),
            routes=[row for row in self.routes if choice.takes(row["link"], int(row["msg_id"], 0))],
            peers=self.peers if choice.takes("sbn", None) else [],
            balance=tuple(
                row for row in self.balance if choice.takes(row.link or None, row.msg_id, row.topic)
            ),
            missing=tuple(item for item in self.missing if choice.takes(*item.concerns)),
            choice=choice,
            whole=self,
        )

    @property
    def not_shown(self) -> dict[str, int] | None:
        """Number of verdicts, routes and lost messages that the choice hides; None without a choice."""
        if self.whole is None:
            return None
        return {
            "verdicts": len(self.whole.verdicts) - len(self.verdicts),
            "routes": len(self.whole.routes) - len(self.routes),
            "lost": self.whole.lost - self.lost,
        }

    def as_json(self) -> dict[str, Any]:
        """Return the diagnosis in the shape of ``doctor --json``."""
        return {
            **{name: getattr(self, name) for name in ("datagrams", "start_ns", "end_ns")},
            "capture_drops": self.capture.drops,
            "outages": [outage.as_json() for outage in self.capture.outages],
            "examined": self.datagrams,
            "not_examined": self.left_out,
            "choice": self.choice.text if self.choice else None,
            "not_shown": self.not_shown,
            "lost": self.lost,
            **{name: sum(getattr(row, name) for row in self.balance) for name in _FIGURES},
            "estimated": None,
            "messages_lost": self.messages_lost,
            "messages_uncertain": self.messages_uncertain,
            "verdicts": [verdict.as_json() for verdict in self.verdicts],
            "habits": [verdict.as_json() for verdict in self.habits],
            "balance": [row.as_json(self.topics.get(row.route)) for row in self.balance],
            "ways": [way.as_json(self.topics.get(way.hops[0].route)) for way in self.ways],
            "chains": [item.as_json() for item in self.chains],
            "routes": self.routes,
            "peers": self.peers,
        }


class Chapter(NamedTuple):
    """The inputs of a chapter besides its recorder.

    Attributes:
        capture: facts about the capture itself.
        faults: faults that a proxy or a replay logged since the chapter before.
        flows: conversations up to the end of the chapter, as in ``Conversations``.
        left_out: number of datagrams in the chapter that belong to no link.
    """

    capture: Capture
    faults: Sequence[Fault]
    flows: dict[tuple[Any, ...], Flow]
    left_out: int


class Apart(Protocol):
    """Other processes that record and examine chapters, one after the other."""

    def keep(self, batch: PacketBatch, columns: Columns) -> None:
        """Record datagrams of the present chapter; see ``Recorder.keep``."""

    def judge(self, chapter: Chapter) -> Callable[[], Diagnosis]:
        """Start to examine the chapter, begin the next one; return a function that waits for the result."""


def judge(case: Case, progress: Callable[[int, int], None] = lambda _count, _of: None) -> list[Verdict]:
    """Return the verdicts of all rules; those about single messages run first, because the ledger needs them.

    Without any row, only the rules about left-out datagrams run.

    Args:
        case: capture.
        progress: function that gets the number of rules that ran, and of all.
    """
    if not len(case.rows):
        return [_completed(case, rule.__name__, verdict) for rule in others() for verdict in rule(case)]
    every = rules()
    verdicts = judge_single(case, lambda count: progress(count, len(every)))
    for name, rule in every.items():
        if name not in verdicts:
            verdicts[name] = [_completed(case, name, verdict) for verdict in rule(case)]
            progress(len(verdicts), len(every))
        case.verdicts += verdicts[name]
    note_silences(case)
    return case.verdicts


def judge_single(
    case: Case, progress: Callable[[int], None] = lambda _count: None
) -> dict[str, list[Verdict]]:
    """Return rule to verdicts of the rules about single messages, and add the refused messages to the case.

    Args:
        case: capture.
        progress: function that gets the number of rules that ran.
    """
    verdicts: dict[str, list[Verdict]] = {}
    for name, rule in rules().items():
        if name in SINGLE:
            progress(len(verdicts))
            verdicts[name] = [_completed(case, name, verdict) for verdict in rule(case)]
    case.refused += [item for own in verdicts.values() for item in own if item.lost or item.perhaps]
    for members in verdicts.values():
        members[:] = [_lost_here(item, case.commands.refusals(item)) for item in members]
    return verdicts


def _completed(case: Case, rule: str, verdict: Verdict) -> Verdict:
    """Return a verdict with the name of its rule, and with topic and span from the case if it has none."""
    topic = verdict.topic or (None if verdict.msg_id is None else case.topic(verdict.msg_id))
    span = (case.start_ns, case.end_ns) if verdict.span == WHOLE else verdict.span
    return replace(verdict, rule=rule, topic=topic, span=span)


def _lost_here(verdict: Verdict, number: int) -> Verdict:
    """Return a verdict with the number of messages lost at its hop; the others count elsewhere."""
    other = (verdict.lost or 0) - number
    if not other or verdict.by_type:
        return replace(verdict, lost=number or None)
    line = f"{other:,} of these arrived, or had another cause"
    return replace(verdict, lost=number, evidence=(*verdict.evidence, line))


class Examination:
    """Records batches, and returns a diagnosis of all so far at any time.

    Args:
        context: mission, types and options, shared with the decoder.
        profile: constants of the cFS; by default those of the mission.

    Attributes:
        zero_ns: zero of all times that people read, ns; None for the first datagram.
        progress: function as in ``judge``.
        faults: faults that a proxy or a replay logged in the recording.
        listing: whether the diagnosis lists every lost message.
        latest: largest number of messages that are listed of each loss, the latest ones.
        accounting: whether the diagnosis has the accounts of all streams.
    """

    def __init__(self, context: Context, profile: SimProfile | None = None) -> None:
        self.zero_ns: int | None = None
        self.progress: Callable[[int, int], None] = lambda _count, _of: None
        self.faults: Sequence[Fault] = ()
        self.listing, self.latest, self.accounting = False, ALL, True
        self._apart: Apart | None = None
        self.context = context
        self.profile = profile or context.mission.software.profile
        self._recorder = Recorder(context)
        self._evidence = LinkStates(lambda link: link.evidence(context))
        self._before: list[Callable[[], Diagnosis]] = []
        self._scattered = False
        self._others: dict[int, Examination] = {}
        """Number of a spacecraft, except the first one, to its examination."""
        self._whole = self

    def add(self, batch: PacketBatch, columns: Columns) -> None:
        """Add a batch and its columns, each datagram to the examination of its spacecraft."""
        for item in self._evidence.of(columns):
            item.add(batch, columns)
        if (columns.spacecraft != FIRST_SPACECRAFT).any():
            for number, rows in by_value(columns.spacecraft):
                if number != FIRST_SPACECRAFT:
                    self.of(number).take(batch.take(rows), columns.take(rows))
            own = columns.spacecraft == FIRST_SPACECRAFT
            batch, columns = batch.take(own), columns.take(own)
        self.take(batch, columns)

    def of(self, number: int) -> Examination:
        """Return the examination of a spacecraft that is not the first; it is made if there is none."""
        if number not in self._others:
            other = self._others[number] = Examination(self.context.of(number), self.profile)
            other._whole = self
        return self._others[number]

    def take(self, batch: PacketBatch, columns: Columns) -> None:
        """Add datagrams of this spacecraft; begin a new chapter if the present one is full."""
        if len(self._recorder) >= CHAPTER and not self._goes_on():
            self.separate()
        self._recorder.add(batch, columns)

    def _goes_on(self) -> bool:
        """Return whether a full chapter has to grow, because its records are out of order throughout."""
        if not self._recorder.scattered:
            return False
        self._scattered = len(self._recorder) >= MOST_SCATTERED * CHAPTER
        return not self._scattered

    def separate(self) -> None:
        """Examine the present chapter and begin the next one; the two are never matched."""
        for other in self._others.values():
            other.separate()
        if not len(self._recorder):
            return
        # A chapter has the faults up to its end; the last one has the rest.
        until_ns = self._recorder.last_ns
        faults = [item for item in self.faults if item.time_ns <= until_ns]
        self.faults = [item for item in self.faults if item.time_ns > until_ns]
        capture = Capture(zero_ns=self._zero_ns())
        self._recorder.ends = True
        self._before.append(self._judged(capture, faults, last=False))
        size, self._recorder = len(self._recorder), self._begin(self._recorder.conversations)
        # A case has reference cycles: 150 MB that would stay for long; those of a short chapter are small.
        gc.collect(2 if size > CHAPTER // 64 else 0)

    def use_processes(self, apart: Apart) -> None:
        """Use other processes for the chapters. To be called before ``add``; ``diagnose`` works only once."""
        self._apart = apart
        self._recorder = self._begin(self._recorder.conversations)

    def diagnose(self, capture: Capture | None = None, *, ends: bool = False) -> Diagnosis:
        """Return the diagnosis of all batches so far.

        Args:
            capture: facts about the capture itself.
            ends: whether nothing is added after this, so that memory can be freed.
        """
        self._recorder.ends = ends
        capture = capture or Capture()
        zero_ns = self._zero_ns() if capture.zero_ns is None else capture.zero_ns
        evidence = self._evidence.by_link
        whole = replace(capture, zero_ns=zero_ns, evidence=evidence)
        followed = sum(item.datagrams for item in evidence.values())
        apart = sum(item.reassembled for item in evidence.values()) + sum(
            item.pieces for item in capture.unwrappers.values()
        )
        last = self._judged(whole, self.faults, last=True)()
        left_out = last.left_out + capture.cut - followed - apart
        last = replace(last, datagrams=last.datagrams + followed, left_out=left_out)
        result = _joined([*(part() for part in self._before), last], capture) if self._before else last
        if self._scattered:
            verdict = too_many(result.start_ns, result.end_ns, MOST_SCATTERED * CHAPTER)
            result = replace(result, verdicts=(verdict, *result.verdicts))
        if not self._others:
            return result
        rest = replace(
            whole, zero_ns=result.zero_ns, evidence={}, unwrappers={}, host=(), lacking=(), astray=(), cut=0
        )
        others = {number: other.diagnose(rest, ends=ends) for number, other in sorted(self._others.items())}
        return side_by_side({FIRST_SPACECRAFT: result, **others}, self.context.mission)

    def _zero_ns(self) -> int | None:
        return self._before[0]().zero_ns if self._before else self.zero_ns

    def _missing(self, case: Case) -> tuple[Missing, ...]:
        """Return the lost messages in order of time; none without ``listing``."""
        if not self.listing:
            return ()
        items = [*(missing(case, self.latest) if len(case.rows) else ()), *case.capture.missing()]
        return tuple(sorted(items, key=attrgetter("time_ns")))

    def _begin(self, conversations: Conversations) -> Recorder:
        return Recorder(self.context, conversations, self._apart.keep if self._apart else None)

    def _judged(self, capture: Capture, faults: Sequence[Fault], *, last: bool) -> Callable[[], Diagnosis]:
        """Examine the present chapter, here or elsewhere; return a function that waits for the result."""
        recorder = self._recorder
        chapter = Chapter(capture, faults, recorder.conversations.flows, recorder.left_out)
        if self._apart is not None:
            return self._apart.judge(chapter)
        result = self._whole.judged(recorder, chapter)
        result = result if last else replace(result, case=None)
        return lambda: result

    def judged(self, recorder: Recorder, chapter: Chapter) -> Diagnosis:
        """Examine a chapter in this process."""
        capture = chapter.capture
        case = Case(recorder, self.profile, capture, proxied(chapter.faults))
        verdicts = [_called(item, case) for item in judge(case, self.progress)]
        spans = capture.spans()
        spans += [(case.start_ns, case.end_ns)] if len(case.rows) else []
        return Diagnosis(
            verdicts=_sorted(item for item in verdicts if item.severity is not Severity.HABIT),
            habits=tuple(item for item in verdicts if item.severity is Severity.HABIT),
            routes=accounts(case) if len(case.rows) and self.accounting else [],
            peers=[item.as_json() for item in case.network.connections.values()],
            datagrams=len(case.rows),
            start_ns=min((start_ns for start_ns, _ in spans), default=case.start_ns),
            end_ns=max((end_ns for _, end_ns in spans), default=case.end_ns),
            capture=capture,
            case=case,
            balance=(
                *(
                    replace(
                        row,
                        hop=case.called(row.hop),
                        name="" if row.msg_id is None else case.packet_name(row.msg_id),
                        topic=row.topic or (row.msg_id is not None and case.topic(row.msg_id)) or "",
                    )
                    for row in (case.ledger.rows() if len(case.rows) else ())
                ),
                *capture.rows(),
            ),
            unnamed=tuple(case.unnamed),
            left_out=recorder.left_out + case.prepared.foreign + int(case.prepared.crowd.sum()),
            topics={index: route.topic for index, route in enumerate(case.mission.routes)},
            missing=self._missing(case),
        )


def _called(verdict: Verdict, case: Case) -> Verdict:
    """Return a verdict with the names that applications have in the cFS of the capture."""
    reason, remedy = case.called(verdict.reason), case.called(verdict.remedy)
    hop = verdict.hop and case.called(verdict.hop)
    if (reason, remedy, hop) == (verdict.reason, verdict.remedy, verdict.hop):
        return verdict  # copying some hundred of them takes milliseconds
    return replace(verdict, reason=reason, remedy=remedy, hop=hop)


def _sorted(verdicts: Any) -> tuple[Verdict, ...]:
    return tuple(sorted(verdicts, key=lambda item: (*item.rank, -(item.lost or 0), item.start_ns)))


def _verdicts(parts: list[Diagnosis]) -> Iterator[Verdict]:
    """Yield the verdicts of all chapters; those about the whole capture only once."""
    silent = [{item.topic for item in part.verdicts if item.rule == "topic_never_seen"} for part in parts]
    never = set.intersection(*silent)
    for part in parts:
        for item in part.verdicts:
            # Conversations are counted from the beginning, so the last chapter has their totals.
            if item.rule in {"not_examined", "not_cfs"}:
                if part is parts[-1]:
                    yield item
            elif (part is parts[0] or item.rule not in {"older_losses", "topic_never_seen"}) and (
                item.rule != "topic_never_seen" or item.topic in never
            ):
                yield item


def _together(parts: Sequence[Diagnosis]) -> dict[str, Any]:
    """Return the joined attributes of several diagnoses, by name: lists in order, and sums of counts."""
    joined: dict[str, Any] = {
        name: [*chain.from_iterable(getattr(part, name) for part in parts)]
        for name in ("verdicts", "habits", "balance", "unnamed", "routes", "peers", "missing")
    }
    joined["verdicts"] = _sorted(joined["verdicts"])
    joined["missing"].sort(key=attrgetter("time_ns"))
    joined |= {name: tuple(joined[name]) for name in ("habits", "balance", "unnamed", "missing")}
    joined |= {name: sum(getattr(part, name) for part in parts) for name in ("datagrams", "left_out")}
    start_ns, end_ns = min(part.start_ns for part in parts), max(part.end_ns for part in parts)
    return joined | {"start_ns": start_ns, "end_ns": end_ns}


def _joined(parts: list[Diagnosis], capture: Capture) -> Diagnosis:
    """Return the diagnosis of all chapters (rule 3)."""
    joined, last = _together(parts), parts[-1]
    joined["verdicts"] = _sorted(_verdicts(parts))
    joined["habits"] = (*{(item.rule, item.msg_id, item.hop): item for item in joined["habits"]}.values(),)
    # The accounts of one stream in several chapters are added up.
    joined["routes"] = _added(joined["routes"], ("link", "msg_id", "sender", "receiver", "instance"), _ROUTE)
    joined["balance"] = summed(joined["balance"])
    return replace(last, **joined | {"unnamed": last.unnamed}, capture=capture)


def side_by_side(parts: Mapping[int, Diagnosis], mission: Mission) -> Diagnosis:
    """Return one diagnosis of all spacecraft, in which each row and verdict has the number of its own."""
    own = [_of_one(number, part, mission) for number, part in parts.items()]
    topics = dict(chain.from_iterable(part.topics.items() for part in own))
    return replace(own[0], **_together(own), topics=topics, parts=parts, mission=mission)


def _of_one(number: int, part: Diagnosis, mission: Mission) -> Diagnosis:
    """Return the diagnosis of a spacecraft with its name in texts, and with route numbers of its own."""
    name, first = mission.called(number), (number - 1) * len(part.topics)

    def renamed(verdicts: Iterable[Verdict]) -> tuple[Verdict, ...]:
        return tuple(
            item
            if item.rule in CAPTURE_RULES
            else replace(item, reason=f"{name}: {item.reason}", spacecraft=number)
            for item in verdicts
            if number == FIRST_SPACECRAFT or item.rule not in CAPTURE_RULES
        )

    return replace(
        part,
        verdicts=renamed(part.verdicts),
        habits=renamed(part.habits),
        balance=tuple(
            replace(
                row,
                route=row.route if row.route == NO_ROUTE else row.route + first,
                instance=f"{name}, {row.instance}" if row.instance else name,
                spacecraft=number,
            )
            for row in part.balance
        ),
        topics={index + first: topic for index, topic in part.topics.items()},
        routes=[{**row, "spacecraft": number} for row in part.routes],
        peers=[{**row, "spacecraft": number} for row in part.peers],
        missing=part.missing
        if number == FIRST_SPACECRAFT
        else tuple(item.of(number, mission) for item in part.missing),
    )


def _added(items: Iterable[dict[str, Any]], keys: Sequence[str], figures: _Figures) -> list[dict[str, Any]]:
    """Return items with those of equal keys joined to one, each figure by its function."""
    totals: dict[tuple[Any, ...], dict[str, Any]] = {}
    for item in items:
        key = tuple(item[name] for name in keys)
        total = totals.get(key)
        joined = {name: join(total[name], item[name]) for name, join in figures.items()} if total else item
        totals[key] = {**(total or {}), **joined}
    return list(totals.values())


def _slower(one: dict[str, Any] | None, other: dict[str, Any] | None) -> dict[str, Any] | None:
    """Return the latency with the greater 99 % quantile: quantiles of two chapters cannot be joined."""
    return max((item for item in (one, other) if item), key=itemgetter("p99_ms"), default=None)


_CROSSING: Final[_Figures] = dict.fromkeys(("of", "matched", "superseded", "missing"), add) | {
    "latency": _slower
}
_ROUTE: Final[_Figures] = {
    **dict.fromkeys(("sent", "seen", "lost", "gaps", "duplicates", "reordered", "restarts"), add),
    "delay": _slower,
    "to_robot": _slower,
    "bytes_max": max,
    "crossings": lambda one, other: _added([*one, *other], ("from", "from_link"), _CROSSING),
}
