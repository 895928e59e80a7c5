"""The tables of an index, each as a list of columns: for DuckDB, for Arrow, and for the page in docs.

A row belongs to one capture, whose URL is in its column ``capture``. Columns have the names of ``info
--json`` and ``doctor --json``, except ``in``, ``out`` and ``of``, which are words of SQL.
"""

from __future__ import annotations

from typing import Any, Final

import msgspec
import pyarrow as pa

SHAPE: Final = 2
"""Version of these tables; an index of another version is not read."""

_TYPES: Final = {
    "text": ("VARCHAR", pa.string()),
    "texts": ("VARCHAR[]", pa.list_(pa.string())),
    "int": ("BIGINT", pa.int64()),
    "real": ("DOUBLE", pa.float64()),
    "bool": ("BOOLEAN", pa.bool_()),
    "time": ("TIMESTAMP", pa.timestamp("us")),
}
"""Kind of a column to its types in DuckDB and Arrow. A time is UTC; the column in ns next to it is exact."""


class IndexColumn(msgspec.Struct, frozen=True):
    """One column.

    Attributes:
        name: name.
        kind: ``text``, ``texts``, ``int``, ``real``, ``bool`` or ``time``.
        description: description for the documentation.
    """

    name: str
    kind: str
    description: str

    @property
    def sql(self) -> str:
        """The column in a CREATE TABLE."""
        return f'"{self.name}" {_TYPES[self.kind][0]}'


class IndexTable(msgspec.Struct, frozen=True):
    """One table.

    Attributes:
        name: name.
        description: description of a row, for the documentation.
        columns: columns in order; the first is ``capture``.
    """

    name: str
    description: str
    columns: tuple[IndexColumn, ...]

    @property
    def names(self) -> list[str]:
        """The names of its columns."""
        return [item.name for item in self.columns]

    @property
    def create(self) -> str:
        """The statement that creates it."""
        return f"CREATE TABLE {self.name} ({', '.join(item.sql for item in self.columns)})"

    @property
    def schema(self) -> Any:
        """Its ``pyarrow.Schema``."""
        return pa.schema([(item.name, _TYPES[item.kind][1]) for item in self.columns])

    def arrow(self, rows: list[dict[str, Any]]) -> Any:
        """Return rows as a ``pyarrow.Table``; missing values are null."""
        return pa.Table.from_pylist(rows, self.schema)


def _table(name: str, description: str, *columns: tuple[str, str, str]) -> IndexTable:
    first = IndexColumn("capture", "text", "URL of the capture; of a local file its absolute path")
    return IndexTable(name, description, (first, *(IndexColumn(*item) for item in columns)))


_SPACECRAFT: Final = "spacecraft", "int", "its number, where there are several"
_ROUTE: Final = (
    ("link", "text", "label of the link"),
    ("msg_id", "text", "e.g. `0x0827`"),
    ("topic", "text", "configured topic"),
    ("name", "text", "cFE's name of the packet"),
    _SPACECRAFT,
)
_SENDERS: Final = (
    ("sender", "text", "address and port"),
    ("receiver", "text", "address and port"),
    ("instance", "text", "the cFS, where there are several"),
)

