"""The ledger: the fate of every message, by hop. Each printed figure is a selection or a sum of its entries.

In: the losses and ends of ``accounting``, and the verdicts on refused messages. Out: a ``LedgerWay`` for each
stream, and for what only a counter shows: its hops in order, each with its entries. Only which of the lost
arrivals are copies is decided here; all else is put at its hop. ``docs/balance.md`` is the theory.

Rules:

1. The unit is one arrival: a datagram that reached a hop (each copy counts), or a published sequence count.
   An arrival either goes on to the next hop or ends at this one, in exactly one entry: ``lost`` (the capture
   shows the cause), ``unaccounted`` (certainly missing, cause unknown), ``uncertain`` (lost, or only not
   captured), ``shared`` (upper bound of a part in losses that several traffics share), ``superseded``
   (replaced by a newer message), ``waiting`` (possibly still under way), or ``not_captured``.
2. The arrivals that leave a hop are the arrivals that enter the next hop. So the entries alone give the row
   of each hop, ``in + duplicated = out + all entries there``, and no arrival is counted twice.
3. Each row names the source of its figures. If no evidence decides a fate, the arrival is never ``lost``.
4. A message is lost only if all its arrivals are lost. If a cFS received ``n`` more datagrams than the
   capture shows, or a network made ``n`` copies, then up to ``n`` lost arrivals may be copies of messages
   that arrived. The number of messages proven lost is lower by that.
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
from edoras_tools.links.bare import ROBOT
from edoras_tools.model import NO_MSG_ID, NO_ROUTE
from edoras_tools.wire.arrays import Places, groups

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.evidence.table import Rows
    from edoras_tools.diagnosis.matching.streams import Stream
    from edoras_tools.diagnosis.verdict import Verdict

HowEnded = Literal["lost", "superseded", "waiting", "not_captured", "unaccounted", "uncertain", "shared"]
"""The fates of an arrival that does not go on to the next hop."""
ENDINGS: Final[tuple[HowEnded, ...]] = get_args(HowEnded)
ENDING_TEXTS: Final[Mapping[str, str]] = {
    "superseded": "gave way to a newer one",
    "waiting": "may be on its way still",
    "not_captured": "could not be followed: the capture may lack it",
    "unaccounted": "missing, and nothing shows why",
    "uncertain": "may be lost, or only not seen",
    "shared": "may be among losses that a counter has of several MsgIds",
}
"""Ending to its text for people; the text of a loss depends on its cause (``CAUSES``)."""
_SUMMED: Final = ("came", "out", "duplicated", "late", "out_of_order", "copies", "sure_copies", *ENDINGS[1:])
CI_HOP: Final = "CI"
APPLICATION: Final = "application"
PEER: Final = "SBN peer"
CAPTURE: Final = "capture"
UNHEARD: Final = "sbn_timeout"
"""Cause of losses to an SBN peer that timed out; also the name of the rule that reports it."""
PEER_RESTARTED: Final = "sbn_peer_restart"
"""Cause of losses to an SBN peer that restarted; also the name of the rule that reports it."""
TO_SOCKET: Final = "to_socket"
DAMAGED: Final = "damaged"
"""Cause of losses of datagrams with a wrong checksum; also the name of the rule that reports it."""
ON_PURPOSE: Final = "/edoras/faults: done on purpose"
NOT_COUNTED: Final = "not observable: "
"""Start of the text in ``Row.counted`` that names the counter which is not in the capture."""
SEEN: Final = "datagrams in the capture"
_COUNT: Final = "sequence count"
_NOT_LOST: Final = "what the software bus did not lose"
_NO_INGEST: Final = f"{NOT_COUNTED}no 0x884 of this CI, no kernel counter of its socket"
_NO_BUS: Final = f"{NOT_COUNTED}no 0x803 of its cFS"
_BY_BUS: Final[Mapping[str, str]] = {"in": "0x803: it counts only what is lost", "lost": "0x803"}
_BEFORE_CI: Final = frozenset({"network", "socket", "down", "restart", "ci_stopped", PORT_CLOSED})
_NOT_READ: Final = frozenset({"down", "network", "sbn_socket", PORT_CLOSED})
_ON_BUS: Final = frozenset({*COUNTERS, "unknown"})
_BEHIND_BUS: Final = frozenset(
    {"stopped", "restart_failed", "away", "unsubscribed", "disabled", "route", "beside", DAMAGED}
)
_AT_PIPE: Final = frozenset({*COUNTERS, "stopped", "away", "route"})
_BEHIND_PIPE: Final = frozenset({"after", "unknown", "fragments"})


class LossCause(NamedTuple):
    """The texts of one cause of loss.

    Attributes:
        text: place or reason of the loss, as the first screen prints it.
        listed: sentence for one lost message, with ``{hop}`` for the hop; empty if entries have their own.
        rules: rules whose verdicts explain the cause without naming it; if empty, the rule of its name.
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
    "sbn_socket": LossCause("in SBN's full socket", rules=("crossing_loss",)),
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
    "disabled": LossCause("while Telemetry Output was not enabled", "Telemetry Output was not enabled"),
    "route": LossCause("while their route on the bus was disabled", "its route on the bus was disabled"),
    "no_subscriber": LossCause("without a subscriber in cFS"),
    PORT_CLOSED: LossCause("to a port where nobody listened", "nobody listened on {}"),
    REFUSED: LossCause(
        "turned away on the way: ICMP errors came back", "an ICMP error came back from the way to {}"
    ),
    "beside": LossCause("to a second cFS, started beside the first", "a second cFS had CI's port"),
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
"""Cause to its texts, for each cause that the name of a rule alone does not explain."""


