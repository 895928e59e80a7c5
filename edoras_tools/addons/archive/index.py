"""The index: one DuckDB file, written by one process at a time; and its export as a Parquet dataset.

Rules:

1. The rows of a capture are written in one transaction, which also deletes its old rows: they are complete or
   absent, even if the program is killed. There are no other relations between tables, and no row depends on
   the order in which captures were read.
2. Tables have no keys: the only writer deletes the rows that it replaces, and DuckDB allows no second writer.
3. A reader opens the file for reading only, and waits for no other program.

``TABLES`` has the tables, each as a list of columns: for DuckDB, for Arrow, and for the page in docs. A row
belongs to one capture, whose URL is in its column ``capture``. Columns have the names of ``info
--json`` and ``doctor --json``, except ``in``, ``out`` and ``of``, which are words of SQL.
"""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from threading import Timer
from time import monotonic
from typing import TYPE_CHECKING, Any, Final

import duckdb
import msgspec
import pyarrow as pa

from edoras_tools import __version__
from edoras_tools.errors import CaptureError, ConfigError, EdorasError, os_errors
from edoras_tools.io.outputs import check_folder, check_links, lock_older, name_that_fits

if TYPE_CHECKING:
    from pathlib import Path

    from edoras_tools.addons.archive.places import ListedFile

_ABOUT: Final = "CREATE TABLE about (name VARCHAR, value VARCHAR)"
_CLOSED: Final = ("memory_limit = '200MB'", "enable_external_access = false", "lock_configuration = true")
"""Settings for a user's query; the last one locks the others."""
MOST_S = 60.0
"""Longest time of a user's query, s."""


@contextmanager
def open_index(path: Path, *, write: bool = False) -> Iterator[Index]:
    """Open an index. For writing it is created if necessary, and kept if it gets a capture.

    Raises:
        CaptureError: it cannot be opened or written, is being written by another program, or is no index.
    """
    if not write and not path.exists():
        raise CaptureError(f"{path}: there is no such index; make it: edoras archive DIR --index {path}")
    new, bare = not path.exists(), False
    with os_errors(f"{path}: cannot be opened"):
        check_links(path)
        check_links(path.with_name(f"{path.name}.wal"))
    try:
        connection = duckdb.connect(str(path), read_only=not write)
    except duckdb.Error as error:
        if "lock" in str(error):
            raise CaptureError(
                f"{path}: another program is using the index; wait until it has ended"
            ) from error
        raise CaptureError(f"{path}: is not an index that can be opened: {first_line(error)}") from error
    try:
        connection.execute("SET TimeZone = 'UTC'")
        index = Index(path, connection)
        index.check(write=write)
        yield index
    except EdorasError:  # such as a mission with mistakes, or a missing folder
        bare = new and not index.ask("SELECT 1 FROM captures LIMIT 1")
        raise
    except duckdb.Error as error:  # such as a full disk
        action = "written" if write else "read"
        raise CaptureError(f"{path}: cannot be {action}: {first_line(error)}") from error
    finally:
        connection.close()
        if bare:
            path.unlink(missing_ok=True)


def first_line(error: Exception) -> str:
    """Return DuckDB's message in one line, without the kind of its error."""
    line = str(error).partition("\n")[0]
    return line.partition(" Error: ")[2] or line


