"""The balance of every route and hop: what went in, what came out, and what became of the rest.

Rules:

1. In every row ``in + duplicated = out + lost + superseded + waiting + not_captured + unaccounted``, and no
   figure is negative.
2. What comes out of a hop goes into the next one of the same messages.
3. A message is lost, superseded or unaccounted for at one hop only: the sums of all rows count it once.
4. Every loss that a verdict names is a figure of a row here, and every figure here has a verdict.
5. A figure says where it was counted.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.cfs import sbn, telemetry_output
from edoras_tools.diagnosis.accounting.losses import BEHIND, COUNTERS, SBN_SOCKET, Loss, LossKind
from edoras_tools.diagnosis.accounting.ports import PORT_CLOSED, UDP_PORT
from edoras_tools.diagnosis.evidence.instances import NOBODY
from edoras_tools.diagnosis.evidence.relays.proxied import PROXY_HOP
from edoras_tools.links import table
from edoras_tools.links.robot import ROBOT
from edoras_tools.model import NO_MSG_ID, NO_ROUTE

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from edoras_tools.diagnosis.accounting.closed import Unheard
    from edoras_tools.diagnosis.accounting.commands import Refused
    from edoras_tools.diagnosis.accounting.fates import Fate
    from edoras_tools.diagnosis.accounting.ports import Unreached
    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.matching.streams import Stream

CI_HOP: Final = "CI"
BUS: Final = "software bus"
APPLICATION: Final = "application"
_HOPS: Final = frozenset({PROXY_HOP, CI_HOP, BUS, APPLICATION, BEHIND})
_BEFORE_CI: Final[tuple[LossKind, ...]] = ("network", "socket", "down", "restart", "ci_stopped", PORT_CLOSED)
_NOT_READ: Final[tuple[LossKind, ...]] = ("sbn_socket", "down", PORT_CLOSED)
_FIGURES: Final = (
    *("came", "out", "duplicated", "superseded", "waiting"),
    *("not_captured", "unaccounted", "uncertain", "shared"),
)
_SEEN: Final = "datagrams in the capture"
_COUNT: Final = "sequence count"
NOT_COUNTED: Final = "not observable: "
"""How the text begins that says what would have counted a figure."""
_NO_INGEST: Final = f"{NOT_COUNTED}no 0x884 of this CI, no kernel counter of its socket"
_NO_BUS: Final = f"{NOT_COUNTED}no 0x803 of its cFS"
_COUNTED: Final[Mapping[str, str]] = {"in": "0x803: it counts only what is lost", "lost": "0x803"}
PEER: Final = "SBN peer"
BEHIND_LINKS: Final = (PEER, UDP_PORT)
"""How hops are called that are behind what the capture shows of a message."""
UNHEARD: Final = "sbn_timeout"
"""Cause of the loss of what was sent to a peer that timed out: the rule that tells of it."""
PEER_RESTARTED: Final = "sbn_peer_restart"
"""Cause of the loss of what was sent to a peer that was started again: the rule that tells of it."""
ON_PURPOSE: Final = "/edoras/faults: done on purpose"


@dataclass(frozen=True, slots=True)
class Row:
    """What became of the messages of one route at one hop.

    Attributes:
        route: index of the configured route, or ``NO_ROUTE``.
        link: label of the link on which the messages are seen.
        msg_id: which; None where it is not known which.
        instance: the cFS, as people are told of it; None where unknown.
        hop: where.
        came: how many went in.
        out: how many came out.
        duplicated: of those, how many more than once.
        lost: cause to how many.
        superseded: how many gave way to a newer one.
        waiting: how many may be on their way still.
        not_captured: how many could not be followed: nothing here shows what became of them.
        unaccounted: how many are missing without a cause that the capture shows.
        uncertain: how many may be lost, or only not captured.
        shared: how many, at the most, are among the losses of a row that is of several: see ``among``.
        among: link, MsgId and hop of each row that a loss may be of, where it is not known of which.
        counted: figure to where it was counted.
        name: cFE's name for the packet, if it has one.
        onward: label of the link and MsgId of each packet as which it came out of the application.
        topic: its topic, where no route is configured for it.
    """

    route: int
    link: str
    msg_id: int | None
    instance: str | None
    hop: str
    came: int
    out: int
    duplicated: int = 0
    lost: Mapping[str, int] = field(default_factory=dict)
    superseded: int = 0
    waiting: int = 0
    not_captured: int = 0
    unaccounted: int = 0
    uncertain: int = 0
    shared: int = 0
    among: tuple[tuple[str, int, str], ...] = ()
    counted: Mapping[str, str] = field(default_factory=dict)
    name: str = ""
    onward: tuple[tuple[str, int], ...] = ()
    topic: str = ""

    @property
    def all_lost(self) -> int:
        """How many were lost, of all causes."""
        return sum(self.lost.values())

    @property
    def observed(self) -> bool:
        """Whether something counts what is lost there; if not, 0 means nothing."""
        return bool(self.lost) or not self.counted.get("lost", "").startswith(NOT_COUNTED)

    @property
    def adds_up(self) -> bool:
        """Whether rule 1 holds."""
        rest = self.superseded + self.waiting + self.not_captured + self.unaccounted
        rest += self.uncertain + self.shared
        figures = (self.came, self.out, self.duplicated, *self.lost.values(), rest)
        return min(figures) >= 0 and self.came + self.duplicated == self.out + self.all_lost + rest

    def as_json(self, topic: str | None) -> dict[str, Any]:
        """Return it in the shape of ``doctor --json``."""
        return {
            "topic": topic or self.topic or None,
            "name": self.name or None,
            "link": self.link or None,
            "msg_id": None if self.msg_id is None else f"0x{self.msg_id:04x}",
            "instance": self.instance,
            "hop": self.hop,
            "in": self.came,
            "duplicated": self.duplicated,
            "out": self.out,
            "lost": self.all_lost,
            "lost_by": dict(self.lost),
            "superseded": self.superseded,
            "waiting": self.waiting,
            "not_captured": self.not_captured,
            "unaccounted": self.unaccounted,
            "uncertain": self.uncertain,
            "shared": self.shared,
            "among": [
                {"link": link or None, "msg_id": f"0x{msg_id:04x}", "hop": hop}
                for link, msg_id, hop in self.among
            ],
            "counted": dict(self.counted),
        }


@dataclass(frozen=True, slots=True)
class Headline:
    """What became of the messages of one route, in one line.

    Attributes:
        topic: its topic, else the name of the packet, else its MsgId.
        sent: how many were sent or published.
        arrived: how many came out at the end; None where that cannot be seen.
        superseded: how many gave way to a newer one.
        lost: how many were lost.
        waiting: how many may be on their way still.
        not_captured: how many could not be followed.
        unaccounted: how many are missing without a cause.
        uncertain: how many may be lost, or are only not seen.
        shared: the most that may be among the losses of several together.
        instance: of which cFS, where several have the route; else None.
    """

    topic: str
    sent: int
    arrived: int | None
    superseded: int
    lost: int
    waiting: int
    not_captured: int
    unaccounted: int
    uncertain: int = 0
    shared: int = 0
    instance: str | None = None

    @property
    def missing(self) -> int:
        """How many are proven lost, with or without a cause."""
        return self.lost + self.unaccounted

    @property
    def name(self) -> str:
        """The topic, and of which cFS where several have it."""
        return f"{self.topic} ({self.instance})" if self.instance else self.topic


def sent(rows: Iterable[Row]) -> int:
    """Return how many messages were sent or published: what went into the first hop of each route."""
    first: dict[tuple[Any, ...], str] = {}
    number = 0
    for row in rows:
        # Each peer has a pipe of its own, and a cFS that was started again rows of its own for the same hops.
        hop = "SBN" if sbn.PEER_PIPE.fullmatch(row.hop) else row.hop
        if hop == first.setdefault((row.route, row.link, row.msg_id), hop):
            number += row.came
    return number


def not_counted(rows: Iterable[Row]) -> str:
    """Return where nothing counts what was lost, and what would; empty where all is counted."""
    unseen = (row for row in rows if row.came and not row.observed)
    return next((f"{row.counted['lost']} ({row.hop})" for row in unseen), "")


def headlines(rows: Iterable[Row], topics: Mapping[int, str]) -> list[Headline]:
    """Return a line for each configured route, and for each other of which something is missing: worst first.

    Where none is configured there is a line for each; housekeeping of cFS has none.
    """
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        if row.msg_id is None:
            continue
        if row.hop in _HOPS or row.link in {"to", "sbn"} or row.hop.startswith(UDP_PORT):
            groups.setdefault((row.route, row.link, row.msg_id, row.instance), []).append(row)
    named = {key: members for key, members in groups.items() if key[0] != NO_ROUTE}
    others = {key: members for key, members in groups.items() if not members[0].name}
    unnamed = {key: members for key, members in others.items() if key not in named}
    missing = {
        key: members
        for key, members in unnamed.items()
        if any(row.all_lost or row.superseded or row.unaccounted for row in members)
    }
    chosen = [members for members in {**named, **(missing if named else unnamed)}.values() if members[0].came]
    found = [_headline(members, topics) for members in chosen]
    same = Counter(item.topic for item in found)
    told = [
        replace(item, instance=members[0].instance if same[item.topic] > 1 else None)
        for item, members in zip(found, chosen, strict=True)
    ]
    return sorted(told, key=lambda item: (-item.lost, -item.unaccounted, -item.superseded))


def _headline(members: Sequence[Row], topics: Mapping[int, str]) -> Headline:
    first, last = members[0], next(row for row in reversed(members) if not row.hop.startswith(BEHIND_LINKS))
    unheard = sum(row.came - row.out for row in members if row.hop.startswith(BEHIND_LINKS))
    msg_id = f"0x{first.msg_id:04x}"
    return Headline(
        topic=topics.get(first.route, msg_id),
        sent=sent(members),
        arrived=None
        if last.hop in {PROXY_HOP, CI_HOP, BUS}
        else sum(row.out for row in members if row.hop == last.hop)
        - sum(row.duplicated for row in members)
        - unheard,
        superseded=sum(row.superseded for row in members),
        lost=sum(row.all_lost for row in members),
        waiting=sum(row.waiting for row in members),
        not_captured=sum(row.not_captured for row in members),
        unaccounted=sum(row.unaccounted for row in members),
        uncertain=sum(row.uncertain for row in members),
        shared=sum(row.shared for row in members),
    )


def balance(case: Case) -> list[Row]:
    """Return every row of a capture, in the order of the way that messages take."""
    rows: list[Row] = []
    lost: dict[int, Counter[str]] = {}
    for loss in case.losses:
        if loss.stream is not None:
            lost.setdefault(id(loss.stream), Counter())[loss.kind] += loss.lost
    for stream in case.streams:
        fate = case.commands.fates.get(id(stream))
        own = lost.get(id(stream), Counter())
        if fate is not None:
            rows += _command(case, fate, own)
        else:
            rows += _telemetry(case, stream, own)
        if (silent := case.unheard.get(id(stream))) is not None:
            rows.append(_peer(rows[-1], silent))
        for item in case.unreached:
            if item.stream is stream:
                rows.append(_port(case, rows[-1], item))
    rows += _all_dropped(case)
    rows += [_port(case, None, item) for item in case.unreached if not item.own]
    rows += [_unseen(case, loss) for loss in case.losses if loss.stream is None]
    rows += [
        Row(NO_ROUTE, "", None, case.label(instance), BUS, number, 0, not_captured=number, counted=_COUNTED)
        for instance, number in case.commands.uncaptured.items()
    ]
    rows += [_single(item, left) for item in case.refused if (left := case.commands.unplaced[id(item)])]
    if case.capture.drops:
        drops, seen = case.capture.drops, len(case.rows)
        counted = {"in": "the capture's own counter", "out": _SEEN}
        rows.append(
            Row(NO_ROUTE, "", None, None, "capture", drops + seen, seen, not_captured=drops, counted=counted)
        )
    return [row if row.msg_id is None else replace(row, name=case.packet_name(row.msg_id)) for row in rows]


def summed(rows: Iterable[Row]) -> tuple[Row, ...]:
    """Return the rows of several chapters of a capture, each of one route at one hop put together."""
    found: dict[tuple[Any, ...], Row] = {}
    for row in rows:
        key = row.route, row.link, row.msg_id, row.instance, row.hop
        known = found.get(key)
        if known is None:
            found[key] = row
            continue
        figures = {name: getattr(known, name) + getattr(row, name) for name in _FIGURES}
        onward = tuple(dict.fromkeys((*known.onward, *row.onward)))
        lost = dict(Counter(known.lost) + Counter(row.lost))
        found[key] = replace(row, lost=lost, onward=onward, **figures)
    return tuple(found.values())


def _command(case: Case, fate: Fate, lost: Counter[str]) -> list[Row]:
    """Return the rows of what goes into cFS: to CI, over the software bus, through the application."""
    stream = fate.stream
    accounts = [item for item in case.ingests if item.endpoint == stream.receiver]
    by = "the kernel's counter of its socket" if any(item.by_kernel for item in accounts) else "0x884"
    all_out = {"out": "all of them came out of cFS again"} if fate.seen and fate.arrived.all() else {}
    rows: list[Row] = []
    whose = case.receiver_label(stream)

    def add(hop: str, came: int, out: int, **figures: Any) -> int:
        row = Row(
            route=stream.route,
            link=stream.link.label,
            msg_id=stream.msg_id,
            instance=whose,
            hop=hop,
            came=came,
            out=out,
            **figures,
        )
        rows.append(row)
        return out

    at = len(stream)
    done = case.known.done_to(stream)
    # What a proxy did to a MsgId is told once, whoever else gets that MsgId.
    first = next(item for item in case.streams if case.known.done_to(item) is done)
    if (done.dropped or done.doubled) and first is stream:
        doubled = min(done.doubled, at)
        add(PROXY_HOP, at + len(done.dropped) - doubled, at, **_done(len(done.dropped), doubled))
    if stream.link.only_to_cfs:
        before = {kind: lost[kind] for kind in _BEFORE_CI if lost[kind]}
        gone = sum(before.values()) + fate.queued + fate.uncounted
        late = min(fate.late + fate.unsure, at - gone)
        told = {"in": _SEEN, "out": by} if accounts else {"in": _SEEN, **(all_out or {"lost": _NO_INGEST})}
        at = add(
            CI_HOP,
            at,
            at - gone - late,
            lost=before,
            waiting=fate.queued,
            not_captured=late,
            unaccounted=fate.uncounted,
            counted=told,
        )
    elif not_read := {kind: lost[kind] for kind in _NOT_READ if lost[kind]}:
        told = {"in": _SEEN, "out": "not counted: what came out, and what the bus counts"}
        at = add(SBN_SOCKET, at, at - sum(not_read.values()), lost=not_read, counted=told)
    ended = {kind: lost[kind] for kind in ("stopped", "away", "unsubscribed") if lost[kind]}
    on_bus = {kind: lost[kind] for kind in (*COUNTERS, "unknown") if lost[kind]} | dict(fate.refused)
    if not fate.seen:
        on_bus |= ended
    told = {"in": rows[-1].counted.get("out", _SEEN) if rows else _SEEN}
    told |= {"lost": "0x803, and what cFS refuses by itself"} if case.tracks else all_out or {"lost": _NO_BUS}
    came = max(at, sum(on_bus.values()))
    out = came - sum(on_bus.values())
    shared = min(fate.shared, out)
    out -= shared
    told_behind = fate.seen or fate.reached is not None or fate.commanded is not None
    unfollowed = 0 if told_behind else min(fate.unaccounted, out)
    at = add(BUS, came, out - unfollowed, lost=on_bus, uncertain=unfollowed, shared=shared, counted=told)
    if fate.commanded is not None and fate.unaccounted:
        told = {"in": "what the software bus did not lose", "out": "0x880: commands that it took or refused"}
        at = add(telemetry_output.NAME, at, at - fate.unaccounted, unaccounted=fate.unaccounted, counted=told)
    if fate.reached is not None:
        told = {"in": "what the software bus did not lose", "out": "number of datagrams on the robot link"}
        late = at - fate.reached - fate.unaccounted
        add(
            APPLICATION,
            at,
            fate.reached,
            waiting=late,
            unaccounted=fate.unaccounted,
            counted=told,
            onward=((ROBOT.label, NO_MSG_ID),),
        )
    if fate.seen:
        out = int(fate.arrived.sum()) + fate.passed_on
        unsure = fate.missed + fate.elsewhere + fate.beyond
        rest = at - out - sum(ended.values()) - fate.superseded - fate.waiting - fate.unaccounted - unsure
        ways = ", ".join(
            "the robot link" if hop.out.link.last_hop else case.name(hop.out.msg_id) for hop in fate.hops
        )
        add(
            APPLICATION,
            at,
            out + fate.doubled,
            duplicated=fate.doubled,
            lost=ended,
            superseded=fate.superseded,
            waiting=fate.waiting - fate.uncertain,
            uncertain=fate.uncertain + unsure,
            not_captured=rest,
            unaccounted=fate.unaccounted,
            counted={"in": "what the software bus did not lose", "out": f"same values on {ways}"},
            onward=tuple(dict.fromkeys((hop.out.link.label, hop.out.msg_id) for hop in fate.hops)),
        )
    if perhaps := case.perhaps_doubled(stream):
        rows[0] = replace(rows[0], came=rows[0].came + perhaps, uncertain=rows[0].uncertain + perhaps)
    return rows


def _done(dropped: int, doubled: int) -> dict[str, Any]:
    """Return the figures of what a proxy did on purpose."""
    return {
        "duplicated": doubled,
        "lost": {PROXY_HOP: dropped} if dropped else {},
        "counted": dict.fromkeys(("in", "lost", "duplicated"), ON_PURPOSE) | {"out": _SEEN},
    }


def _telemetry(case: Case, stream: Stream, lost: Counter[str]) -> list[Row]:
    """Return the rows of what cFS publishes: through Telemetry Output's pipe or a peer's, to the capture."""
    owner = case.known.owner(stream)
    instance = case.label(owner) if owner != NOBODY else None
    at_pipe: dict[str, int] = {kind: lost[kind] for kind in (*COUNTERS, "stopped", "away") if lost[kind]}
    behind = {kind: lost[kind] for kind in ("after", "unknown", "fragments") if lost[kind]}
    closed = case.telemetry.closed.get(id(stream), 0)
    done = case.known.done_to(stream)
    dropped = case.telemetry.proxied.get(id(stream), 0)
    doubled = min(done.doubled, stream.duplicates if stream.counted else len(stream))
    out = len(stream) - (stream.duplicates if stream.counted else doubled)
    untold = case.telemetry.untold.get(id(stream), 0)
    away = case.telemetry.away.get(id(stream), 0)
    uncertain = case.telemetry.uncertain.get(id(stream), 0)
    way = out + sum(behind.values()) + untold + away + dropped + uncertain
    silenced = case.telemetry.silenced.get(id(stream), 0)
    known = _COUNT if stream.counted else f"{_SEEN}: it has no sequence count"
    common = (stream.route, stream.link.label, stream.msg_id, instance)
    by_proxy = [Row(*common, PROXY_HOP, way, way - dropped + doubled, **_done(dropped, doubled))]
    return [
        Row(
            *common,
            case.known.hop(stream),
            way + silenced + sum(at_pipe.values()) + closed,
            way + silenced,
            lost=at_pipe,
            not_captured=closed,
            counted={
                "in": known,
                "lost": "0x803" if owner in case.tracks else "not counted: no 0x803 is here",
            },
        ),
        *((_socket(case, stream, common, way, silenced),) if silenced else ()),
        *(by_proxy if dropped or doubled else ()),
        Row(
            *common,
            BEHIND,
            way - dropped + doubled,
            len(stream),
            duplicated=max(0, stream.duplicates - doubled),
            lost=behind,
            not_captured=away,
            unaccounted=untold,
            uncertain=uncertain,
            counted={"in": known, "out": _SEEN},
        ),
    ]


def _socket(
    case: Case, stream: Stream, common: tuple[int, str, int, str | None], way: int, silenced: int
) -> Row:
    """Return the row of Telemetry Output's socket: what it took and did not send until it was enabled."""
    failed = case.socket_failed(stream)
    return Row(
        *common,
        telemetry_output.SOCKET,
        way + silenced,
        way,
        lost={"to_socket": silenced} if failed else {},
        not_captured=0 if failed else silenced,
        counted={"in": f"{_COUNT}, less what 0x803 counts", "out": _SEEN},
    )


