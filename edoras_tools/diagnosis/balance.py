"""What became of the messages of each route: sums of the ledger's rows, and the way of each command.

1. The hops between the ground bridge and the robot are the rows of the balance, with their figures.
2. A hop that nothing here counts is named all the same, without figures, and with what would show it.
3. Where a command leaves cFS as another packet, on the Software Bus Network, that packet's hops follow. Of
   what goes into the first of them, messages already under way at the start, or made by the application, are
   counted apart. If it leaves on several ways, to the robot and on SBN, what did not leave on this one left
   by the other, and the hop before is the application, whatever stands above. So ``in = out of the hop
   before + entered - elsewhere``.
4. The bridges' own hops are counted by bags of the ROS side: messages of the time that both recorded.
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
from edoras_tools.diagnosis.ledger import (
    APPLICATION,
    CAPTURE,
    CI_HOP,
    ENDINGS,
    NOT_COUNTED,
    PEER,
    Row,
    summed,
)
from edoras_tools.links.ci import CI
from edoras_tools.links.robot import ROBOT
from edoras_tools.links.sbn import SBN
from edoras_tools.links.to import TO
from edoras_tools.model import NO_ROUTE
from edoras_tools.wire.arrays.order import by_key

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

BEHIND_LINKS: Final = (PEER, UDP_PORT)
"""How hops are called that are behind what the capture shows of a message."""


class Headline(msgspec.Struct, frozen=True):
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
        instance: on which link, or of which cFS, where several have the route; else None.
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


class WaySum(NamedTuple):
    """What became of one traffic on its way.

    Attributes:
        hops: its rows, in order.
    """

    hops: tuple[Row, ...]

    @property
    def messages_lost(self) -> int:
        """Messages that surely never came out: of its arrivals that were lost, those that are no copies."""
        first = self.hops[0]
        before = first.proven if first.duplicated else 0  # where the copies were made
        return before + max(0, self._proven - before - first.copies)

    @property
    def messages_uncertain(self) -> int:
        """Messages that may be lost besides."""
        first = self.hops[0]
        sure = min(first.sure_copies, first.copies, self._proven)
        return self._proven - sure - self.messages_lost + sum(row.uncertain for row in self.hops)

    @property
    def _proven(self) -> int:
        return sum(row.proven for row in self.hops)

    def as_json(self, topic: str | None) -> dict[str, Any]:
        """Return it in the shape of ``doctor --json``."""
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
    """Return the way of each traffic through all its hops."""
    own = (row for row in rows if row.hop != CAPTURE)
    groups = by_key(own, lambda row: (*row.key, row.hop if row.msg_id is None else ""))
    return [WaySum(tuple(members)) for members in groups.values()]


def headlines(rows: Iterable[Row], topics: Mapping[int, str]) -> list[Headline]:
    """Return a line for each configured route, and for each other of which something is missing: worst first.

    Where none is configured there is a line for each; housekeeping of cFS has none.
    """
    own = (row for row in rows if row.msg_id is not None and row.link)
    groups = by_key(own, lambda row: (row.route, row.link, row.msg_id, row.instance))
    any_own = any(key[0] != NO_ROUTE for key in groups)
    result = []
    for (route, link, _, instance), members in groups.items():
        missing = any(row.proven or row.superseded for row in members)
        has_row = route != NO_ROUTE or (not members[0].name and (missing or not any_own))
        if has_row and members[0].came:
            result.append((_headline(members, topics), link, instance))
    of = Counter(item.topic for item, *_ in result)
    on = Counter((item.topic, link) for item, link, _ in result)
    lines = []
    for item, link, instance in result:
        alike = on[item.topic, link]
        place = [link.upper()] * (alike < of[item.topic]) + [instance or "cFS"] * (alike > 1)
        lines.append(replace(item, instance=", ".join(place) or None))
    return sorted(lines, key=lambda item: (-item.lost, -item.unaccounted, -item.superseded))


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
        lost=sum(row.all_lost for row in members),
        **{name: sum(getattr(row, name) for row in members) for name in ENDINGS[1:]},
    )


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
    """What a bag beside the capture counted of a route, inside the bridge.

    Attributes:
        came: messages of its sender's side, while both were recorded.
        lost: of those, how many the other side lacks.
        bag: its path.
        missed: of those that came, how many the bag's recorder says that it missed.
    """

    came: int
    lost: int
    bag: str
    missed: int = 0


class ChainHop(msgspec.Struct, frozen=True):
    """One hop of a chain; the figures are None where nothing counts them.

    Attributes:
        hop: its name.
        came: how many went in.
        lost: how many were lost.
        out: how many came out.
        doubled: of those, how many more than once.
        entered: of those that went in, how many did not come out of the hop before.
        elsewhere: of those that came out of the hop before, how many did not go in: they left on another way.
        rest: what became of the others: figures of the balance, those that are not 0.
        counted: where ``out`` was counted, or what would show it.
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
        """Whether what is lost there was counted."""
        return self.lost is not None

    def as_json(self) -> dict[str, Any]:
        """Return it in the shape of ``doctor --json``."""
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
    """The hops of one command.

    Attributes:
        topic: the configured one; None without a mission.
        msg_id: under which it is sent to Command Ingest.
        instance: the cFS, where it is known.
        hops: in the order of the way.
    """

    topic: str | None
    msg_id: int
    instance: str | None
    hops: tuple[ChainHop, ...]

    def as_json(self) -> dict[str, Any]:
        """Return it in the shape of ``doctor --json``."""
        return {
            "topic": self.topic,
            "msg_id": f"0x{self.msg_id:04x}",
            "instance": self.instance,
            "hops": [hop.as_json() for hop in self.hops],
        }