class Index:
    """An open index.

    Args:
        connection: connection to DuckDB.
    """

    def __init__(self, path: Path, connection: duckdb.DuckDBPyConnection) -> None:
        self.path = path
        self._connection = connection
        self._left_s = 0.0

    def check(self, *, write: bool) -> None:
        """Check that this is an index of this version; create its tables in an empty file.

        Raises:
            CaptureError: it is not an index of this version.
        """
        tables = {name for (name,) in self.ask("SELECT table_name FROM information_schema.tables")}
        if not tables and write:
            with self._transaction():
                for statement in (_ABOUT, *(table.create for table in TABLES.values())):
                    self._connection.execute(statement)
                about = [["shape", str(SHAPE)], ["made_by", __version__]]
                self._connection.executemany("INSERT INTO about VALUES (?, ?)", about)
            return
        if not {"about", *(table.name for table in TABLES.values())} <= tables:
            raise CaptureError(
                f"{self.path}: is a database, but no index of edoras archive; name another file"
            )
        ((shape,),) = self.ask("SELECT value FROM about WHERE name = 'shape'")
        if shape != str(SHAPE):
            raise CaptureError(
                f"{self.path}: is an index of version {shape}, and this program uses {SHAPE}; make a new one"
            )

    def ask(self, sql: str, values: Sequence[Any] = ()) -> list[tuple[Any, ...]]:
        """Return all rows of a query."""
        return self._connection.execute(sql, list(values)).fetchall()

    def rows(self, sql: str, values: Sequence[Any] = ()) -> list[dict[str, Any]]:
        """Return all rows of a query, by the names of its columns."""
        result = self._connection.execute(sql, list(values))
        names = [item[0] for item in result.description or ()]
        return [dict(zip(names, row, strict=True)) for row in result.fetchall()]

    def answer(self, sql: str) -> tuple[list[str], Iterator[tuple[Any, ...]]]:
        """Return the column names of a user's query, and an iterator over its rows.

        From then on the connection can access no other file or address.

        Raises:
            ConfigError: DuckDB refuses it, or it takes longer than ``MOST_S``.
        """
        self._left_s = MOST_S
        with self._limited():
            for setting in _CLOSED:
                self._connection.execute(f"SET {setting}")
            result = self._connection.execute(sql)
            names = [item[0] for item in getattr(result, "description", None) or ()]
        if not names:
            raise ConfigError("the query is empty; SHOW TABLES lists what it may ask")
        return names, self._fetched(result)

    def _fetched(self, result: Any) -> Iterator[tuple[Any, ...]]:
        rows: Any = True
        while rows:
            with self._limited():
                rows = result.fetchmany(1000)
            yield from rows

    @contextmanager
    def _limited(self) -> Iterator[None]:
        """Interrupt DuckDB when the time of the query is over; its errors become one line."""
        began, timer = monotonic(), Timer(max(self._left_s, 0.1), self._connection.interrupt)
        timer.start()
        try:
            yield
        except duckdb.InterruptException:
            text = f"it took more than {MOST_S:g} s; ask for less, or use DuckDB's own program"
            raise ConfigError(text) from None
        except duckdb.Error as error:
            raise ConfigError(_mistake(error)) from error
        finally:
            timer.cancel()
            self._left_s -= monotonic() - began

    def replace(self, captures: Iterable[str], parts: Sequence[Mapping[str, Any]]) -> None:
        """Replace the rows of some captures, all or none.

        Args:
            captures: captures whose rows are deleted.
            parts: name of a table to a ``pyarrow.Table`` of new rows.
        """
        old = list(captures)
        with self._transaction():
            if old:
                for table in TABLES.values():
                    self.run(f"DELETE FROM {table.name} WHERE capture IN (SELECT unnest(?))", [old])
            for part in parts:
                for name, rows in part.items():
                    self._connection.register("new_rows", rows)
                    self._connection.execute(f"INSERT INTO {name} BY NAME SELECT * FROM new_rows")
                    self._connection.unregister("new_rows")

    def touch(self, items: Iterable[ListedFile]) -> None:
        """Store the new version of captures whose contents are unchanged."""
        with self._transaction():
            for item in items:
                values = item.size, item.version, item.url
                self.run("UPDATE captures SET size = ?, version = ?, gone = false WHERE capture = ?", values)

    def leave(self, missing: Sequence[str], back: Sequence[str], *, forget: bool) -> None:
        """Mark captures that no longer exist, and those that exist again.

        Args:
            missing: URLs of captures that no longer exist.
            back: URLs of captures that were missing, and exist again.
            forget: whether to delete the rows of missing captures.
        """
        if forget:
            self.replace(missing, [])
            missing = []
        with self._transaction():
            for urls, value in ((missing, True), (back, False)):
                if urls:
                    change = "UPDATE captures SET gone = ? WHERE capture IN (SELECT unnest(?))"
                    self.run(change, [value, list(urls)])

    def run(self, sql: str, values: Sequence[Any] = ()) -> None:
        """Execute a statement."""
        self._connection.execute(sql, list(values))

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        self._connection.execute("BEGIN")
        try:
            yield
            self._connection.execute("COMMIT")
        except BaseException:
            with suppress(duckdb.Error):  # a failed commit has rolled back already
                self._connection.execute("ROLLBACK")
            raise


def _mistake(error: Exception) -> str:
    """Return DuckDB's message in one line, without the query itself, which the user knows."""
    text = str(error).partition("\nLINE ")[0]
    return " ".join(text.split()) or "the query failed"


