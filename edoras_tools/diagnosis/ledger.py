"""The ledger: what became of every message, and where. Whatever is printed is a selection or a sum of it.

Rules:

1. The unit is an arrival: a datagram that came to a hop, each copy by itself, or a count that was published.
   Everything that arrives at a hop goes on to the next one or has one entry there: ``lost`` by a cause,
   ``unaccounted`` for (surely missing, and nothing shows why), ``uncertain`` (lost, or only not seen),
   ``shared`` (at most so many are among the losses of an entry that is of several), ``superseded``,
   ``waiting``, or ``not_captured``.
2. What comes out of a hop goes into the next one of its way. So a row for each hop follows from the entries
   alone: ``in + duplicated = out + all entries there``, and no figure is counted twice.
3. Every entry names where its figure is from. What nothing decides is never an entry of ``lost``.
4. A message is lost where all its arrivals were. Where ``n`` arrivals more came to a cFS than the capture
   shows, or a network made as many copies, up to ``n`` of those that were lost may be copies of messages
   that arrived: so many fewer messages are proven lost.
"""

from __future__ import annotations

from collections import Counter
from itertools import chain
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, get_args

import msgspec
import numpy as np
from msgspec.structs import asdict, replace

from edoras_tools.cfs import telemetry_output
from edoras_tools.diagnosis.accounting.closed import PORT_CLOSED, REFUSED, UDP_PORT, Unheard, Unreached
from edoras_tools.diagnosis.accounting.losses import BEHIND, BUS, COUNTERS, SBN_SOCKET, Among, Fate, Loss
from edoras_tools.diagnosis.evidence.copies import find_echoes
from edoras_tools.diagnosis.evidence.instances import NOBODY
from edoras_tools.diagnosis.evidence.relays import PROXY_HOP, LostInRelay
from edoras_tools.links import table
from edoras_tools.links.robot import ROBOT
from edoras_tools.model import NO_MSG_ID, NO_ROUTE
from edoras_tools.wire.arrays.order import Places, groups

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.evidence.table import Rows
    from edoras_tools.diagnosis.matching.streams import Stream
    from edoras_tools.diagnosis.verdict import Verdict

HowEnded = Literal["lost", "superseded", "waiting", "not_captured", "unaccounted", "uncertain", "shared"]
"""How an arrival can end at a hop."""
ENDINGS: Final[tuple[HowEnded, ...]] = get_args(HowEnded)
ENDING_TEXTS: Final[Mapping[str, str]] = {
    "superseded": "gave way to a newer one",
    "waiting": "may be on its way still",
    "not_captured": "could not be followed: the capture may lack it",
    "unaccounted": "missing, and nothing shows why",
    "uncertain": "may be lost, or only not seen",
    "shared": "may be among losses that a counter has of several MsgIds",
}
"""Endings of the ledger that are no losses, for people."""
_SUMMED: Final = ("came", "out", "duplicated", "late", "out_of_order", "copies", "sure_copies", *ENDINGS[1:])
CI_HOP: Final = "CI"
APPLICATION: Final = "application"
PEER: Final = "SBN peer"
CAPTURE: Final = "capture"
UNHEARD: Final = "sbn_timeout"
"""Cause of the loss of what was sent to a peer that timed out: the rule that tells of it."""
PEER_RESTARTED: Final = "sbn_peer_restart"
"""Cause of the loss of what was sent to a peer that was started again: the rule that tells of it."""
TO_SOCKET: Final = "to_socket"
DAMAGED: Final = "damaged"
"""Cause of the loss of what the network damaged: the rule that tells of it."""
ON_PURPOSE: Final = "/edoras/faults: done on purpose"
NOT_COUNTED: Final = "not observable: "
"""How the text begins that says what would have counted a figure."""
SEEN: Final = "datagrams in the capture"
_COUNT: Final = "sequence count"
_NOT_LOST: Final = "what the software bus did not lose"
_NO_INGEST: Final = f"{NOT_COUNTED}no 0x884 of this CI, no kernel counter of its socket"
_NO_BUS: Final = f"{NOT_COUNTED}no 0x803 of its cFS"
_BY_BUS: Final[Mapping[str, str]] = {"in": "0x803: it counts only what is lost", "lost": "0x803"}
_BEFORE_CI: Final = frozenset({"network", "socket", "down", "restart", "ci_stopped", PORT_CLOSED})
_NOT_READ: Final = frozenset({"down", "network", PORT_CLOSED})
_ON_BUS: Final = frozenset({*COUNTERS, "unknown"})
_BEHIND_BUS: Final = frozenset(
    {"stopped", "restart_failed", "away", "unsubscribed", "disabled", "route", DAMAGED}
)
_AT_PIPE: Final = frozenset({*COUNTERS, "stopped", "away", "route"})
_BEHIND_PIPE: Final = frozenset({"after", "unknown", "fragments"})


