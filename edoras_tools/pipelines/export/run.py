"""Writes topics of an input to files, one table each."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Collection, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import quote

import msgspec

from edoras_tools.errors import CaptureError, ConfigError, os_errors
from edoras_tools.io.formats.columns import TableFile, TableHead
from edoras_tools.io.formats.table import TABLE_FORMATS, TABLES_WRITTEN, Format, written_as
from edoras_tools.io.outputs import check_links, in_the_way, name_that_fits, refuse_existing, refuse_input
from edoras_tools.io.topics.messages import DATAGRAMS_TOPIC
from edoras_tools.io.topics.streams import FAULTS, OWN_TOPICS
from edoras_tools.pipelines.export.reading import TableForm, check_fields, chosen_topics, has_field
from edoras_tools.pipelines.export.sources import JUDGED, TopicSource

if TYPE_CHECKING:
    from edoras_tools.render.terminal.text import Progress
    from edoras_tools.ros.cdr.bulk import TopicBlock

_TASKS: Final = 96
"""Pieces of tables that may wait to be written, about six batches: limits memory. With fewer, the reader
waits for a slow write, and other processes have no work."""
_OWN = JUDGED | {item.name for item in (*OWN_TOPICS, FAULTS)}


class ExportTarget(msgspec.Struct, frozen=True):
    """The output of an export.

    Attributes:
        path: a file, for one topic; or a folder.
        format: format of the files.
        folder: whether ``path`` is a folder, with a file for each topic.
        force: replace existing files.
    """

    path: Path
    format: Format
    folder: bool
    force: bool = False

    @classmethod
    def of(
        cls, path: Path, *, name: str | None = None, folder: bool = False, force: bool = False
    ) -> ExportTarget:
        """Return the target that a path names: a file if it has the suffix of a table format, else a folder.

        Args:
            path: the output.
            name: name of the format, e.g. ``csv``; None for the format of the suffix; Parquet for a folder.
            folder: the path was given as a folder.
            force: replace existing files.

        Raises:
            ConfigError: the suffix names another format, or none.
        """
        by_name = written_as(Path(f"x.{name}"), table=True) if name else None
        folder |= path.is_dir()
        by_suffix = None if folder else written_as(path, table=True)
        if by_suffix is not None and by_name not in {None, by_suffix}:
            raise ConfigError(
                f"{path}: is {by_suffix.name} by its suffix, and --format says {name}; choose one"
            )
        special = path.exists() and not path.is_file() and not folder  # as /dev/stdout
        if by_suffix is None and (special or path.suffix) and not folder and not (special and by_name):
            problem = f"{path.suffix} is not a table format" if path.suffix else "name its --format"
            raise ConfigError(f"{path}: {problem}; use {TABLES_WRITTEN}; a folder ends with /")
        return cls(path, by_suffix or by_name or TABLE_FORMATS[0], by_suffix is None and not special, force)

    def check(self, inputs: Sequence[Path]) -> None:
        """Refuse to overwrite files without permission.

        Raises:
            ConfigError: the output exists and may not be replaced, or it is an input.
        """
        refuse_input(self.path, inputs)
        full = self.path.is_dir() and any(self.path.iterdir())
        if not self.force:
            refuse_existing(self.path if full else in_the_way(self.path))

    def check_alone(self, topic: str, others: Collection[str]) -> None:
        """Refuse a second topic in one file.

        Raises:
            ConfigError: there is another one.
        """
        if others and not self.folder:
            raise ConfigError(
                f"{', '.join(others)} and {topic} are several topics; select one with --topic, "
                "or name a folder that ends with /"
            )

    def place(self, topic: str) -> Path:
        """Return the file of a topic; in a folder its name is the topic's, with dots for slashes."""
        if not self.folder:
            return self.path
        name = ".".join(quote(part, safe=" ~").replace(".", "%2E") for part in topic.strip("/").split("/"))
        return self.path / name_that_fits(name, self.format.suffix)


class ExportReport(msgspec.Struct):
    """The result of an export.

    Attributes:
        source: the input.
        files: the tables, in order of the topics' first messages.
    """

    source: TopicSource
    files: list[TableFile] = msgspec.field(default_factory=list)

    def summary(self) -> dict[str, Any]:
        """Return the report in the form of ``export --json``."""
        return {
            "source": self.source.name,
            "files": [
                {"path": str(item.path), "topic": item.head.topic, "type": item.head.type, "rows": item.rows}
                for item in self.files
            ],
            "left_out": self.source.left_out,
            "warnings": self.source.notes,
        }