_LONGEST: Final = 80
"""Longest topic in a folder's name, bytes: each takes up to three of 255; a longer one ends in its hash."""
_DATE: Final = "coalesce(strftime(c.began, '%Y-%m-%d'), 'unknown')"


def export_dataset(index: Index, folder: Path, *, force: bool) -> dict[str, int]:
    """Write every table of an index; afterwards a folder is complete, or absent.

    It is written in another folder beside it. Remains of a killed export there are removed, and an export
    that was about to be replaced then gets its name again.

    Args:
        folder: target; new, or empty.
        force: whether to replace an earlier export.

    Returns:
        Rows by table.

    Raises:
        ConfigError: the folder is not empty.
        CaptureError: the folder cannot be written.
    """
    check_folder(folder)
    beside = folder.with_name(name_that_fits(f".{folder.name}", ".part"))
    new, old = beside / "new", beside / "old"
    with os_errors(f"{folder}: cannot be written"):
        check_links(folder)
        folder.parent.mkdir(parents=True, exist_ok=True)
        check_links(beside)
        beside.mkdir(mode=0o700, exist_ok=True)
        if beside.stat().st_uid != os.geteuid():
            raise OSError(errno.EPERM, f"{beside} is another user's; name another output")
        lock = lock_older(beside)
    try:
        with os_errors(f"{folder}: cannot be written"):
            _put_back(old, folder)
            shutil.rmtree(new, ignore_errors=True)  # both are remains of a killed export
            shutil.rmtree(old, ignore_errors=True)
            _check_earlier(folder, force=force)
            new.mkdir()
            written = {name: _write(index, name, new / name) for name in TABLES}
            if folder.exists():
                folder.rename(old)
            new.rename(folder)
    finally:
        _put_back(old, folder)
        shutil.rmtree(beside, ignore_errors=True)
        if lock >= 0:
            os.close(lock)
    return written


def _put_back(old: Path, folder: Path) -> None:
    """Give an earlier export its name again, unless a new one has it."""
    if old.exists() and not folder.exists():
        old.rename(folder)


def _check_earlier(folder: Path, *, force: bool) -> None:
    if not folder.exists():
        return
    existing = {item.name for item in folder.iterdir()} if folder.is_dir() else {""}
    if existing and not force:
        raise ConfigError(f"{folder} exists; name another folder, or replace it with --force")
    if foreign := sorted(existing - {*TABLES}):
        subject = f"{foreign[0]} in it is" if foreign[0] else "it is"
        raise ConfigError(f"{folder}: {subject} of no earlier export; name another folder")


def _write(index: Index, name: str, folder: Path) -> int:
    """Write a table; a message without a topic is in the folder of its packet's name, else of its MsgId."""
    columns = TABLES[name].names
    keys: dict[str, Any] = {"date": _DATE}
    if "link" in columns:
        keys["link"] = "coalesce(t.link, 'none')"
    if "topic" in columns:
        names = [f"t.{item}" for item in ("topic", "name", "msg_id") if item in columns]
        topic = f"coalesce({', '.join(names)}, 'none')"
        keys["topic"] = f"if(strlen({topic}) > {_LONGEST}, {topic}[:16] || '~' || md5({topic}), {topic})"
    data_columns = ", ".join(f't."{item}"' for item in columns if item not in keys)
    key_columns = ", ".join(f"{value} AS {key}" for key, value in keys.items())
    more = ', t.topic AS "configured_topic"' if "topic" in keys else ""
    source = f"SELECT {data_columns}{more}, {key_columns} FROM {name} t JOIN captures c USING (capture)"
    if name == "captures":
        source = f"SELECT {data_columns.replace('t.', 'c.')}, {_DATE} AS date FROM captures c"
    ((count,),) = index.ask(f"SELECT count(*) FROM {name}")
    if count:
        place = str(folder).replace("'", "''")
        index.run(
            f"COPY ({source} ORDER BY {', '.join(keys)}, capture) TO '{place}' "
            f"(FORMAT parquet, COMPRESSION zstd, PARTITION_BY ({', '.join(keys)}))"
        )
    return int(count)


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
_FATES: Final = (
    ("lost", "int", "of all causes"),
    ("superseded", "int", "gave way to a newer one"),
    ("waiting", "int", "may be on their way still"),
    ("not_captured", "int", "could not be followed"),
    ("unaccounted", "int", "missing without a cause"),
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
    *_FATES,
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
    *_FATES,
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