class LossCause(NamedTuple):
    """Why messages were lost, in words.

    Attributes:
        text: where or why, as a person reads it first.
        listed: the same of each message, with a place for the hop; empty where an entry says it itself.
        rules: those that explain it where no verdict names it; else it is the rule of that name.
    """

    text: str
    listed: str = ""
    rules: tuple[str, ...] = ()


_AT_BUS: Final = ("unattributed_loss", "to_stopped")
CAUSES: Final[Mapping[str, LossCause]] = {
    "limit": LossCause("over a message limit", "over the message limit of {hop}", _AT_BUS),
    "overflow": LossCause("at a full pipe", "{hop} was full", _AT_BUS),
    "after": LossCause(BEHIND, f"lost {BEHIND}", ("lost_after_cfs",)),
    "unknown": LossCause(
        "at a place that the capture does not show",
        "lost on the software bus",
        ("unexplained_gap", "unattributed_loss"),
    ),
    "network": LossCause("on the network before CI", "lost before CI"),
    "socket": LossCause("at CI's full socket", "CI's socket was full"),
    "down": LossCause("while cFS was down", "cFS was down", ("cfs_restart",)),
    "restart": LossCause("while CI was restarted", "{hop} was restarted"),
    "ci_stopped": LossCause("while CI was stopped", "{hop} was stopped"),
    "stopped": LossCause("while the application did not run", "{hop} did not run"),
    "restart_failed": LossCause(
        "after the application was started again: nothing came out of it any more",
        "{hop} was started again and passed nothing on",
    ),
    "away": LossCause("while the SBN peer was away", "the SBN peer was away"),
    "unsubscribed": LossCause("to an SBN peer that did not subscribe", "the SBN peer had not subscribed"),
    "disabled": LossCause(
        "while Telemetry Output was not to send them", "Telemetry Output was not to send it"
    ),
    "route": LossCause("while their route on the bus was disabled", "its route on the bus was disabled"),
    PEER_RESTARTED: LossCause("sent to an SBN peer that restarted"),
    UNHEARD: LossCause("sent to a silent SBN peer"),
    "fragments": LossCause(
        "on the way, where later fragments are dropped", "its later fragments never came", ("lost_after_cfs",)
    ),
    TO_SOCKET: LossCause("at Telemetry Output's failed socket"),
    DAMAGED: LossCause("damaged on the way", "it came damaged: its checksum is wrong"),
    "before_capture": LossCause("before the capture", rules=("dds_lost",)),
    "given_up": LossCause("given up by their reader", rules=("dds_lost",)),
    PROXY_HOP: LossCause("dropped on purpose by the proxy", rules=("proxy_faults",)),
    "host_drops": LossCause("at a full socket (kernel's counter)"),
    "unaccounted": LossCause(
        "for a cause that the capture does not show",
        rules=("crossing_loss", "lost_before_ci", "unexplained_gap", UNHEARD),
    ),
}
"""Causes that are no rules with verdicts that tell all."""


def cause_text(cause: str) -> str:
    """Return where or why messages were lost, as a person reads it first."""
    return CAUSES[cause].text if cause in CAUSES else cause


_UNREACHED: Final = {
    PORT_CLOSED: "nobody listened on {}",
    REFUSED: "an ICMP error came back from the way to {}",
}


class LedgerTraffic(msgspec.Struct, frozen=True):
    """Messages that are followed together.

    Attributes:
        route: index of the configured route, or ``NO_ROUTE``.
        link: label of the link on which the messages are seen; empty where they are not.
        msg_id: cFE MsgId; None where it is not known which.
        instance: the cFS, as people are told of it; None where unknown.
        topic: topic, where no route is configured for it.
    """

    route: int = NO_ROUTE
    link: str = ""
    msg_id: int | None = None
    instance: str | None = None
    topic: str = ""

    @property
    def key(self) -> tuple[Any, ...]:
        """What is equal in all rows of one traffic."""
        return self.route, self.link, self.msg_id, self.instance, self.topic


class LedgerEntry(NamedTuple):
    """Arrivals of one traffic that ended at one hop in one way.

    Attributes:
        traffic: the messages.
        hop: place.
        ending: how they ended.
        number: arrivals.
        cause: why, of those that are lost.
        text: the same for people.
        times_ns: when the first and the last of them was sent, or the loss began and ended.
        among: the messages that they are, or are some of: of a stream, or as rows of the capture; None where
            nothing tells.
    """

    traffic: LedgerTraffic
    hop: str
    ending: HowEnded
    number: int
    cause: str = ""
    text: str = ""
    times_ns: tuple[int, int] = (0, 0)
    among: Among | Places | None = None


