"""Counts of some messages of a run."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar

import msgspec

from edoras_tools.decode.spacecraft import FIRST_SPACECRAFT
from edoras_tools.diagnosis.accounts import latency_ms
from edoras_tools.diagnosis.balance import not_counted, sent
from edoras_tools.diagnosis.ledger import CAPTURE, Row
from edoras_tools.io.topics.rows import APART
from edoras_tools.model import NO_MSG_ID, rate_hz
from edoras_tools.pipelines.names import PATTERN_SIGNS, PacketKinds
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from edoras_tools.addons.runs.observation import Subject
    from edoras_tools.diagnosis.examination import Diagnosis
    from edoras_tools.links.doors import SampleStream
    from edoras_tools.pipelines.capture.ledger import Account, Ledger

_Item = TypeVar("_Item")


class Parts:
    """The sources of figures, grouped by route, MsgId and topic once for all subjects.

    Args:
        ledger: counts of the capture.
        diagnosis: diagnosis; None for messages alone.
    """

    def __init__(self, ledger: Ledger, diagnosis: Diagnosis | None) -> None:
        self.ledger, self.diagnosis = ledger, diagnosis
        self._accounts = _laid_out(
            [*ledger.accounts.values()],
            lambda item: (
                ("route", item.spacecraft, item.route),
                ("id", item.spacecraft, item.msg_id),
                ("kind", item.spacecraft, int(item.link), item.kind) if item.msg_id == NO_MSG_ID else None,
            ),
        )
        routes, balance = (diagnosis.routes, diagnosis.balance) if diagnosis else ([], [])
        topics, first = diagnosis.topics if diagnosis else {}, FIRST_SPACECRAFT
        self._routes = _laid_out(
            routes, lambda row: (row["topic"], ("id", row.get("spacecraft", first), int(row["msg_id"], 0)))
        )
        self._balance = _laid_out(
            balance, lambda row: (topics.get(row.route), ("id", row.spacecraft or first, row.msg_id))
        )
        self._sample_rows = _laid_out(balance, lambda row: (row.topic,))
        samples = diagnosis.capture.samples() if diagnosis else []
        self._samples = _laid_out(samples, lambda item: (item.topic,))

    def accounts(self, subject: Subject) -> list[Account]:
        """Return the accounts of a subject."""
        return _under(self._accounts, self._keys(subject))

    def balance(self, subject: Subject) -> list[Row]:
        """Return its rows of the balance."""
        return _under(self._balance, self._keys(subject))

    def routes(self, subject: Subject) -> list[dict[str, Any]]:
        """Return its rows of the routes."""
        return _under(self._routes, self._keys(subject))

    def _keys(self, subject: Subject) -> list[Any]:
        number, packets = subject.spacecraft, subject.packets
        own, mission = number or FIRST_SPACECRAFT, self.ledger.mission
        routes = (mission if own == mission.number else mission.of(own)).routes
        keys: list[Any] = [
            key for index in packets.routes for key in (("route", number, index), routes[index].topic)
        ]
        keys += [("id", number, key.msg_id) for key in packets.keys]
        return keys + [("kind", number, *kind) for kind in packets.kinds]

    def samples(self, packets: PacketKinds) -> tuple[list[SampleStream], list[Row]]:
        """Return the samples on announced topics, and their rows of the balance."""
        names = [item.pattern for item in packets.samples]
        if any(not PATTERN_SIGNS.isdisjoint(name) for name in names):
            topics = [name for name in {*self._samples, *self._sample_rows} if name is not None]
        else:
            topics = [topic for name in names for topic in (name, f"/{name}", name.removeprefix(APART))]
        own = [name for name in topics if packets.has_sample_topic(name)]
        return _under(self._samples, own), _under(self._sample_rows, own)


def _laid_out(
    items: Sequence[_Item], keys: Callable[[_Item], Iterable[Any]]
) -> dict[Any, list[tuple[int, _Item]]]:
    """Return items with their indices, by each of their keys."""
    rows: dict[Any, list[tuple[int, _Item]]] = {}
    for place, item in enumerate(items):
        for key in keys(item):
            rows.setdefault(key, []).append((place, item))
    return rows


def _under(rows: Mapping[Any, list[tuple[int, _Item]]], keys: Iterable[Any]) -> list[_Item]:
    """Return the items under any of some keys, each once, in order."""
    own = dict(entry for key in keys for entry in rows.get(key, ()))
    return [own[place] for place in sorted(own)]


class Figures(msgspec.Struct, frozen=True):
    """The figures of some messages.

    Attributes:
        count: messages in the capture.
        rate: messages per second between the first and the last, of all senders; None below two.
        silence: longest time in s without a message, from the capture's start to its end.
        end_silence: time in s from the last message to the capture's end.
        size: smallest and largest datagram in bytes; None without messages.
        latency: 99th percentile, s; None if the capture does not show it.
        sent: messages sent, as far as the balance knows.
        lost: lost messages, from the balance.
        superseded: messages replaced by newer ones, from the balance.
        unaccounted: messages without a known fate, from the balance.
        not_counted: place where losses are not counted, and what would count them; empty if all are counted.
    """

    count: int
    rate: float | None
    silence: float
    end_silence: float
    size: tuple[int, int] | None
    latency: float | None
    sent: int
    lost: int
    superseded: int
    unaccounted: int
    not_counted: str

    @classmethod
    def of(cls, subject: Subject, parts: Parts) -> Figures:
        """Return the figures of a subject; without a diagnosis, those of its messages alone."""
        packets = subject.packets
        if packets.only_samples and parts.diagnosis is not None:
            samples, rows = parts.samples(packets)
            rates = [rate_hz(item.count, item.last_ns - item.first_ns) for item in samples]
            return cls._of(
                samples, [item for item in rates if item], rows, parts.ledger, size=None, latency=None
            )
        accounts = parts.accounts(subject)
        waits = [latency_ms(row) for row in parts.routes(subject)]
        slowest = max((item for item in waits if item is not None), default=None)
        low = min((item.bytes_min for item in accounts), default=0)
        high = max((item.bytes_max for item in accounts), default=0)
        return cls._of(
            accounts,
            [item.rate_hz for item in accounts if item.count > 1],
            parts.balance(subject),
            parts.ledger,
            size=(low, high) if accounts else None,
            latency=None if slowest is None else slowest / 1e3,
        )

    @classmethod
    def _of(
        cls,
        own: Sequence[Account | SampleStream],
        rates: Sequence[float],
        rows: Sequence[Row],
        ledger: Ledger,
        *,
        size: tuple[int, int] | None,
        latency: float | None,
    ) -> Figures:
        silences = [
            max(item.longest_ns, item.first_ns - ledger.start_ns, ledger.end_ns - item.last_ns)
            for item in own
        ]
        return cls(
            count=sum(item.count for item in own),
            rate=sum(rates) if rates else None,
            silence=max(silences, default=ledger.end_ns - ledger.start_ns) / SECOND,
            end_silence=(ledger.end_ns - max((item.last_ns for item in own), default=0)) / SECOND,
            size=size,
            latency=latency,
            sent=sent(rows),
            **_losses(rows),
        )

    @classmethod
    def whole(cls, ledger: Ledger, diagnosis: Diagnosis | None) -> Figures:
        """Return the figures of all messages; ``silence`` is the duration of the capture."""
        rows = [row for row in diagnosis.balance if row.hop != CAPTURE] if diagnosis else []
        seconds = (ledger.end_ns - ledger.start_ns) / SECOND
        return cls(ledger.datagrams, None, seconds, 0.0, None, None, sent(rows), **_losses(rows))


def _losses(rows: Sequence[Row]) -> dict[str, Any]:
    return {
        "not_counted": not_counted(rows),
        "lost": sum(row.all_lost for row in rows),
        "superseded": sum(row.superseded for row in rows),
        "unaccounted": sum(row.unaccounted for row in rows),
    }