def cause_text(cause: str) -> str:
    """Return the place or reason of a loss for the first screen; the cause itself if it has no text."""
    return CAUSES[cause].text if cause in CAUSES else cause


class LedgerTraffic(msgspec.Struct, frozen=True):
    """The messages that are counted together: one MsgId on one link.

    Attributes:
        route: index of the configured route, or ``NO_ROUTE``.
        link: label of the link that the capture shows them on; empty if they are not in the capture.
        msg_id: cFE MsgId; None if unknown.
        instance: label of the cFS instance; None if unknown.
        topic: topic name, for messages without a configured route.
    """

    route: int = NO_ROUTE
    link: str = ""
    msg_id: int | None = None
    instance: str | None = None
    topic: str = ""

    @property
    def key(self) -> tuple[Any, ...]:
        """The fields that identify the traffic; equal in all its rows."""
        return self.route, self.link, self.msg_id, self.instance, self.topic


class LedgerEntry(NamedTuple):
    """Arrivals of one traffic that ended at one hop in one way.

    Attributes:
        traffic: traffic that the arrivals belong to.
        hop: name of the hop where they ended.
        ending: fate that all of them share.
        number: count of arrivals.
        cause: key of ``CAUSES`` or name of a rule; empty unless they are lost.
        text: sentence for people about the cause.
        times_ns: first and last time of sending, or begin and end of the loss, capture time in ns.
        among: candidates, of which these arrivals are some or all: messages of a stream, or rows of the
            capture; None if unknown.
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
    """The sum of all entries of one traffic at one hop.

    Attributes:
        hop: name of the hop.
        came: arrivals that entered the hop.
        out: arrivals that left the hop.
        duplicated: copies that the hop added: ``came + duplicated = out`` + all that ended here.
        lost: cause to number of arrivals.
        superseded: arrivals that a newer message replaced.
        waiting: arrivals that may still be under way.
        not_captured: arrivals that the capture cannot follow.
        unaccounted: arrivals that are certainly missing, without a visible cause.
        uncertain: arrivals that are lost, or only not captured.
        shared: upper bound of this traffic's part in a row of losses that several traffics share.
        among: link label, MsgId and hop of each traffic that may own this row's losses; empty if one does.
        counted: name of a figure to the source of that figure.
        name: cFE's name of the packet; empty if it has none.
        onward: link label and MsgId of each packet that the application makes of these messages.
        late: arrivals that a relay held over 100 ms longer than its quickest one.
        out_of_order: arrivals that left a relay after one that had entered it later.
        copies: largest number of copies among the losses at all hops; only in the first row of a traffic.
        sure_copies: smallest number of them, likewise.
        spacecraft: number of the spacecraft; None if there is only one.
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
        """Arrivals lost, by all causes together."""
        return sum(self.lost.values())

    @property
    def proven(self) -> int:
        """Arrivals that are proven missing, with or without a cause."""
        return self.all_lost + self.unaccounted

    @property
    def observed(self) -> bool:
        """Whether the capture has a counter of the losses here; without one, ``lost`` = 0 proves nothing."""
        return bool(self.lost) or not self.counted.get("lost", "").startswith(NOT_COUNTED)

    def as_json(self, topic: str | None) -> dict[str, Any]:
        """Return the row in the shape of ``doctor --json``.

        Args:
            topic: configured topic of the route; the row's own topic stands if it is empty.
        """
        return {
            "topic": topic or self.topic or None,
            "name": self.name or None,
            "link": self.link or None,
            "msg_id": None if self.msg_id is None else f"0x{self.msg_id:04x}",
            "instance": self.instance,
            **({"spacecraft": self.spacecraft} if self.spacecraft else {}),
            "hop": self.hop,
            "in": self.came,
            **{name: getattr(self, name) for name in ("duplicated", "out", "late", "out_of_order")},
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
        name: name of the hop.
        came: arrivals that entered it.
        duplicated: copies that it added.
        about: more attributes of its ``Row``, by name.
        entries: fates of the arrivals that ended here.
    """

    name: str
    came: int
    duplicated: int
    about: dict[str, Any]
    entries: list[LedgerEntry] = msgspec.field(default_factory=list)

    @property
    def ended(self) -> int:
        """Arrivals that ended here."""
        return sum(entry.number for entry in self.entries)

    @property
    def out(self) -> int:
        """Arrivals that left; 0 if cFS counted more refusals than the capture has datagrams."""
        return max(0, self.came + self.duplicated - self.ended)

    def row(self, traffic: LedgerTraffic) -> Row:
        """Return the sum of the entries as one row."""
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
    """The hops of one traffic in order, with the entries of each.

    Args:
        entered: arrivals at the first hop.
        doubtful: more arrivals, of datagrams captured twice: copies by the network, or by the capture alone.

    Attributes:
        copies: smallest and largest number of copies among the losses.
    """

    def __init__(self, traffic: LedgerTraffic, entered: int = 0, doubtful: int = 0) -> None:
        self.traffic, self._entered, self._doubtful = traffic, entered + doubtful, doubtful
        self.copies = 0, 0
        self._hops: list[_Hop] = []

    def hop(self, name: str, sources: Mapping[str, str], *, duplicated: int = 0, **about: Any) -> None:
        """Add the next hop, which all arrivals enter that are left.

        Args:
            name: name of the hop.
            sources: figure to the source of that figure (``Row.counted``).
            duplicated: copies that the hop adds.
            about: more attributes of its ``Row``.
        """
        self._hops.append(_Hop(name, self.left, duplicated, {"counted": sources, **about}))
        if len(self._hops) == 1:
            self.end("uncertain", self._doubtful)

    def end(self, ending: HowEnded, number: int, cause: str = "", **about: Any) -> None:
        """Add an entry at the last hop, unless the number is 0; ``about`` has more of its attributes."""
        if number:
            hop = self._hops[-1]
            hop.entries.append(LedgerEntry(self.traffic, hop.name, ending, number, cause, **about))

    def add_losses(self, losses: Iterable[Loss], kinds: frozenset[str]) -> None:
        """Add an entry at the last hop for each loss of the named kinds."""
        for loss in losses:
            if loss.kind in kinds:
                text = CAUSES[loss.kind].listed.format(f"the port of {loss.hop}", hop=loss.hop)
                times = loss.start_ns, loss.end_ns
                self.end("lost", loss.lost, loss.kind, text=text, times_ns=times, among=loss.among)

    @property
    def left(self) -> int:
        """Arrivals that leave the last hop, after the entries made so far."""
        return self._hops[-1].out if self._hops else self._entered

    @property
    def counted_by(self) -> str:
        """The source of the number of arrivals that leave the last hop."""
        return str(self._hops[-1].about["counted"].get("out", SEEN)) if self._hops else SEEN

    @property
    def onward(self) -> tuple[tuple[str, int], ...]:
        """Link label and MsgId of each packet that the application made; empty in front of it."""
        return tuple(self._hops[-1].about.get("onward", ())) if self._hops else ()

    def close(self, out: int) -> None:
        """Set the arrivals that left the last hop, and compute ``came`` of each hop backwards from it."""
        for hop in reversed(self._hops):
            hop.came = out = out + hop.ended - hop.duplicated

    def entries(self) -> Iterator[LedgerEntry]:
        """Yield all entries, hop by hop."""
        for hop in self._hops:
            yield from hop.entries

    def rows(self) -> list[Row]:
        """Return one row for each hop."""
        rows = [hop.row(self.traffic) for hop in self._hops]
        sure, most = self.copies
        return [replace(row, copies=most, sure_copies=sure) for row in rows[:1]] + rows[1:]


class MessageLedger:
    """The fates of all traffic of a capture.

    Attributes:
        ways: one way for each stream, in the order of the streams; then the traffic that has no stream.
    """

    def __init__(self, case: Case) -> None:
        self._streams = case.streams
        self.ways = list(_ways(case))

    def way(self, stream: Stream) -> LedgerWay:
        """Return the way of a stream; the stream has to be one of the case."""
        return next(way for item, way in zip(self._streams, self.ways, strict=False) if item is stream)

    def rows(self) -> list[Row]:
        """Return one row for each traffic and hop."""
        return [row for way in self.ways for row in way.rows()]

    def losses(self) -> Iterator[LedgerEntry]:
        """Yield the entries that end ``lost``, in the order of the ways."""
        for way in self.ways:
            yield from (entry for entry in way.entries() if entry.ending == "lost")


def _ways(case: Case) -> Iterator[LedgerWay]:
    for stream in case.streams:
        fate = case.commands.fates.get(stream)
        way = _published(case, stream) if fate is None else _sent(case, fate)
        if (silent := case.unheard.get(stream)) is not None:
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
    for flow, number, rest in case.unreached_flows:
        way = LedgerWay(LedgerTraffic(link=flow.looks_like.label), number + rest)
        way.hop(f"{UDP_PORT} {flow.destination}", dict.fromkeys(("in", "lost"), "ICMP errors"))
        text, times = CAUSES[PORT_CLOSED].listed.format(flow.destination), (flow.first_ns, flow.last_ns)
        way.end("lost", number, PORT_CLOSED, text=text, times_ns=times)
        way.end("uncertain", rest)
        yield way
    yield from (_unseen(case, loss) for loss in case.losses if loss.stream is None)
    for instance, number in (+case.commands.uncaptured).items():  # without zeros
        way = LedgerWay(LedgerTraffic(instance=case.label(instance)), number)
        way.hop(BUS, _BY_BUS)
        way.end("not_captured", number)
        yield way
    for msg_id, number in case.telemetry.in_part.items():
        way = LedgerWay(LedgerTraffic(msg_id=msg_id), number)
        way.hop(BEHIND, {"in": SEEN})
        way.end("uncertain", number)
        yield way
    for refused in (one for one in case.refused if case.commands.unplaced[one] or one.perhaps):
        yield _of_no_stream(case, refused, case.commands.unplaced[refused])
    if drops := case.capture.drops:
        way = LedgerWay(LedgerTraffic(), drops + len(case.rows))
        way.hop(CAPTURE, {"in": "the capture's own counter", "out": SEEN})
        way.end("not_captured", drops)
        yield way


def _sent(case: Case, fate: Fate) -> LedgerWay:
    """Return the way of a stream into cFS: CI or SBN, software bus, application."""
    stream, losses = fate.stream, list(case.losses_of(fate.stream))
    faults, relayed = case.faults_on(stream), case.commands.relayed.get(stream)
    # Several receivers may share a MsgId: the proxy's faults stand in the first stream only.
    first = next(item for item in case.streams if case.faults_on(item) is faults)
    dropped, doubled = (faults.dropped, min(faults.doubled, len(stream))) if first is stream else ([], 0)
    traffic = LedgerTraffic(stream.route, stream.link.label, stream.msg_id, case.receiver_label(stream))
    entered = len(stream) + len(dropped) - doubled
    entered += relayed.more if relayed else 0
    entered += len(case.damaged[stream]) + case.commands.never_came.get(stream, 0)
    way = LedgerWay(traffic, entered, case.perhaps_doubled[stream.link.code, stream.receiver, stream.msg_id])
    if relayed:
        losses = _by_relay(way, relayed, losses)
    if dropped or doubled:
        _by_proxy(way, dropped, len(dropped), doubled)
    all_out = {"out": "all of them came out of cFS again"} if fate.seen and fate.arrived.all() else {}
    _add_reader(case, fate, way, all_out, losses)
    lost = {"lost": "0x803, and what cFS refuses by itself"} if case.tracks else all_out or {"lost": _NO_BUS}
    way.hop(BUS, {"in": way.counted_by, **lost})
    if not fate.seen:
        way.add_losses(losses, _BEHIND_BUS)
    way.add_losses(losses, _ON_BUS)
    for item, number, refused in fate.refused:
        _refuse(way, item, number, refused)
    came = int(fate.arrived.sum()) + fate.ends["passed_on"]
    if fate.reached is not None:
        came = fate.reached + fate.ends["unaccounted"] + fate.ends["elsewhere"]
    way.end("shared", max(0, min(fate.ends["shared"], way.left - came)))
    _behind_bus(case, fate, way)
    way.copies = _lost_copies(case, fate, doubled)
    return way


def _lost_copies(case: Case, fate: Fate, doubled: int) -> tuple[int, int]:
    """Return how many lost arrivals are copies of messages that arrived: the least and the most.

    Where some of several equal messages came out, the others are copies, up to the number of copies.

    Args:
        doubled: copies that a proxy made and the capture does not show.
    """
    stream, relayed = fate.stream, case.commands.relayed.get(fate.stream)
    copied = np.isin(stream.rows, case.prepared.duplicates) | find_echoes(case.rows, stream.rows)
    for span in stream.spans if len(stream.spans) > 1 else ():  # each span has its own rate
        copied[span.rows] |= find_echoes(case.rows, stream.rows[span.rows])
    number = relayed.figures["duplicated"] if relayed else int(copied.sum())
    if not fate.seen:  # else each lost message is a datagram of the capture
        doubled += sum(item.not_captured for item in case.ingests_at(stream.receiver))
    if len(fate.hops) != 1 or doubled:
        return 0, number + doubled
    _, first, which = np.unique(fate.hops[0].prints, return_index=True, return_inverse=True)
    if len(stream) - len(first) == number:  # then equal values mean one message
        copied = ~np.isin(np.arange(len(stream)), first)
    if int(copied.sum()) != number:
        return 0, number
    copies, came, absent = (np.bincount(which, some) for some in (copied, fate.arrived, ~fate.arrived))
    ended = sum(fate.ends.values()) + fate.waiting - fate.ends["unaccounted"]
    # Of equal messages, all that came out may be copies of one.
    sure = int(np.maximum(0, copies - np.maximum(0, came - 1)).sum()) - ended
    return max(0, sure), int(np.minimum(absent, copies).sum())


def _by_relay(way: LedgerWay, relayed: LostInRelay, losses: Sequence[Loss]) -> list[Loss]:
    """Add the hop of a relay that was captured on both sides; return the losses at other hops."""
    way.hop(relayed.hop, {"in": SEEN, "out": SEEN}, **relayed.figures)
    own = [loss for loss in losses if loss.hop == relayed.hop]
    way.add_losses(own, frozenset({"network"}))
    way.end("uncertain", len(relayed.lost_ns) - sum(loss.lost for loss in own))
    return [loss for loss in losses if loss.hop != relayed.hop]


def _behind_bus(case: Case, fate: Fate, way: LedgerWay) -> None:
    """Add the hops behind the software bus: Telemetry Output for its own commands, and the application."""
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
        _add_application(case, fate, way)


def _damaged(case: Case) -> Iterator[LedgerWay]:
    """Yield a way for each MsgId of damaged datagrams to cFS that belong to no stream."""
    rows = case.damaged[None]
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
    """Add a ``lost`` entry at the last hop for each damaged datagram."""
    for when in rows.time_ns.tolist():
        way.end("lost", 1, DAMAGED, text=CAUSES[DAMAGED].listed, times_ns=(when, when))


def _add_reader(
    case: Case, fate: Fate, way: LedgerWay, all_out: Mapping[str, str], losses: Sequence[Loss]
) -> None:
    """Add the hop of the reader: CI, or the SBN socket if SBN did not read every datagram."""
    stream = fate.stream
    if stream.link.only_to_cfs:
        accounts = case.ingests_at(stream.receiver)
        by = "the kernel's counter of its socket" if any(item.by_kernel for item in accounts) else "0x884"
        way.hop(CI_HOP, {"in": SEEN, **({"out": by} if accounts else all_out or {"lost": _NO_INGEST})})
        way.add_losses(losses, _BEFORE_CI)
        _lose_damaged(way, case.damaged[stream])
        way.end("waiting", fate.ends["queued"])
        way.end("uncertain", fate.ends["crowded"])
        way.end("not_captured", min(fate.ends["late"], way.left))
    elif any(loss.kind in _NOT_READ for loss in losses) or len(case.damaged[stream]):
        way.hop(SBN_SOCKET, {"in": SEEN, "out": "not counted: what came out, and what the bus counts"})
        way.add_losses(losses, _NOT_READ)
        _lose_damaged(way, case.damaged[stream])


def _add_application(case: Case, fate: Fate, way: LedgerWay) -> None:
    """Add the hop of the application, where the capture shows its output."""
    outs = [hop.out for hop in fate.hops]
    ways = ", ".join("the robot link" if out.link.last_hop else case.name(out.msg_id) for out in outs)
    onward = tuple(dict.fromkeys((out.link.label, out.msg_id) for out in outs))
    sources = {"in": _NOT_LOST, "out": f"same values on {ways}"}
    way.hop(APPLICATION, sources, duplicated=fate.doubled, onward=onward)
    way.add_losses(case.losses_of(fate.stream), _BEHIND_BUS)
    way.end("superseded", fate.ends["superseded"])
    way.end("waiting", fate.waiting - fate.ends["uncertain"])
    doubts = sum(fate.ends[how] for how in ("uncertain", "missed", "held", "elsewhere", "beyond"))
    way.end("uncertain", min(doubts, max(0, way.left - int(fate.arrived.sum()))))
    way.end("unaccounted", fate.ends["unaccounted"])
    way.end("not_captured", way.left - int(fate.arrived.sum()) - fate.ends["passed_on"] - fate.doubled)


def _published(case: Case, stream: Stream) -> LedgerWay:
    """Return the way of a stream that cFS publishes: pipe of Telemetry Output or a peer, then the capture."""
    owner, losses, telemetry = case.owner(stream), case.losses_of(stream), case.telemetry
    instance = case.label(owner) if owner != NOBODY else None
    way = LedgerWay(LedgerTraffic(stream.route, stream.link.label, stream.msg_id, instance))
    by = _COUNT if stream.counted else f"{SEEN}: it has no sequence count"
    lost = "0x803" if owner in case.tracks else "not counted: no 0x803 is here"
    way.hop(case.pipe_of(stream), {"in": by, "lost": lost})
    way.add_losses(losses, _AT_PIPE)
    way.end("shared", telemetry.ends[stream]["shared"])
    way.end("not_captured", max(0, telemetry.ends[stream]["closed"] - _lost_upstream(case, stream)))
    if silenced := [(number, among) for of, number, among in telemetry.silenced if of is stream and number]:
        way.hop(telemetry_output.SOCKET, {"in": f"{_COUNT}, less what 0x803 counts", "out": SEEN})
        spans = case.silences_of(stream.sender)
        for number, among in silenced:
            before, behind = among.times_ns
            inside = [span for span in spans if span[0] < behind and before < span[1]]
            failed = bool(inside) and all(map(case.socket_failure, inside))
            # At both ends some may have been sent, and the capture missed them.
            unsure = case.perhaps_missed(len(stream), number) * failed
            about = _span_of(case, among) | {"text": f"{telemetry_output.SOCKET} failed"}
            way.end("uncertain", unsure, **about)
            way.end("lost" if failed else "not_captured", number - unsure, TO_SOCKET * failed, **about)
    faults, dropped = case.faults_on(stream), telemetry.ends[stream]["proxied"]
    doubled = min(faults.doubled, stream.duplicates if stream.counted else len(stream))
    if dropped or doubled:
        _by_proxy(way, faults.dropped, dropped, doubled)
    way.hop(BEHIND, {"in": by, "out": SEEN}, duplicated=stream.duplicates - doubled if stream.counted else 0)
    way.add_losses(losses, _BEHIND_PIPE)
    _lose_damaged(way, case.damaged[stream].take(slice(telemetry.ends[stream]["damaged"])))
    way.end("not_captured", telemetry.ends[stream]["away"])
    way.end("uncertain", sum(telemetry.ends[stream][how] for how in ("uncertain", "undecided", "astray")))
    # Losses of captured messages: they were lost on the way to the next capture.
    undelivered = (case.rows.undelivered | case.prepared.perhaps_undelivered)[stream.rows]
    own = ((item.lost, item.among) for item in losses if item.among and item.among.stream is stream)
    astray = (lost for lost, of in own if of.missing is None and undelivered[of.rows].all())
    way.close(len(stream) - sum(astray) - telemetry.ends[stream]["astray"])
    return way


def _lost_upstream(case: Case, stream: Stream) -> int:
    """Return the number of losses behind the bus that the input streams of this one already have."""
    made_of = {hop.into: hop.into for hop in case.hops if hop.out is stream}.values()
    losses = chain.from_iterable(map(case.losses_of, made_of))
    return sum(loss.lost for loss in losses if loss.kind in _BEHIND_BUS)


def _to_peer(case: Case, way: LedgerWay, stream: Stream, silent: Unheard) -> None:
    """Add the hop of an SBN peer that was silent or down while messages were sent to it."""
    peer = silent.connection.peer
    way.hop(f"{PEER} {peer}", {"in": SEEN, "out": "what it was sent while it was not silent"})
    for cause, rows, when in (
        (UNHEARD, silent.lost, "while it was silent"),
        (PEER_RESTARTED, silent.restarted, "before it was started again"),
    ):
        if rows:
            about = _span_of(case, Among(stream, np.array(rows, np.intp)))
            way.end("lost", len(rows), cause, text=f"sent to the SBN peer {peer} {when}", **about)
    way.end("uncertain", silent.uncertain)


def _to_port(case: Case, way: LedgerWay, item: Unreached) -> None:
    """Add the hop of an endpoint that ICMP errors show to be closed or unreachable."""
    endpoint = case.endpoints[item.endpoint]
    sources = {"in": SEEN, "lost": "ICMP errors", "out": "datagrams without an ICMP error"}
    way.hop(f"{UDP_PORT} {endpoint}", sources, onward=way.onward)
    for cause, rows in item.lost.items():
        about = _span_of(case, Among(item.stream, rows))
        way.end("lost", len(rows), cause, text=CAUSES[cause].listed.format(endpoint), **about)
    way.end("uncertain", len(item.uncertain))


def _by_proxy(way: LedgerWay, dropped: Sequence[tuple[int, bytes]], number: int, doubled: int) -> None:
    """Add the hop of a proxy.

    Args:
        dropped: time in ns and bytes of each datagram that the proxy dropped; none is in the capture.
        number: how many of these belong to this way.
        doubled: copies that the proxy sent.
    """
    sources = dict.fromkeys(("in", "lost", "duplicated"), ON_PURPOSE) | {"out": SEEN}
    way.hop(PROXY_HOP, sources, duplicated=doubled)
    text = f"dropped on purpose by the {PROXY_HOP}"
    if number < len(dropped):
        way.end("lost", number, PROXY_HOP, text=text, times_ns=(dropped[0][0], dropped[-1][0]))
        return
    for when, _ in dropped:
        way.end("lost", 1, PROXY_HOP, text=text, times_ns=(when, when))


def _all_dropped(case: Case) -> Iterator[LedgerWay]:
    """Yield a way for each MsgId that a proxy dropped and that has no stream in the recording."""
    streams = {id(case.faults_on(stream)) for stream in case.streams}
    for (code, _, msg_id), item in case.proxied.items():
        if item.dropped and id(item) not in streams:
            link = table.link(code)
            route = int(case.context.routes_on(link)[msg_id]) if msg_id >= 0 else NO_ROUTE
            traffic = LedgerTraffic(route, link.label, msg_id if msg_id >= 0 else None)
            way = LedgerWay(traffic, len(item.dropped))
            _by_proxy(way, item.dropped, len(item.dropped), 0)
            yield way


def _unseen(case: Case, loss: Loss) -> LedgerWay:
    """Return the way of a loss that only a counter shows: its traffic is not in the capture."""
    msg_id = None if loss.msg_id == NO_MSG_ID else loss.msg_id
    way = LedgerWay(LedgerTraffic(msg_id=msg_id, instance=case.label(loss.instance)), loss.lost)
    way.hop(loss.hop, {"in": SEEN} if loss.kind == "fragments" else _BY_BUS, among=loss.rivals)
    way.add_losses([loss], frozenset({loss.kind}))
    rivals, twice = {item[1] for item in loss.rivals}, {*case.rows.msg_id[case.prepared.duplicates].tolist()}
    if rivals and (twice & rivals or any(item.not_captured for item in case.ingests)):
        way.copies = 0, loss.lost
    return way


def _of_no_stream(case: Case, item: Verdict, number: int) -> LedgerWay:
    """Return the way of refused messages that belong to no stream: the datagrams of the verdict's span."""
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
    way = LedgerWay(traffic, max(number + item.perhaps, item.of or 0))
    way.hop(item.hop or "cFS", {"in": SEEN, "lost": "each datagram by itself"})
    _refuse(way, item, number, own)
    way.end("uncertain", item.perhaps)
    return way


def _refuse(way: LedgerWay, item: Verdict, number: int, among: Among | Places) -> None:
    """Add a ``lost`` entry at the last hop for messages that cFS refused."""
    text = f"{item.rule} at {item.hop or 'cFS'}"
    way.end("lost", number, item.rule, text=text, times_ns=(item.start_ns, item.end_ns), among=among)


def _span_of(case: Case, among: Among) -> dict[str, Any]:
    """Return ``among`` and ``times_ns`` (first and last message) as attributes of an entry."""
    times = case.rows.time_ns[among.stream.rows[among.rows]]
    return {"among": among, "times_ns": (int(times.min()), int(times.max()))}


def summed(rows: Iterable[Row]) -> tuple[Row, ...]:
    """Return the rows of several chapters of a capture, with the rows of one traffic at one hop added up."""
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
