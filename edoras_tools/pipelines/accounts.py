"""Counting per route over batches: how many, how fast, how even, and what is missing."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.model import NO_MSG_ID, Finding, Link
from edoras_tools.wire.names import message_name

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.mission import Mission
    from edoras_tools.model import Columns, PacketBatch

_MODULUS: Final = 1 << 14
_FORWARD: Final = _MODULUS // 2
"""A step of the sequence count beyond half its range is a step back: reordering, or a count begun anew."""


@dataclass(slots=True)
class Account:
    """What is known of one stream: one MsgId (or SBN message type) of one sender on one link.

    Times are ns. ``interval_squares`` is in seconds squared, so that a day of traffic keeps its precision.
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
    sequence: int = -1
    gaps: int = 0
    duplicates: int = 0
    reordered: int = 0
    bytes_min: int = 1 << 31
    bytes_max: int = 0
    bytes: int = 0
    findings: dict[str, int] = field(default_factory=dict)

    def add(self, batch: PacketBatch, columns: Columns, rows: NDArray[np.intp]) -> None:
        """Count rows, which are in capture order."""
        times, lengths = batch.time_ns[rows], batch.length[rows]
        first = self.last_ns if self.count else int(times[0])
        intervals = np.diff(times, prepend=first) / 1e9
        self.interval_squares += float(np.dot(intervals, intervals))
        self.first_ns = self.first_ns if self.count else first
        self.last_ns = int(times[-1])
        self.count += len(rows)
        self.bytes += int(lengths.sum())
        self.bytes_min = min(self.bytes_min, int(lengths.min()))
        self.bytes_max = max(self.bytes_max, int(lengths.max()))
        findings = columns.findings[rows]
        for finding in Finding(int(np.bitwise_or.reduce(findings))):
            there = int(np.count_nonzero(findings & np.uint32(finding)))
            self.findings[finding.label] = self.findings.get(finding.label, 0) + there
        counted = rows[
            ((findings & np.uint32(Finding.SEQUENCE_UNSET)) == 0) & (columns.msg_id[rows] != NO_MSG_ID)
        ]
        if len(counted):
            self._sequence(columns.sequence_count[counted].astype(np.int64))

    def _sequence(self, counts: NDArray[np.int64]) -> None:
        steps = np.diff(counts, prepend=self.sequence if self.sequence >= 0 else counts[0] - 1) % _MODULUS
        self.sequence = int(counts[-1])
        self.duplicates += int(np.count_nonzero(steps == 0))
        self.reordered += int(np.count_nonzero(steps >= _FORWARD))
        forward = steps[(steps > 1) & (steps < _FORWARD)]
        self.gaps += int(forward.sum()) - len(forward)

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
        self.accounts: dict[int, Account] = {}
        self.findings: dict[str, int] = {}
        self.datagrams = 0
        self.start_ns = 0
        self.end_ns = 0

    def add(self, batch: PacketBatch, columns: Columns) -> None:
        """Count a batch."""
        if not len(batch):
            return
        low, high = int(batch.time_ns.min()), int(batch.time_ns.max())
        self.start_ns = min(self.start_ns, low) if self.datagrams else low
        self.end_ns = max(self.end_ns, high)
        self.datagrams += len(batch)
        for finding in Finding(int(np.bitwise_or.reduce(columns.findings))):
            there = int(np.count_nonzero(columns.findings & np.uint32(finding)))
            self.findings[finding.label] = self.findings.get(finding.label, 0) + there
        key = columns.processor_id.astype(np.int64) << 28 | columns.link.astype(np.int64) << 26
        key |= (columns.sbn_msg_type.astype(np.int64) + 1) << 17 | (columns.msg_id.astype(np.int64) + 1)
        order = np.argsort(key, kind="stable")
        starts = np.flatnonzero(np.diff(key[order], prepend=key[order[0]] - 1))
        for rows in np.split(order, starts[1:]):
            self._account(int(key[rows[0]]), columns, int(rows[0])).add(batch, columns, rows)

    def _account(self, key: int, columns: Columns, row: int) -> Account:
        if key not in self.accounts:
            self.accounts[key] = Account(
                Link(int(columns.link[row])),
                int(columns.processor_id[row]),
                int(columns.msg_id[row]),
                int(columns.sbn_msg_type[row]),
                int(columns.route[row]),
            )
        return self.accounts[key]

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
            "duplicates": account.duplicates,
            "reordered": account.reordered,
            "bytes": account.bytes,
            "bytes_min": account.bytes_min,
            "bytes_max": account.bytes_max,
            "findings": account.findings,
        }