def export(
    source: TopicSource,
    target: ExportTarget,
    patterns: Sequence[str] = (),
    form: TableForm = TableForm(),  # noqa: B008  frozen
    progress: Progress | None = None,
    jobs: int = 1,
) -> ExportReport:
    """Write the messages of an input as tables; the input is closed.

    The tables get their names when the whole input has been read. If one cannot be written, none is kept.

    Args:
        source: the input.
        target: output of the tables.
        patterns: patterns of topics. By default a folder gets all topics except the datagrams and those that
            need an examination, also those that only the content names; a file also leaves out this
            package's own.
        form: the columns.
        progress: updated while the input is read.
        jobs: see ``TopicSource.pieces``.

    Raises:
        CaptureError: a table cannot be written, or there is nothing to write.
        ConfigError: a field does not exist, or one file would hold several topics.
        RouteError: a topic does not exist.
    """
    with closing(source):
        usual = {*source.topics} - ({DATAGRAMS_TOPIC, *JUDGED} if target.folder else _OWN)
        before = {*source.topics}
        fields_of = {topic: _names(source.empty(topic)) for topic in chosen_topics(source, patterns, usual)}
        if (
            not patterns
            and form.fields
            and not all(has_field([item], *fields_of.values()) for item in form.fields)
        ):
            source.add_hidden_topics()
            fields_of |= {
                topic: _names(source.empty(topic)) for topic in source.topics if topic not in before
            }
        selection = check_fields(form.fields, fields_of)
        source.wants_new = not patterns
        make, folders = _writer(target)
        report, tables = ExportReport(source), dict[str, TableFile]()

        def piece(block: TopicBlock, zero_ns: int) -> Any:
            fits = block.topic in fields_of or has_field(form.fields, _names(block))
            return make.piece(form.columns(block, zero_ns)) if len(block) and fits else None

        writing = _Writing(apart=target.folder and source.shared(jobs))
        try:
            for topic, rows, item in source.pieces(selection, piece, progress, jobs):
                if item is None:
                    continue
                if topic not in tables:
                    target.check_alone(topic, tables)
                    none = source.empty(topic)  # it has the columns of all blocks
                    head = TableHead(topic, none.message.type, _description(source, topic))
                    tables[topic] = TableFile(target.place(topic), make, head, form.columns(none, 0))
                writing.do(tables[topic].write, item, rows)
            writing.wait()
            source.check_found(tables, selection)
            for place, table in enumerate(tables.values()):
                if place % 2:
                    table.complete()
                else:
                    writing.do(table.complete)
            writing.wait()
            for table in tables.values():
                table.keep()
                report.files.append(table)
        except BaseException:
            writing.stop()
            for table in tables.values():
                table.remove()
            for folder in folders:
                with suppress(OSError):  # the folder is not empty
                    folder.rmdir()
            raise
    return report


class _Writing:
    """Runs the functions that write tables: at once, or in order in a thread of its own.

    The thread is of use because the libraries that encode, compress and write let other threads run
    meanwhile.

    Args:
        apart: run them in a thread, which starts with the first of them: processes are forked before.
    """

    def __init__(self, *, apart: bool) -> None:
        self._tasks: queue.Queue[tuple[Callable[..., None], tuple[Any, ...]]] | None = None
        self._apart = apart
        self._failure: BaseException | None = None

    def do(self, work: Callable[..., None], *arguments: Any) -> None:
        """Run a function now, or pass it to the thread.

        Raises:
            CaptureError: this or an earlier write failed.
        """
        if not self._apart:
            work(*arguments)
            return
        if self._tasks is None:
            self._tasks = queue.Queue(_TASKS)
            threading.Thread(target=self._run, args=[self._tasks], daemon=True).start()
        self._tasks.put((work, arguments))
        self._raise()

    def wait(self) -> None:
        """Wait until all functions have run.

        Raises:
            CaptureError: a write failed.
        """
        if self._tasks is not None:
            self._tasks.join()
        self._raise()

    def stop(self) -> None:
        """Skip what has not begun, and wait until the running function ends."""
        self._failure = self._failure or CaptureError("stopped")
        if self._tasks is not None:
            self._tasks.join()

    def _raise(self) -> None:
        if self._failure is not None:
            raise self._failure

    def _run(self, tasks: queue.Queue[tuple[Callable[..., None], tuple[Any, ...]]]) -> None:
        while True:
            work, arguments = tasks.get()
            try:
                if self._failure is None:
                    work(*arguments)
            except BaseException as error:  # noqa: BLE001  raised where the next thing is to be done
                self._failure = error
            finally:
                tasks.task_done()


def _names(block: TopicBlock) -> list[str]:
    """Return the names of a block's columns."""
    return [column.name for column in TableForm().columns(block, 0)]


def _writer(target: ExportTarget) -> tuple[Any, list[Path]]:
    """Return the class that writes, and the folders that were created for it, the innermost first.

    Raises:
        CaptureError: the folder cannot be created.
        ConfigError: the library is not installed.
    """
    try:
        make = target.format.sink()
    except ImportError as error:
        raise ConfigError(
            f"{target.path}: {target.format.name} needs {error.name}, which is not installed: "
            "pip install 'edoras-tools[analysis]', or write CSV or JSON Lines"
        ) from error
    folder = target.path if target.folder else target.path.parent
    new_folders = [item for item in (folder, *folder.parents) if not item.exists()]
    with os_errors(f"{folder}: the folder cannot be created"):
        check_links(folder)
        folder.mkdir(parents=True, exist_ok=True)
    return make, new_folders


def _description(source: TopicSource, topic: str) -> dict[str, str]:
    """Return the metadata of a table besides topic and type."""
    return {"edoras.source": source.name, "edoras.definition": source.definition(topic)}
