"""Counting per route over batches: how many, how fast, how even, and what is missing."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from functools import cache
from typing import TYPE_CHECKING, Any
from zlib import crc32

import numpy as np

from edoras_tools.model import NO_MSG_ID, Finding, Link
from edoras_tools.sessions.sequence import SequenceTracker, runs
from edoras_tools.wire.names import message_name
from edoras_tools.wire.order import order_by

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.mission import Mission
    from edoras_tools.model import Columns, PacketBatch


@cache
def _bits(findings: int) -> tuple[Finding, ...]:
    return tuple(Finding(findings))


@dataclass(slots=True)
class Account:
    """What is known of one stream: one MsgId (or SBN message type) of one processor on one link.

    Times are ns. ``interval_squares`` is in seconds squared, so that a day of traffic keeps its precision.
    ``sequences`` follows the sequence counts of each endpoint that sent.
    """

    link: Link
    processor_id: int
    msg_id: int
    sbn_msg_type: int
    route: int
    count: int = 0
    first_ns: int = 0
    last_ns: int = 0
    interval_squares: float = 0.0
    sequences: defaultdict[int, SequenceTracker] = field(default_factory=lambda: defaultdict(SequenceTracker))
    bytes_min: int = 1 << 31
    bytes_max: int = 0
    bytes: int = 0
    findings: dict[str, int] = field(default_factory=dict)

    @property
    def gaps(self) -> int:
        """Sequence counts that never came."""
        return sum(item.gaps for item in self.sequences.values())

    @property
    def duplicates(self) -> int:
        """Packets that came twice; a count that never moves repeats nothing."""
        return sum(item.duplicates for item in self.sequences.values() if item.moved)

    @property
    def reordered(self) -> int:
        """Packets that came late."""
        return sum(item.reordered for item in self.sequences.values() if item.moved)

    @property
    def rate_hz(self) -> float:
        """Messages per second between the first and the last."""
        return (
            (self.count - 1) / (self.last_ns - self.first_ns) * 1e9 if self.last_ns > self.first_ns else 0.0
        )

    @property
    def jitter_ms(self) -> float:
        """Standard deviation of the time between messages."""
        if self.count < 3:
            return 0.0
        mean = (self.last_ns - self.first_ns) / 1e9 / (self.count - 1)
        return 1e3 * math.sqrt(max(0.0, self.interval_squares / (self.count - 1) - mean * mean))


class Ledger:
    """Accounts of a whole capture.

    Args:
        mission: gives topics and types their names.
    """

    def __init__(self, mission: Mission) -> None:
        self.mission = mission
        self.accounts: dict[tuple[int, int, int, int], Account] = {}
        self.datagrams = 0
        self.start_ns = 0
        self.end_ns = 0

    def tally(self, batch: PacketBatch) -> None:
        """Count a batch's datagrams, and no more."""
        if not len(batch):
            return
        low, high = int(batch.time_ns.min()), int(batch.time_ns.max())
        self.start_ns = min(self.start_ns, low) if self.datagrams else low
        self.end_ns = max(self.end_ns, high)
        self.datagrams += len(batch)

    def add(self, batch: PacketBatch, columns: Columns) -> None:
        """Count a batch, and each stream in it."""
        self.tally(batch)
        if not len(batch):
            return
        kind = columns.link.astype(np.uint16) << 9 | (columns.sbn_msg_type + 1).astype(np.uint16)
        msg_id = (columns.msg_id + 1).astype(np.uint32)
        order = order_by(msg_id, columns.processor_id, kind)
        keys = np.stack((columns.processor_id[order], kind[order], msg_id[order]))
        starts = np.append(0, np.flatnonzero((keys[:, 1:] != keys[:, :-1]).any(axis=0)) + 1)
        accounts = [self._account(columns, row) for row in order[starts].tolist()]
        self._count(accounts, batch, columns, order, starts)
        self._follow(accounts, batch, columns, order, starts)

    @property
    def findings(self) -> dict[str, int]:
        """Datagrams by finding."""
        total = Counter[str]()
        for account in self.accounts.values():
            total.update(account.findings)
        return dict(total)

    def _account(self, columns: Columns, row: int) -> Account:
        key = (
            int(columns.link[row]),
            int(columns.processor_id[row]),
            int(columns.msg_id[row]),
            int(columns.sbn_msg_type[row]),
        )
        if key not in self.accounts:
            self.accounts[key] = Account(Link(key[0]), *key[1:], int(columns.route[row]))
        return self.accounts[key]

    @staticmethod
    def _count(
        accounts: list[Account],
        batch: PacketBatch,
        columns: Columns,
        order: NDArray[np.int64],
        starts: NDArray[np.int64],
    ) -> None:
        """Add times, sizes and findings; account ``i`` has the rows ``order[starts[i]:starts[i + 1]]``."""
        times, lengths, findings = batch.time_ns[order], batch.length[order], columns.findings[order]
        counts = np.diff(np.append(starts, len(order))).tolist()
        last = times[np.append(starts[1:], len(order)) - 1].tolist()
        intervals = np.diff(times, prepend=times[0]) / 1e9
        intervals[starts] = 0
        squares = np.add.reduceat(intervals * intervals, starts).tolist()
        total = np.add.reduceat(lengths, starts, dtype=np.int64).tolist()
        smallest = np.minimum.reduceat(lengths, starts).tolist()
        largest = np.maximum.reduceat(lengths, starts).tolist()
        first = times[starts].tolist()
        for index, account in enumerate(accounts):
            gap = (first[index] - account.last_ns) / 1e9 if account.count else 0.0
            account.interval_squares += squares[index] + gap * gap
            account.first_ns = account.first_ns if account.count else first[index]
            account.last_ns = last[index]
            account.count += counts[index]
            account.bytes += total[index]
            account.bytes_min = min(account.bytes_min, smallest[index])
            account.bytes_max = max(account.bytes_max, largest[index])
        met = np.bitwise_or.reduceat(findings, starts)
        ends = np.append(starts[1:], len(order))
        for index in np.flatnonzero(met).tolist():
            known, own = accounts[index].findings, findings[starts[index] : ends[index]]
            for finding in _bits(int(met[index])):
                there = int(np.count_nonzero(own & np.uint32(finding)))
                known[finding.label] = known.get(finding.label, 0) + there

    @staticmethod
    def _follow(
        accounts: list[Account],
        batch: PacketBatch,
        columns: Columns,
        order: NDArray[np.int64],
        starts: NDArray[np.int64],
    ) -> None:
        """Follow the sequence counts of packets that have one, each sender's by itself."""
        unset = (columns.findings & np.uint32(Finding.SEQUENCE_UNSET)) != 0
        counted = ((columns.msg_id != NO_MSG_ID) & ~unset)[order]
        stream = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, len(order))))[counted]
        if not len(stream):
            return
        rows = order[counted]
        sender = _senders(batch, rows)
        turns = (stream[1:] == stream[:-1]) & (sender[1:] != sender[:-1])
        if turns.any():
            again = np.lexsort((sender, stream))
            rows, stream, sender = rows[again], stream[again], sender[again]
        changes = (stream[1:] != stream[:-1]) | (sender[1:] != sender[:-1])
        begins = np.append(0, np.flatnonzero(changes) + 1)
        trackers = [
            accounts[index].sequences[endpoint]
            for index, endpoint in zip(stream[begins].tolist(), sender[begins].tolist(), strict=True)
        ]
        for owner, _, first, last in runs(columns.sequence_count[rows], begins):
            trackers[owner].follow(first, last)

    def routes(self) -> list[dict[str, Any]]:
        """Return a row for every stream, in the shape of ``info --json``: configured topics first."""
        accounts = sorted(
            self.accounts.values(),
            key=lambda item: (
                item.route < 0,
                item.link == Link.OTHER,
                item.link,
                item.msg_id,
                item.processor_id,
            ),
        )
        return [self._row(account) for account in accounts]

    def _row(self, account: Account) -> dict[str, Any]:
        from edoras_tools.wire.sbn import MSG_TYPE_NAMES, MsgType

        route = self.mission.routes[account.route] if account.route >= 0 else None
        name = message_name(account.msg_id)
        if account.msg_id == NO_MSG_ID and account.link is Link.SBN:
            network = account.sbn_msg_type
            name = f"SBN_{MSG_TYPE_NAMES.get(network, f'TYPE_0x{network:02x}')}" if network >= 0 else ""
            name = "" if network == MsgType.APP else name
        return {
            "topic": route.topic if route else None,
            "type": route.type if route else None,
            "name": name or None,
            "link": account.link.label,
            "processor_id": account.processor_id or None,
            "msg_id": f"0x{account.msg_id:04x}" if account.msg_id != NO_MSG_ID else None,
            "count": account.count,
            "rate_hz": round(account.rate_hz, 3),
            "jitter_ms": round(account.jitter_ms, 3),
            "gaps": account.gaps,
            # cFE's own commands all carry count 0: what never moves does not count, and repeats nothing.
            "duplicates": account.duplicates,
            "reordered": account.reordered,
            "bytes": account.bytes,
            "bytes_min": account.bytes_min,
            "bytes_max": account.bytes_max,
            "findings": account.findings,
        }


def _senders(batch: PacketBatch, rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return a number for the endpoint that each row came from, the same in every batch."""
    address = batch.source_address[rows].astype(np.int64)
    if batch.ipv6:
        wide = batch.ip_version[rows] == 6
        table = np.array([crc32(item) | 1 << 32 for item in batch.ipv6])
        address[wide] = table[address[wide]]
    return address << 16 | batch.source_port[rows]