def _peer(before: Row, silent: Unheard) -> Row:
    """Return the row of an SBN peer that did not hear all that was sent to it."""
    return replace(
        before,
        hop=f"{PEER} {silent.peer}",
        came=before.out,
        out=before.out - silent.lost - silent.restarted - silent.unaccounted - silent.uncertain,
        duplicated=0,
        lost={
            cause: number
            for cause, number in ((UNHEARD, silent.lost), (PEER_RESTARTED, silent.restarted))
            if number
        },
        superseded=0,
        waiting=0,
        not_captured=0,
        unaccounted=silent.unaccounted,
        uncertain=silent.uncertain,
        shared=0,
        counted={"in": _SEEN, "out": "what it was sent while it was not silent"},
    )


def _port(case: Case, before: Row | None, item: Unreached) -> Row:
    """Return the row of an endpoint that did not get all that was sent to it."""
    if before is None:
        before = Row(NO_ROUTE, item.stream.link.label, None, None, "", 0, len(item.stream))
    lost = {cause: len(rows) for cause, rows in item.lost.items()}
    uncertain = len(item.uncertain)
    return Row(
        *(before.route, before.link, before.msg_id, before.instance),
        f"{UDP_PORT} {case.endpoints[item.endpoint]}",
        before.out,
        before.out - sum(lost.values()) - uncertain,
        lost=lost,
        uncertain=uncertain,
        onward=before.onward,
        counted={"in": _SEEN, "lost": "ICMP errors", "out": "datagrams without an ICMP error"},
    )