class Row(LedgerTraffic, frozen=True):
    """What became of the messages of one traffic at one hop: a sum of entries.

    Attributes:
        hop: place.
        came: arrivals that went in.
        out: arrivals that came out.
        duplicated: of those, how many more than once.
        lost: cause to arrivals.
        superseded: arrivals that gave way to a newer one.
        waiting: arrivals that may be on their way still.
        not_captured: arrivals that could not be followed: nothing here shows what became of them.
        unaccounted: arrivals that are missing without a cause that the capture shows.
        uncertain: arrivals that may be lost, or only not captured.
        shared: the most that are among the losses of a row that is of several: see ``among``.
        among: link, MsgId and hop of each row that a loss may be of, where it is not known of which.
        counted: figure to where it was counted.
        name: cFE's name for the packet, if it has one.
        onward: label of the link and MsgId of each packet as which it came out of the application.
        late: of those that came out, how many much later than others.
        out_of_order: of those, how many behind one that went in later.
        copies: at most so many of what was lost on its way are copies; told in its first row.
        sure_copies: at least so many.
        spacecraft: its number, where there are several.
    """

    hop: str = ""
    came: int = 0
    out: int = 0
    duplicated: int = 0
    lost: Mapping[str, int] = msgspec.field(default_factory=dict)
    superseded: int = 0
    waiting: int = 0
    not_captured: int = 0
    unaccounted: int = 0
    uncertain: int = 0
    shared: int = 0
    among: tuple[tuple[str, int, str], ...] = ()
    counted: Mapping[str, str] = msgspec.field(default_factory=dict)
    name: str = ""
    onward: tuple[tuple[str, int], ...] = ()
    late: int = 0
    out_of_order: int = 0
    copies: int = 0
    sure_copies: int = 0
    spacecraft: int | None = None

    @property
    def all_lost(self) -> int:
        """Arrivals lost, of all causes."""
        return sum(self.lost.values())

    @property
    def proven(self) -> int:
        """Arrivals that surely did not come out, whatever the cause."""
        return self.all_lost + self.unaccounted

    @property
    def observed(self) -> bool:
        """Whether something counts what is lost there; if not, 0 means nothing."""
        return bool(self.lost) or not self.counted.get("lost", "").startswith(NOT_COUNTED)

    def as_json(self, topic: str | None) -> dict[str, Any]:
        """Return it in the shape of ``doctor --json``."""
        return {
            "topic": topic or self.topic or None,
            "name": self.name or None,
            "link": self.link or None,
            "msg_id": None if self.msg_id is None else f"0x{self.msg_id:04x}",
            "instance": self.instance,
            **({"spacecraft": self.spacecraft} if self.spacecraft else {}),
            "hop": self.hop,
            "in": self.came,
            "duplicated": self.duplicated,
            "out": self.out,
            "late": self.late,
            "out_of_order": self.out_of_order,
            "lost": self.all_lost,
            "lost_by": dict(self.lost),
            **{name: getattr(self, name) for name in ENDINGS if name != "lost"},
            "among": [
                {"link": link or None, "msg_id": f"0x{msg_id:04x}", "hop": hop}
                for link, msg_id, hop in self.among
            ],
            "counted": dict(self.counted),
        }


class _Hop(msgspec.Struct):
    """A hop of a way.

    Attributes:
        name: its name.
        came: arrivals that went in.
        duplicated: of those that came out, how many more than once.
        about: what its row says besides figures.
        entries: what ended there.
    """

    name: str
    came: int
    duplicated: int
    about: dict[str, Any]
    entries: list[LedgerEntry] = msgspec.field(default_factory=list)

    @property
    def ended(self) -> int:
        """Arrivals that ended there."""
        return sum(entry.number for entry in self.entries)

    @property
    def out(self) -> int:
        """Arrivals that came out; more may have been refused than datagrams here show."""
        return max(0, self.came + self.duplicated - self.ended)

    def row(self, traffic: LedgerTraffic) -> Row:
        """Return the sums of its entries."""
        sums: dict[str, Any] = dict.fromkeys(ENDINGS[1:], 0)
        lost: Counter[str] = Counter()
        for entry in self.entries:
            if entry.ending == "lost":
                lost[entry.cause] += entry.number
            else:
                sums[entry.ending] += entry.number
        return Row(
            **asdict(traffic),
            hop=self.name,
            came=self.out + self.ended - self.duplicated,
            out=self.out,
            duplicated=self.duplicated,
            lost=dict(lost.most_common()),
            **sums,
            **self.about,
        )