_CAPTURES: Final = _table(
    "captures",
    "a capture or recording: one run",
    ("size", "int", "bytes"),
    ("version", "text", "time of its last change in ns, or the server's ETag or date"),
    ("sha256", "text", "hash of the file; null if it could not be read"),
    ("settings", "text", "hash of the mission files and options that it was read with"),
    ("made_by", "text", "version of edoras-tools that read it"),
    (
        "state",
        "text",
        "`whole`, `cut` (it ends early; what is before is counted), `unreadable` or `changing`",
    ),
    ("error", "text", "why it is not whole"),
    ("gone", "bool", "it was there once, and no longer is"),
    ("kind", "text", "`pcap`, `pcapng` or `mcap`"),
    ("datagrams", "int", "what `info` counts"),
    ("skipped", "int", "frames that are no UDP"),
    ("capture_drops", "int", "packets that the capture itself lost"),
    ("start_ns", "int", "first datagram, ns since 1970 UTC"),
    ("end_ns", "int", "last datagram"),
    ("began", "time", "first datagram, UTC"),
    ("seconds", "real", "from the first to the last"),
    ("examined", "int", "datagrams that the doctor judged"),
    ("not_examined", "int", "datagrams that it left out"),
    ("lost", "int", "messages found lost, each once"),
    ("superseded", "int", "messages that gave way to a newer one"),
    ("unaccounted", "int", "messages missing without a cause"),
    ("estimated", "int", "null; older versions estimated what did not come"),
    ("worst", "text", "severity of the gravest verdict; null without one"),
)
_ROUTES: Final = _table(
    "routes",
    "a stream as `info` counts it",
    *_ROUTE,
    ("processor_id", "int", "of the sender"),
    ("type", "text", "ROS type"),
    ("count", "int", "messages"),
    ("rate_hz", "real", "between the first and the last"),
    ("jitter_ms", "real", "standard deviation of the time between messages"),
    ("gaps", "int", "sequence counts that never came"),
    ("duplicates", "int", "packets whose count had already come"),
    ("reordered", "int", "packets that came late"),
    ("bytes", "int", "of all"),
    ("bytes_min", "int", "smallest"),
    ("bytes_max", "int", "largest"),
)
_FINDINGS: Final = _table(
    "findings",
    "a finding of a stream",
    *_ROUTE,
    ("processor_id", "int", "of the sender"),
    ("finding", "text", "its name, as in [findings](findings.md)"),
    ("datagrams", "int", "that have it"),
)
_STREAMS: Final = _table(
    "streams",
    "a stream as `doctor` follows it, from one sender to one receiver",
    *_ROUTE,
    ("type", "text", "ROS type"),
    *_SENDERS,
    ("sent", "int", "messages sent, as far as known"),
    ("seen", "int", "messages captured"),
    ("lost", "int", "messages lost, where they are of this stream"),
    ("rate_hz", "real", "between the first and the last"),
    ("limit_hz", "real", "to what rate it gets through"),
    ("limit_from", "text", "`measured` or `assumed`"),
    ("counted", "bool", "whether its sender counts"),
    ("gaps", "int", "sequence counts that never came"),
    ("duplicates", "int", "packets whose count had already come"),
    ("reordered", "int", "packets that came late"),
    ("restarts", "int", "how often the count began anew"),
    ("bytes_max", "int", "largest"),
    ("comb_ms", "real", "period of the task that sends it in rounds"),
)
_LATENCIES: Final = _table(
    "latencies",
    "how long messages of a stream took",
    *_ROUTE,
    *_SENDERS,
    (
        "part",
        "text",
        "`crossing`: through cFS; `delay`: from publication to the wire; `to_robot`: the last hop",
    ),
    ("from_link", "text", "of a crossing: where they went in"),
    ("from_msg_id", "text", "of a crossing: as what"),
    ("count", "int", "messages that were timed"),
    ("p50_ms", "real", "half took no longer"),
    ("p99_ms", "real", "99 of 100 took no longer"),
    ("max_ms", "real", "longest"),
)
_OUTCOMES: Final = _table(
    "outcomes",
    "what became of the messages of a route: the sums of its rows in `balance`",
    *_ROUTE,
    ("sent", "int", "went into the first hop"),
    ("lost", "int", "of all causes"),
    ("superseded", "int", "gave way to a newer one"),
    ("waiting", "int", "may be on their way still"),
    ("not_captured", "int", "could not be followed"),
    ("unaccounted", "int", "missing without a cause"),
)
_BALANCE: Final = _table(
    "balance",
    "a route at one hop: `came_in + duplicated = came_out + lost + superseded + waiting + not_captured + "
    "unaccounted`",
    *_ROUTE,
    ("instance", "text", "the cFS"),
    ("hop", "text", "where"),
    ("came_in", "int", "went in"),
    ("duplicated", "int", "came out more than once"),
    ("came_out", "int", "came out"),
    ("lost", "int", "of all causes"),
    ("superseded", "int", "gave way to a newer one"),
    ("waiting", "int", "may be on their way still"),
    ("not_captured", "int", "could not be followed"),
    ("unaccounted", "int", "missing without a cause"),
)
_LOSSES: Final = _table(
    "losses",
    "messages of a route lost at one hop by one cause",
    *_ROUTE,
    ("instance", "text", "the cFS"),
    ("hop", "text", "where"),
    ("cause", "text", "as in `lost_by` of `doctor --json`"),
    ("lost", "int", "how many"),
)
_VERDICTS: Final = _table(
    "verdicts",
    "a verdict of the doctor",
    ("severity", "text", "`error`, `warning`, `security`, `note` or `habit`"),
    ("rule", "text", "its [rule](rules/README.md)"),
    ("reason", "text", "one sentence"),
    *_ROUTE[:3],
    ("hop", "text", "where it happened"),
    ("lost", "int", "messages lost"),
    ("sent", "int", "of how many"),
    ("estimated", "int", "null; older versions estimated what did not come"),
    ("start_ns", "int", "first sign of it"),
    ("end_ns", "int", "last sign of it"),
    ("confidence", "text", "`high`, `medium` or `low`"),
    ("evidence", "texts", "what was seen"),
    ("remedy", "text", "what to change"),
    _SPACECRAFT,
)
_EVENTS: Final = _table(
    "events",
    "an event of a cFS application (0x808)",
    ("time_ns", "int", "capture time, ns since 1970 UTC"),
    ("time", "time", "the same, UTC"),
    ("sender", "text", "spacecraft and processor, as `66:1`"),
    ("app", "text", "who says it"),
    ("event_id", "int", "its number for it"),
    ("event_type", "int", "1 debug, 2 information, 3 error, 4 critical"),
    ("message", "text", "the text"),
    _SPACECRAFT,
)
_MISSIONS: Final = _table(
    "missions",
    "a mission file that the capture was read with: the recording's own, or those of `-c`",
    ("file", "text", "its name"),
    ("sha256", "text", "hash of its contents"),
    ("bytes", "int", "its size"),
)
_WARNINGS: Final = _table(
    "warnings", "a line that `info` or `doctor` warn with", ("text", "text", "the line")
)

_ALL: Final = (
    *(_CAPTURES, _ROUTES, _FINDINGS, _STREAMS, _LATENCIES, _OUTCOMES, _BALANCE, _LOSSES),
    *(_VERDICTS, _EVENTS, _MISSIONS, _WARNINGS),
)
TABLES: Final = {table.name: table for table in _ALL}
"""Every table by its name."""
