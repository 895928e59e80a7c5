"""Brings an index up to date: lists captures, lets workers read new and changed ones, and writes their rows.

Rules:

1. Captures are read in groups, so that small files are not separate tasks; a group is so small that every
   worker gets several.
2. Only a few groups per worker are in progress: results are written as they arrive, and do not pile up.
3. Dask replaces a lost worker, and its group is read again. A group that loses several workers is divided
   into single captures; one that still loses workers is listed as unreadable, with that reason.
4. Written rows stay: after an early end of the program the next update continues with the rest.
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any, Final

import dask
import msgspec
from dask.system import CPU_COUNT
from distributed import Client, Future, LocalCluster, as_completed
from distributed.client import FutureCancelledError
from distributed.core import rpc
from distributed.scheduler import KilledWorker
from distributed.security import Security

from edoras_tools.addons.archive.places import ListedFile, find_captures, root_of
from edoras_tools.addons.archive.work import CHANGING, Task, examine_group, failed, fingerprint
from edoras_tools.errors import CaptureError, ConfigError
from edoras_tools.pipelines.reading import on_interrupt
from edoras_tools.words import plural

if TYPE_CHECKING:
    from edoras_tools.addons.archive.index import Index
    from edoras_tools.pipelines.workbench import Settings
    from edoras_tools.render.terminal.text import Progress


_PATIENCE_S: Final = 10
"""Time after which a scheduler that has not answered, or has no worker, is given up, s."""

_THRIFTY: Final = {
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "5s",
    "distributed.nanny.pre-spawn-environ": {"OMP_NUM_THREADS": "1"},
}
"""Intervals of the local workers' side tasks: 1 % of a core instead of 4. Also, dask must not let a worker
keep 64 KiB of freed memory: each larger column would be mapped again, a quarter of all its time."""


@contextmanager
def workers(jobs: int, scheduler: str, *, most: int) -> Iterator[Client]:
    """Yield a client of a cluster that has at least one worker.

    A local cluster uses TLS with a certificate that only its own processes have: on a machine with several
    users nobody else can submit work.

    Args:
        jobs: worker processes on this machine; 0: one for each processor core.
        scheduler: address of a dask scheduler to use instead; empty for none.
        most: largest useful number of processes on this machine.

    Raises:
        CaptureError: the scheduler does not answer, or has no worker.
    """
    quiet = logging.CRITICAL + 1  # a lost worker is reported when its results are awaited
    for name in ("asyncio", "tornado", *logging.root.manager.loggerDict):
        if name.partition(".")[0] in {"asyncio", "distributed", "tornado"}:
            logging.getLogger(name).setLevel(quiet)
    with ExitStack() as opened:
        opened.enter_context(dask.config.set({"distributed.comm.timeouts.connect": f"{_PATIENCE_S}s"}))
        if scheduler:
            yield opened.enter_context(_client(scheduler))
            return
        opened.enter_context(dask.config.set(_THRIFTY))
        cluster = opened.enter_context(
            LocalCluster(
                n_workers=min(jobs or CPU_COUNT, most),
                threads_per_worker=1,
                processes=True,
                host="127.0.0.1",
                dashboard_address="127.0.0.1:0",
                security=Security.temporary(),
                silence_logs=quiet,
            )
        )
        yield opened.enter_context(Client(cluster, set_as_default=False))


def _client(scheduler: str) -> Client:
    try:
        kind = asyncio.run(asyncio.wait_for(_kind(scheduler), _PATIENCE_S))
    except (OSError, TimeoutError, asyncio.TimeoutError, ValueError, ImportError) as error:
        raise CaptureError(
            f"{scheduler}: no dask scheduler answers there; start one with 'dask scheduler', or leave "
            "--scheduler out"
        ) from error
    if kind != "Scheduler":
        raise CaptureError(f"{scheduler}: is the address of a {kind}, not of a dask scheduler; name that")
    client = Client(scheduler, timeout=_PATIENCE_S, set_as_default=False)
    try:
        client.wait_for_workers(1, timeout=_PATIENCE_S)
    except (TimeoutError, asyncio.TimeoutError) as error:
        client.close()
        raise CaptureError(
            f"{scheduler}: the scheduler has no worker; start some with 'dask worker {scheduler}'"
        ) from error
    return client


async def _kind(address: str) -> str:
    """Return the kind of the process at an address; ``Client`` would wait for ever for one that is silent."""
    async with rpc(address, connection_args=Security().get_connection_args("client")) as other:
        return str((await other.identity())["type"])


_GROUP_BYTES: Final = 16 << 20
_GROUP_CAPTURES: Final = 64
_GROUPS_EACH: Final = 8
"""Least number of groups for each worker, if there are enough captures, so that all end together."""
_ERRORS: Final = """
SELECT error FROM captures WHERE error IS NOT NULL AND capture IN (SELECT unnest(?)) ORDER BY capture
"""
_UNDER_WAY: Final = 3
"""Groups for each worker that were submitted and are not written yet."""


class Update(msgspec.Struct, frozen=True):
    """The order of an update.

    Attributes:
        roots: folders, files and URLs.
        settings: missions and options for all captures.
        jobs: worker processes on this machine; 0: one for each processor core.
        scheduler: address of a dask scheduler to use instead; empty for none.
        again: whether to read every capture, not only new or changed ones.
        forget: whether to delete the rows of captures that no longer exist.
    """

    roots: tuple[str, ...]
    settings: Settings
    jobs: int = 0
    scheduler: str = ""
    again: bool = False
    forget: bool = False


class UpdateReport(msgspec.Struct):
    """The result of an update.

    Attributes:
        listed: number of captures that exist.
        read: number of captures whose rows were written.
        same: number of captures with a new version but unchanged contents.
        missing: captures in the index that no longer exist.
        bad: error of each capture that could not be read completely, now or before.
        lost_workers: number of lost workers.
        interrupted: whether Ctrl-C ended it.
    """

    listed: int = 0
    read: int = 0
    same: int = 0
    missing: int = 0
    bad: list[str] = msgspec.field(default_factory=list)
    lost_workers: int = 0
    interrupted: bool = False
    unfinished: int = 0

    def summary(self) -> dict[str, Any]:
        """Return the report in the shape of ``archive --json``."""
        return {
            "found": self.listed,
            "read": self.read,
            "same": self.same,
            "unchanged": self.listed - self.read - self.same - self.unfinished,
            "left": self.unfinished,
            "gone": self.missing,
            "lost_workers": self.lost_workers,
            "errors": self.bad,
        }


def bring_up_to_date(
    index: Index,
    update: Update,
    progress: Progress | None = None,
    on_line: Callable[[str], None] = lambda _line: None,
) -> UpdateReport:
    """Read new or changed captures, and write their rows to an index.

    Args:
        index: index, open for writing.
        on_line: called with lines for the user while it runs.

    Raises:
        CaptureError: a folder cannot be listed, the scheduler is absent or was lost, the disk is full.
        ConfigError: a mission has mistakes, or a worker reads another one.
    """
    settings = fingerprint(update.settings)
    files = find_captures(update.roots)
    rows = {
        row["capture"]: row
        for row in index.rows("SELECT capture, size, version, sha256, settings, state, gone FROM captures")
    }
    new = [item for item in files if update.again or _is_new(item, rows.get(item.url), settings)]
    report = UpdateReport(listed=len(files), unfinished=len(new))
    names = {item.url for item in files}
    places = [root_of(item) for item in update.roots]
    missing = [url for url in rows if url not in names and any(_is_under(url, place) for place in places)]
    report.missing = len(missing)
    index.leave(missing, [url for url in names if url in rows and rows[url]["gone"]], forget=update.forget)
    if new:
        alike = {} if update.again else rows
        hashes = {url: row["sha256"] for url, row in alike.items() if row["settings"] == settings}
        with on_interrupt(_interrupt, in_handler=True) as stop_event:
            try:
                with workers(update.jobs, update.scheduler, most=len(new)) as client:
                    _Run(index, client, report, set(rows), on_line).all(
                        _tasks(new, hashes, update.settings, settings, _count(client)), progress
                    )
            except KeyboardInterrupt:
                if not stop_event.is_set():
                    raise
                report.interrupted = True
    report.bad = [error for (error,) in index.ask(_ERRORS, [list(names)])]
    return report


def _interrupt() -> None:
    raise KeyboardInterrupt


def _is_new(item: ListedFile, row: dict[str, Any] | None, settings: str) -> bool:
    """Return whether a capture must be read: also if it could not be read at all, or was changing."""
    if row is None or row["settings"] != settings or row["sha256"] is None or row["state"] == CHANGING:
        return True
    return not item.version or (row["size"], row["version"]) != (item.size, item.version)


def _is_under(url: str, place: str) -> bool:
    return url == place or url.startswith(place.rstrip("/") + "/")


def _count(client: Client) -> int:
    return max(1, len(client.nthreads()))


def _tasks(
    new: Sequence[ListedFile], hashes: dict[str, str | None], settings: Settings, print_: str, workers_: int
) -> deque[Task]:
    """Divide captures into groups; the largest first, so that the last ones are small."""
    total = sum(max(0, item.size) for item in new)
    most_bytes = min(_GROUP_BYTES, total // (_GROUPS_EACH * workers_))
    most = max(1, min(_GROUP_CAPTURES, len(new) // (_GROUPS_EACH * workers_)))
    tasks: deque[Task] = deque()
    group: list[ListedFile] = []

    def end() -> None:
        if group:
            captures = tuple((item.url, hashes.get(item.url) or "") for item in group)
            tasks.append(Task(captures, settings, print_))
            group.clear()

    for item in sorted(new, key=lambda item: (-item.size, item.url)):
        if len(group) >= most or sum(max(0, own.size) for own in group) + item.size > most_bytes:
            end()
        group.append(item)
    end()
    return tasks


class _Run:
    """Submits groups and writes their results.

    Args:
        index: index, open for writing.
        report: report, updated during the run.
        contents: captures that have rows in the index.
        on_line: called with lines for the user.
    """

    def __init__(
        self,
        index: Index,
        client: Client,
        report: UpdateReport,
        contents: set[str],
        on_line: Callable[[str], None],
    ) -> None:
        self._index, self._client, self._report = index, client, report
        self._contents, self._on_line = contents, on_line
        self._tasks: dict[str, Task] = {}
        self._workers: set[str] = set()

    def all(self, waiting: deque[Task], progress: Progress | None) -> None:
        """Process all groups.

        Raises:
            CaptureError: the scheduler was lost, or the index cannot be written.
            ConfigError: a worker cannot do the work.
        """
        of = self._report.unfinished
        show = progress.step if progress else lambda *_: None
        show("captures", 0, of)  # the first capture may take minutes
        try:
            coming = as_completed([], loop=self._client.loop, raise_errors=False)
            while waiting or self._tasks:
                while waiting and len(self._tasks) < _UNDER_WAY * _count(self._client):
                    future = self._client.submit(examine_group, task := waiting.popleft(), pure=False)
                    self._tasks[future.key] = task
                    coming.add(future)
                # what else is complete by now is written in the same transaction
                batch = [next(coming), *coming.next_batch(block=False)]
                self._watch()
                self._write(batch, waiting)
                show("captures", of - self._report.unfinished, of)
        except (OSError, FutureCancelledError) as error:
            raise CaptureError(
                "the scheduler was lost; what was read is in the index: run the same again to go on"
            ) from error

    def _watch(self) -> None:
        """Report workers that no longer exist."""
        now = set(self._client.nthreads())
        if lost := len(self._workers - now):
            self._report.lost_workers += lost
            self._on_line(f"{plural(lost, 'worker')} lost; what they had not finished is read again")
        self._workers = now

    def _write(self, futures: list[Future], waiting: deque[Task]) -> None:
        parts, same, urls = [], [], []
        for future in futures:
            task = self._tasks.pop(future.key)
            own = [url for url, _ in task.captures]
            if future.status == "error" and isinstance(error := future.exception(), KilledWorker):
                if len(own) > 1:
                    waiting += [Task((item,), task.settings, task.fingerprint) for item in task.captures]
                    continue
                lost = error.allowed_failures + 1
                reason = f"cannot be read: {lost} workers were lost with it, perhaps out of memory"
                parts.append(failed(own, reason, task.fingerprint))
                urls += own
                continue
            result = _result(future)
            if result.misfit:
                raise ConfigError(result.misfit)
            parts.append(result.rows)
            same += result.same
            unchanged = {item.url for item in result.same}
            urls += [url for url in own if url not in unchanged]
        self._index.replace([url for url in urls if url in self._contents], parts)
        self._index.touch(same)
        self._report.read += len(urls)
        self._report.same += len(same)
        self._report.unfinished -= len(urls) + len(same)


def _result(future: Future) -> Any:
    """Return the result of a worker.

    Raises:
        ConfigError: the worker could not begin.
    """
    try:
        return future.result()
    except (ImportError, AttributeError) as error:
        raise ConfigError(
            f"a worker cannot run this: {error}; install the same edoras-tools[archive] where workers run"
        ) from error