class LedgerWay:
    """The hops of one traffic in order, with what ended at each.

    Args:
        entered: arrivals at the first hop.
        doubtful: arrivals besides, if the network doubled them and not the capture.

    Attributes:
        copies: of what was lost, at least and at most so many are copies, also of what the capture lacks.
    """

    def __init__(self, traffic: LedgerTraffic, entered: int = 0, doubtful: int = 0) -> None:
        self.traffic, self._entered, self._doubtful = traffic, entered + doubtful, doubtful
        self.copies = 0, 0
        self._hops: list[_Hop] = []

    def hop(self, name: str, sources: Mapping[str, str], *, duplicated: int = 0, **about: Any) -> None:
        """Go on to the next hop; ``about`` has more of its row's attributes."""
        self._hops.append(_Hop(name, self.left, duplicated, {"counted": sources, **about}))
        if len(self._hops) == 1:
            self.end("uncertain", self._doubtful)

    def end(self, ending: HowEnded, number: int, cause: str = "", **about: Any) -> None:
        """Let so many end at the last hop; ``about`` has more of the entry's attributes."""
        if number:
            hop = self._hops[-1]
            hop.entries.append(LedgerEntry(self.traffic, hop.name, ending, number, cause, **about))

    def lose(self, losses: Iterable[Loss], kinds: frozenset[str]) -> None:
        """Let end at the last hop what was lost by some kinds of loss."""
        for loss in losses:
            if loss.kind in kinds:
                cause = CAUSES.get(loss.kind)
                listed = cause.listed if cause else _UNREACHED[PORT_CLOSED]
                text = listed.format(f"the port of {loss.hop}", hop=loss.hop)
                times = loss.start_ns, loss.end_ns
                self.end("lost", loss.lost, loss.kind, text=text, times_ns=times, among=loss.among)

    @property
    def left(self) -> int:
        """Arrivals that come out of the last hop, as far as entries say."""
        return self._hops[-1].out if self._hops else self._entered

    @property
    def counted_by(self) -> str:
        """What counted the arrivals that come out of the last hop."""
        return str(self._hops[-1].about["counted"].get("out", SEEN)) if self._hops else SEEN

    @property
    def onward(self) -> tuple[tuple[str, int], ...]:
        """Link and MsgId of each packet as which they came out of the application."""
        return tuple(self._hops[-1].about.get("onward", ())) if self._hops else ()

    def close(self, out: int) -> None:
        """Let so many come out of the last hop, and have come to each what left it or ended there."""
        for hop in reversed(self._hops):
            hop.came = out = out + hop.ended - hop.duplicated

    def entries(self) -> Iterator[LedgerEntry]:
        """Yield all entries, in order of the way."""
        for hop in self._hops:
            yield from hop.entries

    def rows(self) -> list[Row]:
        """Return a row a hop."""
        rows = [hop.row(self.traffic) for hop in self._hops]
        sure, most = self.copies
        return [replace(row, copies=most, sure_copies=sure) for row in rows[:1]] + rows[1:]


class MessageLedger:
    """What became of all traffic of a capture.

    Attributes:
        ways: one for each stream, in their order, and then for what is of none.
    """

    def __init__(self, case: Case) -> None:
        self._streams = case.streams
        self.ways = list(_ways(case))

    def way(self, stream: Stream) -> LedgerWay:
        """Return the way of a stream's messages."""
        return next(way for item, way in zip(self._streams, self.ways, strict=False) if item is stream)

    def rows(self) -> list[Row]:
        """Return a row for each traffic and hop."""
        return [row for way in self.ways for row in way.rows()]

    def losses(self) -> Iterator[LedgerEntry]:
        """Yield what is lost, in the order of the ways."""
        for way in self.ways:
            yield from (entry for entry in way.entries() if entry.ending == "lost")


def _ways(case: Case) -> Iterator[LedgerWay]:
    for stream in case.streams:
        fate = case.commands.fates.get(id(stream))
        way = _published(case, stream) if fate is None else _sent(case, fate)
        if (silent := case.unheard.get(id(stream))) is not None:
            _to_peer(case, way, stream, silent)
        for item in case.unreached:
            if item.stream is stream:
                _to_port(case, way, item)
        yield way
    yield from _all_dropped(case)
    yield from _damaged(case)
    for item in case.unreached:
        if not item.own:
            way = LedgerWay(LedgerTraffic(link=item.stream.link.label), len(item.stream))
            _to_port(case, way, item)
            yield way
    for flow, number, rest in case.shut:
        way = LedgerWay(LedgerTraffic(link=flow.looks_like.label), number + rest)
        way.hop(f"{UDP_PORT} {flow.destination}", dict.fromkeys(("in", "lost"), "ICMP errors"))
        text, times = _UNREACHED[PORT_CLOSED].format(flow.destination), (flow.first_ns, flow.last_ns)
        way.end("lost", number, PORT_CLOSED, text=text, times_ns=times)
        way.end("uncertain", rest)
        yield way
    yield from (_unseen(case, loss) for loss in case.losses if loss.stream is None)
    for instance, number in case.commands.uncaptured.items():
        way = LedgerWay(LedgerTraffic(instance=case.label(instance)), number)
        way.hop(BUS, _BY_BUS)
        way.end("not_captured", number)
        yield way
    for refused in case.refused:
        if count := case.commands.unplaced[id(refused)]:
            yield _of_no_stream(case, refused, count)
    if drops := case.capture.drops:
        way = LedgerWay(LedgerTraffic(), drops + len(case.rows))
        way.hop(CAPTURE, {"in": "the capture's own counter", "out": SEEN})
        way.end("not_captured", drops)
        yield way


