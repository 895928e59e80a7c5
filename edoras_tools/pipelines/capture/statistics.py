"""Counts for ``sniff --stat``: by route, by SBN conversation, by size, by finding."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from edoras_tools.links.table import among
from edoras_tools.pipelines.capture.conversation import Conversation
from edoras_tools.pipelines.capture.ledger import Ledger

if TYPE_CHECKING:
    from edoras_tools.decode.filters.rows import ColumnRows
    from edoras_tools.pipelines.workbench import Workbench


class Statistics:
    """Counts the selected packets of a source."""

    def __init__(self, bench: Workbench) -> None:
        self.ledger = Ledger(bench.mission)
        self._conversation = Conversation(bench.columns.context)

    def add(self, rows: ColumnRows) -> None:
        """Add the packets of a batch."""
        self.ledger.add(rows.batch.take(rows.chosen), rows.columns.take(rows.chosen))
        network = among(rows.column("link"), lambda link: link.peers).nonzero()[0]
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
