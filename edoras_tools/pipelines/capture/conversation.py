"""Who sends what to whom: streams of similar packets between two parties, divided into runs by pauses.

And counts for ``sniff --stat``: by route, by SBN conversation, by size, by finding.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
import numpy as np

from edoras_tools.cfs.names import command_name
from edoras_tools.decode.stack import Dissector
from edoras_tools.links import table
from edoras_tools.model import NO_MSG_ID, NO_ROUTE, OTHER, Endpoint, Finding, Link, Peer
from edoras_tools.pipelines.capture.ledger import Ledger
from edoras_tools.render.capture.sequence import SequenceMessage
from edoras_tools.wire.arrays import Integers, Places, numbered
from edoras_tools.wire.sbn import MSG_TYPE_NAMES, MsgType

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.decode.context import Context
    from edoras_tools.decode.filters.rows import ColumnRows
    from edoras_tools.pipelines.workbench import Workbench


class Statistics:
    """Counts the selected packets of a source."""

    def __init__(self, bench: Workbench) -> None:
        self.ledger = Ledger(bench.mission, structs=bench.columns.context.structs)
        self._conversation = Conversation(bench.columns.context)

    def add(self, rows: ColumnRows) -> None:
        """Add the packets of a batch."""
        self.ledger.add(rows.batch.take(rows.selection), rows.columns.take(rows.selection))
        network = table.among(rows.column("link"), lambda link: link.peers).nonzero()[0]
        if len(network):
            self._conversation.add(rows.take(network))

    def table(self, kind: str) -> Any:
        """Return the rows of one table, or the counts by label for ``findings``: plain values.

        Args:
            kind: ``routes``, ``sbn``, ``sizes`` or ``findings``.
        """
        if kind == "findings":
            return self.ledger.findings
        if kind == "sbn":
            return self._network()
        rows = self.ledger.routes()
        return rows if kind == "routes" else sorted(rows, key=lambda row: -row["bytes"])

    def _network(self) -> list[dict[str, Any]]:
        """Return a row for every stream between two SBN peers, with all its runs."""
        rows: dict[tuple[str, str, str], dict[str, Any]] = {}
        for item in self._conversation.messages():
            key = item.source, item.destination, item.label
            blank = {"source": key[0], "destination": key[1], "message": key[2], "first_ns": item.first_ns}
            row = rows.setdefault(key, {**blank, "last_ns": 0, "count": 0, "runs": 0, "spent_ns": 0})
            row["count"] += item.count
            row["runs"] += 1
            row["last_ns"] = item.last_ns
            row["spent_ns"] += item.last_ns - item.first_ns
        for row in rows.values():
            spent, steps = row.pop("spent_ns"), row["count"] - row["runs"]
            row["period_ms"] = round(spent / steps / 1e6, 3) if steps else None
        return sorted(rows.values(), key=lambda row: (row["source"], row["destination"], row["message"]))


_PAUSE_NS: Final = 2_000_000_000
"""A shorter silence never ends a run."""
_FIRST_PAUSE_NS: Final = 15_000_000_000
"""A second packet may come this much later and still continue the run: SBN announces itself every 11 s."""
_MISSED: Final = 4
"""A silence of this many periods ends a run."""
_FOREVER: Final = 1 << 62


Party = Endpoint | Peer | str


class _Stream(NamedTuple):
    source: Party
    destination: Party
    label: str


class _Run(msgspec.Struct):
    count: int
    first_ns: int
    last_ns: int
    findings: int = 0

    def ends_before(self, time_ns: int) -> bool:
        """Return whether a packet at this time comes after a pause."""
        period = (self.last_ns - self.first_ns) / (self.count - 1) if self.count > 1 else 0
        return time_ns - self.last_ns > max(_PAUSE_NS, _MISSED * period if period else _FIRST_PAUSE_NS)


class Conversation:
    """Gathers the runs of a capture.

    Args:
        context: provides names of topics, and which SBN peer uses which address.
    """

    def __init__(self, context: Context) -> None:
        self._context, self._dissector = context, Dissector(context, detail=False)
        self._streams: dict[_Stream, list[_Run]] = {}
        self.begin_ns = 0

    def add(self, rows: ColumnRows) -> None:
        """Add the packets of a batch."""
        self.begin_ns = rows.begin_ns
        first, code = _alike(rows)
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

    def messages(self) -> list[SequenceMessage]:
        """Return all runs in order of their start; SBN peers are named by their identity if it is known."""
        messages, begin_ns = [], self.begin_ns
        for stream, runs in self._streams.items():
            parties = self._name(stream.source), self._name(stream.destination)
            for run in runs:
                ends = run.first_ns - begin_ns, run.last_ns - begin_ns
                labels = Finding(run.findings).labels
                messages.append(SequenceMessage(*parties, stream.label, run.count, *ends, labels))
        return sorted(messages, key=lambda message: message.first_ns)

    def _follow(self, stream: _Stream, times: Integers, findings: NDArray[np.uint32]) -> None:
        """Extend the stream's last run up to a pause, and start another after it."""
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
            identity = self._context.peers.identity((party.address, party.port), _FOREVER)
            party = Peer(*identity) if identity else party
        return f"SBN {party}" if isinstance(party, Peer) else str(party)

    def _stream(self, rows: ColumnRows, row: int) -> _Stream:
        """Return the parties and the label of one packet."""
        index = int(rows.indices()[row])
        datagram = rows.batch[index]
        columns, link = rows.columns, table.link(rows.columns.link[index])
        label = self._label(rows, row, index, link)
        source, destination = datagram.source, datagram.destination
        if link.peers:
            sender = Peer(int(columns.spacecraft_id[index]), int(columns.processor_id[index]))
            return _Stream(sender if columns.sbn_msg_type[index] >= 0 else source, destination, label)
        if link.only_to_cfs:
            return _Stream(f"Ground {source.address}", f"{link.name} {destination}", label)
        if link.only_from_cfs:
            return _Stream(f"{link.name} {source.address}", f"Ground {destination.address}", label)
        return _Stream(str(source), str(destination), label)

    def _label(self, rows: ColumnRows, row: int, index: int, link: Link) -> str:
        columns = rows.columns
        kind, msg_id = int(columns.sbn_msg_type[index]), int(columns.msg_id[index])
        if msg_id == NO_MSG_ID:
            if kind >= 0 or link == OTHER:
                return "of no link" if kind < 0 else MSG_TYPE_NAMES.get(kind, f"type 0x{kind:02x}")
            return table.protocol(link).kind_name(self._dissector.dissect(rows.batch[index])) or "unreadable"
        route, code = int(rows.routes()[row]), int(columns.function_code[index])
        context = self._context.of(int(columns.spacecraft[index]))
        standard = context.msg_ids.standard(msg_id)
        name = context.mission.routes[route].topic if route != NO_ROUTE else context.name(msg_id)
        words = [f"0x{msg_id:04x}", name, command_name(standard, code) if code >= 0 else ""]
        return " ".join(["APP"] * (kind == MsgType.APP) + [word for word in words if word])