def _sent(case: Case, fate: Fate) -> LedgerWay:
    """Return the way of what goes into cFS: to CI or SBN, over the software bus, through the application."""
    stream, losses = fate.stream, list(case.losses_of(fate.stream))
    faults, relayed = case.done_to(stream), case.commands.relayed.get(id(stream))
    # What a proxy did to a MsgId is told once, whoever else gets that MsgId.
    first = next(item for item in case.streams if case.done_to(item) is faults)
    dropped, doubled = (faults.dropped, min(faults.doubled, len(stream))) if first is stream else ([], 0)
    traffic = LedgerTraffic(stream.route, stream.link.label, stream.msg_id, case.receiver_label(stream))
    entered = len(stream) + len(dropped) - doubled
    entered += relayed.more if relayed else 0
    entered += len(case.damaged_of(stream)) + case.commands.never_came.get(id(stream), 0)
    doubtful = case.perhaps_doubled[stream.link.code, stream.receiver, stream.msg_id]
    way = LedgerWay(traffic, entered, doubtful)
    if relayed:
        losses = _by_relay(way, relayed, losses)
    if dropped or doubled:
        _by_proxy(way, dropped, len(dropped), doubled)
    all_out = {"out": "all of them came out of cFS again"} if fate.seen and fate.arrived.all() else {}
    _taken_in(case, fate, way, all_out, losses)
    lost = {"lost": "0x803, and what cFS refuses by itself"} if case.tracks else all_out or {"lost": _NO_BUS}
    way.hop(BUS, {"in": way.counted_by, **lost})
    if not fate.seen:
        way.lose(losses, _BEHIND_BUS)
    way.lose(losses, _ON_BUS)
    for item, number, refused in case.commands.refused_of.get(id(stream), ()):
        _refuse(way, item, number, refused)
    came = 0 if fate.reached is None else fate.reached + fate.ends["unaccounted"] + fate.ends["elsewhere"]
    way.end("shared", max(0, min(fate.ends["shared"], way.left - came)))
    _behind_bus(case, fate, way)
    way.copies = _lost_copies(case, fate, doubled)
    return way


def _lost_copies(case: Case, fate: Fate, doubled: int) -> tuple[int, int]:
    """Return of how many arrivals that were lost others may have come out: at least, and at most.

    Of equal messages of which some came out, those that did not are their copies as far as there are copies.

    Args:
        doubled: how many a proxy made, besides those that the capture shows.
    """
    stream, relayed = fate.stream, case.commands.relayed.get(id(fate.stream))
    copied = np.isin(stream.rows, case.prepared.duplicates) | find_echoes(case.rows, stream.rows)
    for span in stream.spans if len(stream.spans) > 1 else ():  # each at a rate of its own
        copied[span.rows] |= find_echoes(case.rows, stream.rows[span.rows])
    number = relayed.figures["duplicated"] if relayed else int(copied.sum())
    if not fate.seen:  # else those that are lost are datagrams of the capture
        doubled += sum(item.not_captured for item in case.ingests_at(stream.receiver))
    if len(fate.hops) != 1 or doubled:
        return 0, number + doubled
    _, first, which = np.unique(fate.hops[0].prints, return_index=True, return_inverse=True)
    if len(stream) - len(first) == number:  # then each value is one message
        copied = ~np.isin(np.arange(len(stream)), first)
    if int(copied.sum()) != number:
        return 0, number
    copies, came, absent = (np.bincount(which, some) for some in (copied, fate.arrived, ~fate.arrived))
    ended = sum(fate.ends.values()) + fate.waiting - fate.ends["unaccounted"]
    # What came out of equal ones may all be of one message.
    sure = int(np.maximum(0, copies - np.maximum(0, came - 1)).sum()) - ended
    return max(0, sure), int(np.minimum(absent, copies).sum())


