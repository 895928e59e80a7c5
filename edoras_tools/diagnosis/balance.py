"""Sums of the ledger's rows: one line for each route, and the chain of hops of each command.

Rules of a chain:

1. The hops between the ground bridge and the robot are the rows of the balance, with their figures.
2. A hop without a counter is named, without figures, together with the evidence that would count it.
3. If a command leaves cFS as another packet on the Software Bus Network, the hops of that packet follow.
   Messages under way at the start, or made by the application, are ``entered`` at the first of them. If a
   command leaves both to the robot and on SBN, messages that left by the other way are ``elsewhere``; the hop
   before is then the application. So ``in = out of the hop before + entered - elsewhere``.
4. Bags of the ROS side count the hops of the bridges, for the time that bag and capture both recorded.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
from msgspec.structs import replace

from edoras_tools.cfs import sbn
from edoras_tools.diagnosis.accounting.closed import UDP_PORT
from edoras_tools.diagnosis.accounting.losses import BUS
from edoras_tools.diagnosis.evidence.relays import PROXY_HOP
from edoras_tools.diagnosis.ledger import APPLICATION, CAPTURE, CI_HOP, ENDINGS, NOT_COUNTED, Row, summed
from edoras_tools.links.bare import CI, ROBOT, TO
from edoras_tools.links.sbn import SBN
from edoras_tools.model import NO_ROUTE
from edoras_tools.wire.arrays import by_key

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    Bridges = Mapping[tuple[str, int], "BridgeCount"]
    """Label of the link and MsgId to the count of a bag."""


class Headline(NamedTuple):
    """One route, for one line.

    Attributes:
        topic: topic of the route, else the MsgId.
        rows: its rows of the balance, in the order of the hops.
        instance: link and cFS that distinguish several lines of one topic; else None.
    """

    topic: str
    rows: tuple[Row, ...]
    instance: str | None = None

    @property
    def sent(self) -> int:
        """Number of messages sent or published."""
        return sent(self.rows)

    @property
    def missing(self) -> int:
        """Number of messages proven lost, with or without a cause."""
        return sum(row.proven for row in self.rows)

    @property
    def name(self) -> str:
        """The topic, with ``instance`` if there is one."""
        return f"{self.topic} ({self.instance})" if self.instance else self.topic


def sent(rows: Iterable[Row]) -> int:
    """Return the number of messages sent or published: the arrivals at the first hop of each route."""
    first: dict[tuple[Any, ...], str] = {}
    number = 0
    for row in rows:
        # Each SBN peer has its own pipe as first hop; and each boot of a cFS has its own rows.
        hop = "SBN" if sbn.PEER_PIPE.fullmatch(row.hop) else row.hop
        if hop == first.setdefault((row.route, row.link, row.msg_id), hop):
            number += row.came
    return number


def not_counted(rows: Iterable[Row]) -> str:
    """Return a text on the first hop without a counter of its losses; empty if all hops have one."""
    unseen = (row for row in rows if row.came and not row.observed)
    return next((f"{row.counted['lost']} ({row.hop})" for row in unseen), "")


class WaySum(NamedTuple):
    """The sum of one traffic over all its hops.

    Attributes:
        hops: rows of the traffic, in the order of its hops.
    """

    hops: tuple[Row, ...]

    @property
    def messages_lost(self) -> int:
        """Messages proven lost: lost arrivals without the possible copies."""
        first = self.hops[0]
        before = first.proven if first.duplicated else 0  # where the copies were made
        return before + max(0, self._proven - before - first.copies)

    @property
    def messages_uncertain(self) -> int:
        """Messages that may be lost, beyond those proven."""
        first = self.hops[0]
        sure = min(first.sure_copies, first.copies, self._proven)
        return self._proven - sure - self.messages_lost + sum(row.uncertain for row in self.hops)

    @property
    def _proven(self) -> int:
        return sum(row.proven for row in self.hops)

    def as_json(self, topic: str | None) -> dict[str, Any]:
        """Return the sum in the shape of ``doctor --json``; ``topic`` is that of the route."""
        first = self.hops[0].as_json(topic)
        return {
            **{name: first[name] for name in ("topic", "name", "link", "msg_id", "instance")},
            "hops": [row.hop for row in self.hops],
            "in": first["in"],
            "out": self.hops[-1].out,
            "duplicated": sum(row.duplicated for row in self.hops),
            "lost": sum(row.all_lost for row in self.hops),
            **{name: sum(getattr(row, name) for row in self.hops) for name in ENDINGS[1:]},
            "messages_lost": self.messages_lost,
            "messages_uncertain": self.messages_uncertain,
        }


def ways(rows: Iterable[Row]) -> list[WaySum]:
    """Return the sum of each traffic over all its hops; without the hop of the capture itself."""
    own = (row for row in rows if row.hop != CAPTURE)
    groups = by_key(own, lambda row: (*row.key, row.hop if row.msg_id is None else ""))
    return [WaySum(tuple(members)) for members in groups.values()]


def headlines(rows: Iterable[Row], topics: Mapping[int, str]) -> list[Headline]:
    """Return one line for each configured route, and each other one with losses: the worst first.

    Without any configured route, each one has a line. Packets with a cFE name have none.

    Args:
        rows: rows of the balance.
        topics: index of a configured route to its topic.
    """
    own = (row for row in rows if row.msg_id is not None and row.link)
    groups = by_key(own, lambda row: (row.route, row.link, row.msg_id, row.instance))
    any_own = any(key[0] != NO_ROUTE for key in groups)
    result = []
    for (route, link, msg_id, instance), members in groups.items():
        missing = any(row.proven or row.superseded for row in members)
        has_row = route != NO_ROUTE or (not members[0].name and (missing or not any_own))
        if has_row and members[0].came:
            result.append((Headline(topics.get(route, f"0x{msg_id:04x}"), tuple(members)), link, instance))
    of = Counter(item.topic for item, *_ in result)
    on = Counter((item.topic, link) for item, link, _ in result)
    lines = []
    for item, link, instance in result:
        alike = on[item.topic, link]
        place = [link.upper()] * (alike < of[item.topic]) + [instance or "cFS"] * (alike > 1)
        lines.append(item._replace(instance=", ".join(place) or None))
    figures = "all_lost", "unaccounted", "superseded"
    return sorted(lines, key=lambda item: [-sum(getattr(x, name) for x in item.rows) for name in figures])


PUBLISHER: Final = "publisher to ground bridge"
SUBSCRIBER: Final = "ground bridge to subscriber"
TO_ROBOT: Final = "application to robot"
PEER_TO_ROBOT: Final = "SBN peer to robot"
_ROBOT, _SBN = (link.label for link in (ROBOT, SBN))
_GIVE_BAG: Final = f"{NOT_COUNTED}give --bag"
_CAPTURE_MORE: Final = f"{NOT_COUNTED}capture the robot link, or SBN"
_INSIDE: Final = frozenset({PROXY_HOP, CI_HOP, BUS})
_REST: Final = ENDINGS[1:]


class BridgeCount(NamedTuple):
    """The messages of one route inside a bridge, counted from a bag and the capture.

    Attributes:
        came: messages on the sender's side, in the time that both recorded.
        lost: number of these that are missing on the other side.
        bag: path of the bag.
        missed: number of ``came`` that the bag's recorder reports as missed.
    """

    came: int
    lost: int
    bag: str
    missed: int = 0


class ChainHop(msgspec.Struct, frozen=True):
    """One hop of a chain; a figure without a counter is None.

    Attributes:
        hop: name of the hop.
        came: number of messages that entered.
        lost: number of messages lost with a visible cause.
        out: number of messages that left.
        doubled: number of copies that the hop added.
        entered: messages that entered here without leaving the hop before.
        elsewhere: messages that left the hop before, but on another way.
        rest: name of each other figure of the balance to its value, without those that are 0.
        counted: source of ``out``, or the evidence that would show it.
    """

    hop: str
    came: int | None
    lost: int | None
    out: int | None
    doubled: int = 0
    entered: int = 0
    elsewhere: int = 0
    rest: Mapping[str, int] = msgspec.field(default_factory=dict)
    counted: str = ""

    @property
    def observed(self) -> bool:
        """Whether the losses at this hop were counted."""
        return self.lost is not None

    def as_json(self) -> dict[str, Any]:
        """Return the hop in the shape of ``doctor --json``."""
        return {
            "hop": self.hop,
            "in": self.came,
            "entered": self.entered,
            "elsewhere": self.elsewhere,
            "duplicated": self.doubled,
            "lost": self.lost,
            "out": self.out,
            **{name: self.rest.get(name, 0) for name in _REST},
            "counted": self.counted,
        }


class Chain(NamedTuple):
    """The hops of one route, mostly of a command.

    Attributes:
        topic: configured topic; None without a mission.
        msg_id: MsgId of the messages in the capture.
        instance: label of the cFS; None if unknown.
        hops: hops in the order of the way.
    """

    topic: str | None
    msg_id: int
    instance: str | None
    hops: tuple[ChainHop, ...]

    def as_json(self) -> dict[str, Any]:
        """Return the chain in the shape of ``doctor --json``."""
        hops = [hop.as_json() for hop in self.hops]
        return {**self._asdict(), "msg_id": f"0x{self.msg_id:04x}", "hops": hops}


def chains(rows: Iterable[Row], topics: Mapping[int, str], bridges: Bridges | None = None) -> list[Chain]:
    """Return the chain of each command to Command Ingest, and of each telemetry route that bags counted.

    Commands of cFS itself have no chain. With a mission, only its configured commands have one. Without, a
    command has one unless no message of it left the software bus.

    Args:
        rows: rows of the balance.
        topics: index of a configured route to its topic; empty without a mission.
        bridges: counts of bags.
    """
    whole = summed(rows)
    mine = (row for row in whole if row.link == CI.label and row.msg_id is not None and not row.name)
    groups = by_key(mine, lambda row: (row.route, row.msg_id or 0, row.instance))
    result = []
    for (route, msg_id, instance), own in groups.items():
        if (topics and route == NO_ROUTE) or not any(row.hop == BUS and (row.out or topics) for row in own):
            continue
        hops = tuple(_hops(own, whole, bridges or {}))
        result.append(Chain(topics.get(route), msg_id, instance, hops))
    for key, count in (bridges or {}).items():
        if own := [row for row in whole if key[0] == TO.label and (row.link, row.msg_id) == key]:
            hops = (*map(_of_row, own), _bridge(SUBSCRIBER, count))
            result.append(Chain(topics.get(own[0].route), key[1], own[0].instance, hops))
    return result


def _hops(own: Sequence[Row], whole: Sequence[Row], bridges: Bridges) -> Iterator[ChainHop]:
    first = own[0]
    yield _bridge(PUBLISHER, bridges.get((first.link, first.msg_id or 0)), out=first.came)
    yield from map(_of_row, own)
    last = next(row for row in reversed(own) if not row.hop.startswith(UDP_PORT))
    if last.hop in _INSIDE:
        yield ChainHop(TO_ROBOT, last.out, None, None, counted=_CAPTURE_MORE)
    for way in last.onward:
        further = [row for row in whole if (row.link, row.msg_id) == way and way[0] != _ROBOT]
        further = [row for row in further if row.instance == last.instance] or further
        for place, row in enumerate(further):
            hop = _of_row(row)
            more = 0 if place else row.came - last.out
            yield replace(hop, entered=max(0, more), elsewhere=max(0, -more))
        if way[0] == _SBN and further and further[-1].hop != BUS:  # else the SBN peer is another cFS
            yield _bridge(PEER_TO_ROBOT, bridges.get(way), came=_last_out(whole, way))


def _last_out(rows: Iterable[Row], way: tuple[str, int]) -> int | None:
    """Return the messages that left the last hop of a packet, over all its rows; None without any row."""
    hops = by_key((row for row in rows if (row.link, row.msg_id) == way), lambda row: row.hop)
    return sum(row.out for row in [*hops.values()][-1]) if hops else None


def _bridge(
    hop: str, count: BridgeCount | None, *, came: int | None = None, out: int | None = None
) -> ChainHop:
    if count is None:
        return ChainHop(hop, came, None, out, counted=_GIVE_BAG)
    out, rest = count.came - count.lost - count.missed, {"not_captured": count.missed}
    return ChainHop(hop, count.came, count.lost, out, rest=rest, counted=f"in {count.bag}")


def _of_row(row: Row) -> ChainHop:
    rest: dict[str, int] = {name: value for name in _REST if (value := getattr(row, name))}
    to_robot = row.hop == APPLICATION and {label for label, _ in row.onward} == {_ROBOT}
    how = row.counted.get("out") or row.counted.get("lost", "")
    lost: int | None = row.all_lost
    if not row.observed:
        how, lost = row.counted["lost"], None
    name = TO_ROBOT if to_robot else row.hop
    return ChainHop(name, row.came, lost, row.out, row.duplicated, rest=rest, counted=how)
