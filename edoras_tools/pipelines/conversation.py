"""Who says what to whom: streams of like packets between two parties, folded to runs without a pause."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from edoras_tools.model import NO_MSG_ID, NO_ROUTE, Endpoint, Finding, Link
from edoras_tools.render.sequence import Message
from edoras_tools.wire.names import command_name, message_name
from edoras_tools.wire.sbn import MSG_TYPE_NAMES, MsgType, Peer

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.decode.context import Context
    from edoras_tools.decode.where_rows import ColumnRows

_PAUSE_NS: Final = 2_000_000_000
"""No shorter silence ends a run."""
_FIRST_PAUSE_NS: Final = 15_000_000_000
"""A second packet this much later still makes a run: SBN announces itself every 11 s."""
_MISSED: Final = 4
"""A silence of so many of a run's periods ends it."""
_FOREVER: Final = 1 << 62


Party = Endpoint | Peer | str


class _Stream(NamedTuple):
    source: Party
    destination: Party
    label: str


@dataclass(slots=True)
class _Run:
    count: int
    first_ns: int
    last_ns: int
    findings: int = 0

    def ends_before(self, time_ns: int) -> bool:
        """Tell whether a packet at that time comes after a pause."""
        period = (self.last_ns - self.first_ns) / (self.count - 1) if self.count > 1 else 0
        limit = _MISSED * period if period else _FIRST_PAUSE_NS
        return time_ns - self.last_ns > max(_PAUSE_NS, limit)


class Conversation:
    """Gathers the runs of a capture.

    Args:
        context: gives topics their names, and knows which SBN peer speaks from where.
    """

    def __init__(self, context: Context) -> None:
        self._context = context
        self._streams: dict[_Stream, list[_Run]] = {}
        self.begin_ns = 0

    def add(self, rows: ColumnRows) -> None:
        """Take the packets of a batch."""
        self.begin_ns = rows.begin_ns
        code, first = _alike(rows)
        streams = [self._stream(rows, row) for row in first.tolist()]
        number = {stream: index for index, stream in enumerate(dict.fromkeys(streams))}
        code = np.array([number[stream] for stream in streams], np.int64)[code]
        order = np.argsort(code, kind="stable")
        times, findings = rows.datagram("time_ns")[order], rows.column("findings")[order]
        ends = np.cumsum(np.bincount(code, minlength=len(number))).tolist()
        start = 0
        for stream, end in zip(number, ends, strict=True):
            self._follow(stream, times[start:end], findings[start:end])
            start = end

    def messages(self) -> list[Message]:
        """Return all runs in the order they began; SBN peers that gave their identity go by it."""
        found = [
            Message(
                self._name(stream.source),
                self._name(stream.destination),
                stream.label,
                run.count,
                run.first_ns - self.begin_ns,
                run.last_ns - self.begin_ns,
                Finding(run.findings).labels,
            )
            for stream, runs in self._streams.items()
            for run in runs
        ]
        return sorted(found, key=lambda message: message.first_ns)

    def _follow(self, stream: _Stream, times: NDArray[np.int64], findings: NDArray[np.uint32]) -> None:
        """Lengthen the stream's last run up to a pause, and begin another after it."""
        runs = self._streams.setdefault(stream, [])
        before = runs[-1].last_ns if runs else int(times[0])
        long = np.flatnonzero(np.diff(times, prepend=before) > _PAUSE_NS).tolist()
        bounds = sorted({0, *long, len(times)})
        for low, high in pairwise(bounds):
            part, bits = times[low:high], int(np.bitwise_or.reduce(findings[low:high]))
            if not runs or runs[-1].ends_before(int(part[0])):
                runs.append(_Run(0, int(part[0]), int(part[0])))
            run = runs[-1]
            run.count += len(part)
            run.last_ns = max(run.last_ns, int(part[-1]))
            run.findings |= bits

    def _name(self, party: Party) -> str:
        if isinstance(party, Endpoint):
            identity = self._context.peers.known((party.address, party.port), _FOREVER)
            party = Peer(*identity) if identity else party
        return f"SBN {party}" if isinstance(party, Peer) else str(party)

    def _stream(self, rows: ColumnRows, row: int) -> _Stream:
        """Name the parties and the content of one packet."""
        index = int(rows.indices()[row])
        datagram = rows.batch[index]
        columns, link = rows.columns, Link(int(rows.columns.link[index]))
        label = self._label(rows, row, index)
        source, destination = datagram.source, datagram.destination
        if link is Link.SBN:
            sender = Peer(int(columns.spacecraft_id[index]), int(columns.processor_id[index]))
            return _Stream(sender if columns.sbn_msg_type[index] >= 0 else source, destination, label)
        if link is Link.CI:
            return _Stream(f"Ground {source.address}", f"CI {destination}", label)
        if link is Link.TO:
            return _Stream(f"TO {source.address}", f"Ground {destination.address}", label)
        return _Stream(str(source), str(destination), label)

    def _label(self, rows: ColumnRows, row: int, index: int) -> str:
        columns = rows.columns
        kind, msg_id = int(columns.sbn_msg_type[index]), int(columns.msg_id[index])
        if msg_id == NO_MSG_ID:
            return MSG_TYPE_NAMES.get(kind, f"type 0x{kind:02x}") if kind >= 0 else "unreadable"
        route, code = int(rows.routes()[row]), int(columns.function_code[index])
        name = self._context.mission.routes[route].topic if route != NO_ROUTE else message_name(msg_id)
        words = [f"0x{msg_id:04x}", name, command_name(msg_id, code) if code >= 0 else ""]
        return " ".join(["APP"] * (kind == MsgType.APP) + [word for word in words if word])


def _alike(rows: ColumnRows) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Number the packets by all that their stream's name is made of; return that, and a row of each."""
    link = rows.column("link")
    sbn, ground = link == Link.SBN, (link == Link.CI) | (link == Link.TO)
    keys: list[NDArray[Any]] = [
        link,
        rows.column("sbn_msg_type"),
        rows.column("msg_id"),
        rows.column("function_code"),
        np.where(sbn, rows.column("processor_id"), 0),
        np.where(sbn, rows.column("spacecraft_id"), 0),
        rows.datagram("ip_version"),
        rows.datagram("source_address"),
        np.where(ground, 0, rows.datagram("source_port")),
        rows.datagram("destination_address"),
        np.where(link == Link.TO, 0, rows.datagram("destination_port")),
    ]
    code, first = np.zeros(len(rows), np.int64), np.zeros(0, np.int64)
    for key in keys:
        _, part = np.unique(key, return_inverse=True)
        _, first, code = np.unique(
            code * len(rows) + part.reshape(-1), return_index=True, return_inverse=True
        )
        code = code.reshape(-1)
    return code, first