def _by_relay(way: LedgerWay, relayed: LostInRelay, losses: Sequence[Loss]) -> list[Loss]:
    """Go on through a relay with both its sides in the capture; return what else was lost."""
    way.hop(relayed.hop, {"in": SEEN, "out": SEEN}, **relayed.figures)
    own = [loss for loss in losses if loss.hop == relayed.hop]
    way.lose(own, frozenset({"network"}))
    way.end("uncertain", len(relayed.lost_ns) - sum(loss.lost for loss in own))
    return [loss for loss in losses if loss.hop != relayed.hop]


def _behind_bus(case: Case, fate: Fate, way: LedgerWay) -> None:
    """Go on to what shows what became of what the software bus did not lose."""
    if not (fate.seen or fate.reached is not None or fate.commanded is not None):
        way.end("uncertain", min(fate.ends["earlier"] + fate.ends["unaccounted"], way.left))
    if fate.commanded is not None and fate.ends["unaccounted"] + fate.ends["elsewhere"]:
        way.hop(telemetry_output.NAME, {"in": _NOT_LOST, "out": "0x880: commands that it took or refused"})
        way.end("unaccounted", fate.ends["unaccounted"])
        way.end("uncertain", fate.ends["elsewhere"])
    if fate.reached is not None:
        sources = {"in": _NOT_LOST, "out": "number of datagrams on the robot link"}
        way.hop(APPLICATION, sources, onward=((ROBOT.label, NO_MSG_ID),))
        way.end("unaccounted", fate.ends["unaccounted"])
        way.end("uncertain", min(fate.ends["elsewhere"], max(0, way.left - fate.reached)))
        way.end("waiting", max(0, way.left - fate.reached))
    if fate.seen:
        _applied(case, fate, way)


def _damaged(case: Case) -> Iterator[LedgerWay]:
    """Yield what came to cFS damaged so that nothing else of its MsgId is in the capture."""
    rows = case.damaged_of(None)
    to_cfs = rows.on(lambda link: link.to_cfs and link.packets)
    to_cfs &= (rows.msg_id != NO_MSG_ID) | ~rows.on(lambda link: link.peers)
    to_cfs &= np.isin(rows.destination, [item.stream.receiver for item in case.commands.fates.values()])
    for key, own in groups(rows.link.astype(np.int64) << 32 | (rows.msg_id + 1), np.flatnonzero(to_cfs)):
        link, msg_id = table.link(key >> 32), (key & 0xFFFFFFFF) - 1
        way = LedgerWay(LedgerTraffic(link=link.label, msg_id=None if msg_id < 0 else msg_id), len(own))
        way.hop(SBN_SOCKET if link.peers else CI_HOP, {"in": SEEN, "lost": "checksums"})
        _lose_damaged(way, rows.take(own))
        yield way


def _lose_damaged(way: LedgerWay, rows: Rows) -> None:
    """Let end at the last hop datagrams that came damaged."""
    for when in rows.time_ns.tolist():
        way.end("lost", 1, DAMAGED, text=CAUSES[DAMAGED].listed, times_ns=(when, when))


def _taken_in(
    case: Case, fate: Fate, way: LedgerWay, all_out: Mapping[str, str], losses: Sequence[Loss]
) -> None:
    """Go on to what reads datagrams: CI, or SBN where it did not read all."""
    stream = fate.stream
    if stream.link.only_to_cfs:
        accounts = case.ingests_at(stream.receiver)
        by = "the kernel's counter of its socket" if any(item.by_kernel for item in accounts) else "0x884"
        way.hop(CI_HOP, {"in": SEEN, **({"out": by} if accounts else all_out or {"lost": _NO_INGEST})})
        way.lose(losses, _BEFORE_CI)
        _lose_damaged(way, case.damaged_of(stream))
        way.end("waiting", fate.ends["queued"])
        way.end("uncertain", fate.ends["crowded"])
        way.end("not_captured", min(fate.ends["late"], way.left))
    elif any(loss.kind in _NOT_READ for loss in losses) or len(case.damaged_of(stream)):
        way.hop(SBN_SOCKET, {"in": SEEN, "out": "not counted: what came out, and what the bus counts"})
        way.lose(losses, _NOT_READ)
        _lose_damaged(way, case.damaged_of(stream))