def chains(
    rows: Iterable[Row],
    topics: Mapping[int, str],
    bridges: Mapping[tuple[str, int], BridgeCount] | None = None,
) -> list[Chain]:
    """Return the chain of each command that came to Command Ingest, and of telemetry that bags have.

    Those of cFS itself have none; with a mission, only its own commands have one, else those that the
    software bus did not refuse altogether.

    Args:
        topics: of the mission, by index of the route.
        bridges: what bags counted, by label of the link and MsgId.
    """
    whole = summed(rows)
    groups: dict[tuple[int, int, str | None], list[Row]] = {}
    for row in whole:
        if row.link == CI.label and row.msg_id is not None and not row.name:
            groups.setdefault((row.route, row.msg_id, row.instance), []).append(row)
    result = []
    for (route, msg_id, instance), own in groups.items():
        if (topics and route == NO_ROUTE) or not any(row.hop == BUS and (row.out or topics) for row in own):
            continue
        hops = tuple(_hops(own, whole, bridges or {}))
        result.append(Chain(topics.get(route), msg_id, instance, hops))
    for key, count in (bridges or {}).items():
        own = [row for row in whole if key[0] == TO.label and (row.link, row.msg_id) == key]
        if own:
            hops = (*map(_of_row, own), _bridge(SUBSCRIBER, count))
            result.append(Chain(topics.get(own[0].route), key[1], own[0].instance, hops))
    return result


def _hops(
    own: Sequence[Row], whole: Sequence[Row], bridges: Mapping[tuple[str, int], BridgeCount]
) -> Iterator[ChainHop]:
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
        if way[0] == _SBN and further and further[-1].hop != BUS:  # else the peer is another cFS
            yield _bridge(PEER_TO_ROBOT, bridges.get(way), came=_last_out(whole, way))


def _last_out(rows: Iterable[Row], way: tuple[str, int]) -> int | None:
    """Return how many came out of the last hop of a packet, of all that have one."""
    out: dict[str, int] = {}
    for row in rows:
        if (row.link, row.msg_id) == way:
            out[row.hop] = out.get(row.hop, 0) + row.out
    return next(reversed(out.values()), None)


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
