"""What became of the messages of each route, in one line: sums of the ledger's rows."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.cfs import sbn
from edoras_tools.diagnosis.accounting.losses import BEHIND
from edoras_tools.diagnosis.accounting.ports import UDP_PORT
from edoras_tools.diagnosis.evidence.relays.proxied import PROXY_HOP
from edoras_tools.diagnosis.ledger import APPLICATION, BUS, CAPTURE, CI_HOP, ENDINGS, PEER, Row
from edoras_tools.model import NO_ROUTE

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

_HOPS: Final = frozenset({PROXY_HOP, CI_HOP, BUS, APPLICATION, BEHIND})
BEHIND_LINKS: Final = (PEER, UDP_PORT)
"""How hops are called that are behind what the capture shows of a message."""


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


@dataclass(frozen=True, slots=True)
class WaySum:
    """What became of one traffic on its way.

    Attributes:
        hops: its rows, in order.
    """

    hops: tuple[Row, ...]

    @property
    def messages_lost(self) -> int:
        """Messages that surely never came out: of its arrivals that were lost, those that are no copies."""
        return max(0, self._proven - self.hops[0].copies)

    @property
    def messages_uncertain(self) -> int:
        """Messages that may be lost besides."""
        return self._proven - self.messages_lost + sum(row.uncertain for row in self.hops)

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
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        key = row.route, row.link, row.msg_id, row.instance, row.topic
        if row.hop != CAPTURE:
            groups.setdefault((*key, row.hop) if row.msg_id is None else key, []).append(row)
    return [WaySum(tuple(members)) for members in groups.values()]


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
        lost=sum(row.all_lost for row in members),
        **{name: sum(getattr(row, name) for row in members) for name in ENDINGS[1:]},
    )