def _applied(case: Case, fate: Fate, way: LedgerWay) -> None:
    """Go on through the application, to what was seen to come out of it."""
    outs = [hop.out for hop in fate.hops]
    ways = ", ".join("the robot link" if out.link.last_hop else case.name(out.msg_id) for out in outs)
    onward = tuple(dict.fromkeys((out.link.label, out.msg_id) for out in outs))
    sources = {"in": _NOT_LOST, "out": f"same values on {ways}"}
    way.hop(APPLICATION, sources, duplicated=fate.doubled, onward=onward)
    way.lose(case.losses_of(fate.stream), _BEHIND_BUS)
    way.end("superseded", fate.ends["superseded"])
    way.end("waiting", fate.waiting - fate.ends["uncertain"])
    doubts = sum(fate.ends[how] for how in ("uncertain", "missed", "held", "elsewhere", "beyond"))
    way.end("uncertain", min(doubts, max(0, way.left - int(fate.arrived.sum()))))
    way.end("unaccounted", fate.ends["unaccounted"])
    way.end("not_captured", way.left - int(fate.arrived.sum()) - fate.ends["passed_on"] - fate.doubled)


def _published(case: Case, stream: Stream) -> LedgerWay:
    """Return the way of what cFS publishes: through Telemetry Output's pipe or a peer's, to the capture."""
    owner, losses, telemetry = case.owner(stream), case.losses_of(stream), case.telemetry
    instance = case.label(owner) if owner != NOBODY else None
    way = LedgerWay(LedgerTraffic(stream.route, stream.link.label, stream.msg_id, instance))
    by = _COUNT if stream.counted else f"{SEEN}: it has no sequence count"
    lost = "0x803" if owner in case.tracks else "not counted: no 0x803 is here"
    way.hop(case.pipe_of(stream), {"in": by, "lost": lost})
    way.lose(losses, _AT_PIPE)
    way.end("shared", telemetry.ended(stream, "shared"))
    way.end("not_captured", max(0, telemetry.ended(stream, "closed") - _told_before(case, stream)))
    silenced = [(number, among) for of, number, among in telemetry.silenced if of is stream and number]
    if silenced:
        way.hop(telemetry_output.SOCKET, {"in": f"{_COUNT}, less what 0x803 counts", "out": SEEN})
        failed = any(map(case.suppressed, case.silences_of(stream.sender)))
        for number, among in silenced:
            about = _span_of(case, among) | {"text": f"{telemetry_output.SOCKET} failed"}
            way.end("lost" if failed else "not_captured", number, TO_SOCKET if failed else "", **about)
    faults, dropped = case.done_to(stream), telemetry.ended(stream, "proxied")
    doubled = min(faults.doubled, stream.duplicates if stream.counted else len(stream))
    if dropped or doubled:
        _by_proxy(way, faults.dropped, dropped, doubled)
    sources = {"in": by, "out": SEEN}
    way.hop(BEHIND, sources, duplicated=stream.duplicates - doubled if stream.counted else 0)
    way.lose(losses, _BEHIND_PIPE)
    _lose_damaged(way, case.damaged_of(stream).take(slice(telemetry.ended(stream, "damaged"))))
    way.end("not_captured", telemetry.ended(stream, "away"))
    way.end("uncertain", sum(telemetry.ends[id(stream)][how] for how in ("uncertain", "untold", "astray")))
    # Seen here, and lost on the way to the next capture.
    undelivered = (case.rows.undelivered | case.prepared.perhaps_astray)[stream.rows]
    own = ((item.lost, item.among) for item in losses if item.among and item.among.stream is stream)
    astray = (lost for lost, of in own if of.missing is None and undelivered[of.rows].all())
    way.close(len(stream) - sum(astray) - telemetry.ended(stream, "astray"))
    return way


def _told_before(case: Case, stream: Stream) -> int:
    """Return how many that a way out did not take are told lost of what they were made of."""
    made_of = {id(hop.into): hop.into for hop in case.hops if hop.out is stream}.values()
    losses = chain.from_iterable(map(case.losses_of, made_of))
    return sum(loss.lost for loss in losses if loss.kind in _BEHIND_BUS)


def _to_peer(case: Case, way: LedgerWay, stream: Stream, silent: Unheard) -> None:
    """Go on to an SBN peer that did not hear all that was sent to it."""
    way.hop(f"{PEER} {silent.peer}", {"in": SEEN, "out": "what it was sent while it was not silent"})
    for cause, rows, when in (
        (UNHEARD, silent.lost, "while it was silent"),
        (PEER_RESTARTED, silent.restarted, "before it was started again"),
    ):
        if rows:
            about = _span_of(case, Among(stream, np.array(rows, np.intp)))
            way.end("lost", len(rows), cause, text=f"sent to the SBN peer {silent.peer} {when}", **about)
    way.end("unaccounted", silent.unaccounted)
    way.end("uncertain", silent.uncertain)