def _alike(rows: ColumnRows) -> tuple[Places, Places]:
    """Number the packets by everything that names their stream; return one row of each, and the numbers."""
    link = rows.column("link")
    to_cfs = table.among(link, lambda item: item.only_to_cfs)
    from_cfs = table.among(link, lambda item: item.only_from_cfs)
    keys: list[NDArray[Any]] = [
        link,
        rows.column("sbn_msg_type"),
        rows.column("msg_id"),
        rows.column("function_code"),
        rows.column("processor_id"),
        rows.column("spacecraft_id"),
        rows.datagram("ip_version"),
        rows.datagram("source_address"),
        np.where(to_cfs | from_cfs, 0, rows.datagram("source_port")),
        rows.datagram("destination_address"),
        np.where(from_cfs, 0, rows.datagram("destination_port")),
    ]
    return numbered(*keys, *_own_kinds(rows))


def _own_kinds(rows: ColumnRows) -> Iterator[Integers]:
    """Number the datagrams without a MsgId by which of their link's headers they have, and its own texts."""
    links = np.where(rows.column("msg_id") == NO_MSG_ID, rows.column("link"), 0)
    for reader in (reader for reader in table.links() if (links == reader).any()):
        kinds = np.zeros(len(rows), np.int64)
        for place, layout in enumerate(reader.layouts):
            kinds[reader.places(layout, rows)[0]] |= 1 << place % 62
        yield kinds
        for field in reader.fields():
            series = field.series(rows)
            if series.table is not None:
                texts = np.zeros(len(rows), np.int64)
                texts[series.owner] = series.values + 1
                yield texts