def _all_dropped(case: Case) -> list[Row]:
    """Return the rows of what a proxy dropped and of which nothing else is in the recording."""
    there = {id(case.known.done_to(stream)) for stream in case.streams}
    return [
        Row(
            int(case.context.routes_on(table.link(link))[msg_id]) if msg_id >= 0 else NO_ROUTE,
            table.link(link).label,
            msg_id if msg_id >= 0 else None,
            None,
            PROXY_HOP,
            len(item.dropped),
            0,
            **_done(len(item.dropped), 0),
        )
        for (link, _, msg_id), item in case.proxied.items()
        if item.dropped and id(item) not in there
    ]


def _unseen(case: Case, loss: Loss) -> Row:
    """Return the row of a loss whose traffic is not in the capture."""
    return Row(
        NO_ROUTE,
        "",
        None if loss.msg_id == NO_MSG_ID else loss.msg_id,
        case.label(loss.instance),
        loss.hop,
        loss.lost,
        0,
        lost={loss.kind: loss.lost},
        counted=_COUNTED,
        among=loss.rivals,
    )


def _single(item: Refused, left: int) -> Row:
    """Return the row of messages that were judged by themselves."""
    came = max(left, item.of or 0)
    return Row(
        NO_ROUTE,
        item.link or "",
        item.msg_id,
        None,
        item.hop or "cFS",
        came,
        came - left,
        lost={item.rule: left},
        counted={"in": _SEEN, "lost": "each datagram by itself"},
    )