def _to_port(case: Case, way: LedgerWay, item: Unreached) -> None:
    """Go on to an endpoint that did not get all that was sent to it."""
    endpoint = case.endpoints[item.endpoint]
    sources = {"in": SEEN, "lost": "ICMP errors", "out": "datagrams without an ICMP error"}
    way.hop(f"{UDP_PORT} {endpoint}", sources, onward=way.onward)
    for cause, rows in item.lost.items():
        about = _span_of(case, Among(item.stream, rows))
        way.end("lost", len(rows), cause, text=_UNREACHED[cause].format(endpoint), **about)
    way.end("uncertain", len(item.uncertain))


def _by_proxy(way: LedgerWay, dropped: Sequence[tuple[int, bytes]], number: int, doubled: int) -> None:
    """Go on through a proxy that dropped so many of some and doubled others; they are not in the capture."""
    sources = dict.fromkeys(("in", "lost", "duplicated"), ON_PURPOSE) | {"out": SEEN}
    way.hop(PROXY_HOP, sources, duplicated=doubled)
    text = f"dropped on purpose by the {PROXY_HOP}"
    if number < len(dropped):
        way.end("lost", number, PROXY_HOP, text=text, times_ns=(dropped[0][0], dropped[-1][0]))
        return
    for when, _ in dropped:
        way.end("lost", 1, PROXY_HOP, text=text, times_ns=(when, when))


def _all_dropped(case: Case) -> Iterator[LedgerWay]:
    """Yield what a proxy dropped and of which nothing else is in the recording."""
    streams = {id(case.done_to(stream)) for stream in case.streams}
    for (code, _, msg_id), item in case.proxied.items():
        if item.dropped and id(item) not in streams:
            link = table.link(code)
            route = int(case.context.routes_on(link)[msg_id]) if msg_id >= 0 else NO_ROUTE
            traffic = LedgerTraffic(route, link.label, msg_id if msg_id >= 0 else None)
            way = LedgerWay(traffic, len(item.dropped))
            _by_proxy(way, item.dropped, len(item.dropped), 0)
            yield way


def _unseen(case: Case, loss: Loss) -> LedgerWay:
    """Return the way of a loss whose traffic is not in the capture."""
    msg_id = None if loss.msg_id == NO_MSG_ID else loss.msg_id
    way = LedgerWay(LedgerTraffic(msg_id=msg_id, instance=case.label(loss.instance)), loss.lost)
    way.hop(loss.hop, _BY_BUS, among=loss.rivals)
    way.lose([loss], frozenset({loss.kind}))
    return way


def _of_no_stream(case: Case, item: Verdict, number: int) -> LedgerWay:
    """Return the way of messages that were judged by themselves: the datagrams of that time."""
    rows = case.rows
    end = np.searchsorted(rows.time_ns, item.end_ns, side="right")
    own = np.arange(np.searchsorted(rows.time_ns, item.start_ns), end)
    if item.link:
        own = own[rows.link[own] == table.link_of_label(item.link).code]
    if item.msg_id is not None:
        own = own[rows.msg_id[own] == item.msg_id]
    down = [stream for stream in case.streams if stream.link.only_from_cfs and stream.msg_id == item.msg_id]
    owners = {case.label(case.owner(stream)) for stream in down if stream.link.label == item.link}
    instance = owners.pop() if len(owners) == 1 else None
    traffic = LedgerTraffic(link=item.link or "", msg_id=item.msg_id, instance=instance)
    way = LedgerWay(traffic, max(number, item.of or 0))
    way.hop(item.hop or "cFS", {"in": SEEN, "lost": "each datagram by itself"})
    _refuse(way, item, number, own)
    return way


def _refuse(way: LedgerWay, item: Verdict, number: int, among: Among | Places) -> None:
    """Let end at the last hop what cFS refused."""
    text = f"{item.rule} at {item.hop or 'cFS'}"
    way.end("lost", number, item.rule, text=text, times_ns=(item.start_ns, item.end_ns), among=among)


def _span_of(case: Case, among: Among) -> dict[str, Any]:
    """Return messages, and when the first and the last of them were sent, as an entry has them."""
    times = case.rows.time_ns[among.stream.rows[among.rows]]
    return {"among": among, "times_ns": (int(times.min()), int(times.max()))}


def summed(rows: Iterable[Row]) -> tuple[Row, ...]:
    """Return the rows of several chapters of a capture, each of one traffic at one hop put together."""
    sums: dict[tuple[Any, ...], Row] = {}
    for row in rows:
        key = row.route, row.link, row.msg_id, row.instance, row.hop
        before = sums.get(key)
        if before is None:
            sums[key] = row
            continue
        figures = {name: getattr(before, name) + getattr(row, name) for name in _SUMMED}
        onward = tuple(dict.fromkeys((*before.onward, *row.onward)))
        lost = dict((Counter(before.lost) + Counter(row.lost)).most_common())
        sums[key] = replace(row, lost=lost, onward=onward, **figures)
    return tuple(sums.values())
