"""Other processes that examine the chapters of a long capture.

The rules:

1. The processes take turns: each takes the datagrams of a chapter as they are read, and judges them when all
   have come. Meanwhile the next one takes the next chapter.
2. What goes on from chapter to chapter is followed by the process that reads: decoding, conversations, files.
3. A process stays for the whole capture: what it needs memory for, it has from the chapter before.
4. Where no process can be forked, the one that reads does its work.
"""

from __future__ import annotations

import pickle
from collections import deque
from contextlib import ExitStack, closing, contextmanager
from dataclasses import fields, replace
from functools import cache
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from edoras_tools.diagnosis.case import Capture
from edoras_tools.diagnosis.evidence.table import Recorder
from edoras_tools.errors import CaptureError
from edoras_tools.io.formats.records import RecordSource
from edoras_tools.io.processes import Workers

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.examination import Chapter, Diagnosis, Examination
    from edoras_tools.io import Source
    from edoras_tools.model import Columns, PacketBatch

    _Table = TypeVar("_Table", PacketBatch, Columns)


class _Judge:
    """A process, as the one that reads sees it.

    Raises:
        OSError: no memory.
    """

    def __init__(self, examination: Examination, killed: CaptureError) -> None:
        self._examination = examination
        self._recorder = Recorder(examination.context)
        self._results: deque[list[Any]] = deque()
        self.workers = Workers(1, self._work, killed)

    def ask(self, work: Callable[..., Any], *values: Any) -> Callable[[], Any]:
        """Let the process run one of the methods below; return what waits for the result."""
        self.workers.start()
        while self.workers.full and self.workers.waiting:
            self._take()
        result: list[Any] = []
        if self.workers.full:
            result.append(self._work(work.__name__, *values))
        else:
            self.workers.submit(work.__name__, *values)
            self._results.append(result)

        def wait() -> Any:
            while not result:
                self._take()
            return result[0]

        return wait

    def keep(self, batch: PacketBatch, columns: Columns, unrouted: list[Any]) -> None:
        """Keep datagrams; ``unrouted`` is the reading context's."""
        self._examination.context.unrouted = unrouted
        self._recorder.keep(_own(batch), _own(columns))

    def judge(self, chapter: Chapter) -> bytes:
        """Judge what was kept; return the diagnosis, pickled: its arrays stay valid."""
        recorder, self._recorder = self._recorder, Recorder(self._examination.context)
        recorder.conversations.flows, recorder.left_out = chapter.flows, chapter.left_out
        self._examination.progress = lambda _position, _of: None  # one process shows the progress
        diagnosis = self._examination.judged(recorder, chapter)
        return pickle.dumps(replace(diagnosis, capture=Capture(), case=None))

    def _work(self, name: str, *values: Any) -> Any:
        return getattr(self, name)(*values)

    def _take(self) -> None:
        self._results.popleft().append(self.workers.take())


class _Judges:
    """Processes that take turns; see ``Apart``."""

    def __init__(self, examination: Examination, judges: list[_Judge]) -> None:
        self._context, self._judges = examination.context, deque(judges)

    def lend(self, size: int) -> NDArray[np.uint8]:
        """Return memory to read into; what lies in it need not be copied for the one whose turn it is."""
        return self._judges[0].workers.lend(size)

    def keep(self, batch: PacketBatch, columns: Columns) -> None:
        """See ``Apart``."""
        judge = self._judges[0]
        judge.ask(judge.keep, batch, columns, self._context.unrouted)

    def judge(self, chapter: Chapter) -> Callable[[], Diagnosis]:
        """See ``Apart``."""
        judge = self._judges[0]
        self._judges.rotate(-1)
        wait = judge.ask(judge.judge, chapter)

        @cache
        def received() -> Diagnosis:
            diagnosis: Diagnosis = pickle.loads(wait())  # noqa: S301  from our own process
            return replace(diagnosis, capture=chapter.capture)

        return received


def _own(table: _Table) -> _Table:
    """Return a batch or its columns with all arrays but the bytes in memory of this process."""
    columns = {item.name: getattr(table, item.name) for item in fields(table) if item.name != "data"}
    arrays: Any = {name: value.copy() for name, value in columns.items() if isinstance(value, np.ndarray)}
    return replace(table, **arrays)


@contextmanager
def judged_apart(examination: Examination, source: Source, jobs: int) -> Iterator[None]:
    """Let as many other processes examine a source; none of one job, or where there is no memory for them.

    Raises:
        CaptureError: from the examination: one of them was killed.
    """
    why = "a process that examined part of it was killed, perhaps because memory ran out"
    killed = CaptureError(f"{source.info.name}: {why}; --jobs 1 needs only one")
    with ExitStack() as ends:
        try:
            judges = [_Judge(examination, killed) for _ in range(jobs if jobs > 1 else 0)]
        except OSError:
            judges = []
        if judges:
            for judge in judges:
                ends.enter_context(closing(judge.workers))
            judges_ = _Judges(examination, judges)
            if isinstance(source, RecordSource):
                source.borrow(judges_.lend)
            examination.let(judges_)
        yield
