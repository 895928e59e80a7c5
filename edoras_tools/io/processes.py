"""Forked processes that do tasks while this one goes on; free processors, and a real-time priority.

Most parallel work is made of these processes. Two threads that work in numpy pass Python's lock to each other
hundreds of times per batch; two processes do not. Arrays go through shared memory, everything else is pickled
through a socket. The rules:

1. The processes take turns, so answers come in the order of the tasks. Each has at most ``_TASKS`` tasks (or
   as many as the caller says) whose answers were not taken; before submitting more, take the oldest answer.
2. The arrays of an answer are valid until the next task is submitted.
3. A source may read into lent memory, on either side. Its contents are not copied; the memory is lent again
   when the tasks that use it are done, or the answers that use it are no longer valid.
4. A process ends when the other end of its socket is closed, and is killed when its parent dies, so that
   no process continues without a receiver.
5. If no process can be forked, there are none, and the caller does the work.

A program that shares work uses only free processors, and leaves the others to other programs. On a busy
machine a thread that wakes up waits milliseconds for a processor. Root, or a program with CAP_SYS_NICE, may
have a real-time priority (``sched(7)``, SCHED_FIFO): such a thread does not wait.

Rules of this priority:

1. A thread that uses much of a processor loses the priority until it uses little: other programs must run.
2. No priority is requested on a machine with one processor.
3. Threads and processes started meanwhile have the usual priority (SCHED_RESET_ON_FORK).
4. If the priority is not allowed, everything works without it.
"""

from __future__ import annotations

import ctypes
import gc
import mmap
import os
import pickle
import select
import signal
import socket
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from time import sleep
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.errors import CaptureError, EdorasError
from edoras_tools.io.outputs import ENDING

if TYPE_CHECKING:
    from types import TracebackType

    from typing_extensions import Self

    from edoras_tools.io import Source
    from edoras_tools.wire.arrays import Octets

_LOAD: Final = Path("/proc/loadavg")


def spare_processors() -> int:
    """Return the number of further processes that have a processor now; below 0 if some wait for one.

    Running processes are counted on the whole machine, including this one (proc(5), ``loadavg``). If the
    count is not available, no other process is assumed to run.
    """
    processors = os.cpu_count() or 1
    if sys.platform != "linux":
        return processors - 1
    try:
        running = int(_LOAD.read_text().split()[3].partition("/")[0])
    except (OSError, ValueError, IndexError):
        return processors - 1
    return processors - max(running, 1)


_LEAST: Final = 1
"""The lowest real-time priority, which precedes all of normal priority."""
_LITTLE, _MUCH = 0.5, 0.7
"""Shares of a processor: below the first, the priority is given; above the second, it is taken."""
_LOOK_NS: Final = 20_000_000


class Precedence:
    """The real-time priority of the thread that enters this context; entering again restarts it."""

    def __init__(self) -> None:
        self._possible = hasattr(os, "sched_setscheduler") and len(os.sched_getaffinity(0)) > 1
        self._inside = self._first = False
        self._then = self._busy = 0

    def __enter__(self) -> Self:
        """Request the priority."""
        self._then, self._busy = time.monotonic_ns(), time.thread_time_ns()
        self._inside = True
        self._set(first=True)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Give the priority back."""
        self._inside = False
        self._set(first=False)

    def look(self) -> None:
        """Give or take the priority by the processor time since the last call; call it often."""
        now = time.monotonic_ns()
        if not (self._possible and self._inside) or now - self._then < _LOOK_NS:
            return
        busy = time.thread_time_ns()
        share = (busy - self._busy) / (now - self._then)
        self._then, self._busy = now, busy
        if self._first and share > _MUCH:
            self._set(first=False)
        elif not self._first and share < _LITTLE:
            self._set(first=True)

    def _set(self, *, first: bool) -> None:
        if not self._possible or first == self._first:
            return
        policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK if first else os.SCHED_OTHER
        try:
            os.sched_setscheduler(0, policy, os.sched_param(_LEAST if first else 0))
        except OSError:  # not allowed
            self._possible = False
        else:
            self._first = first


def run_soon() -> None:
    """Let the calling thread, which works little, wait less for a busy processor, if that is allowed."""
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, -10)


_LARGE: Final = 32 << 20
"""Smallest file, in bytes, that is worth several processes."""
_MOST_JOBS: Final = 3
"""Most processes: one reads and decodes; two others do the rest as fast as the first does its part."""
_LOOKS: Final = 5
_LOOK_S: Final = 0.002
"""Time between two looks at the free processors: a short program may just run at the first."""


def jobs_for(source: Source, number: int, *, fixed: bool = True) -> int:
    """Return how many processes share the work on a source.

    Args:
        source: source to read; a live one, a pipe or a small file is for one process.
        number: requested number; 0: the number of processor cores, at most three.
        fixed: whether the number stays, so that with 0 only the cores count that are free now.
    """
    if source.statistics.total_bytes < _LARGE:
        return 1
    if number:
        return number
    cores = len(os.sched_getaffinity(0)) if sys.platform == "linux" else 1
    others = min(_MOST_JOBS, cores) - 1
    return 1 + (_spare(others) if fixed else others)


def _spare(most: int) -> int:
    """Return the number of free processors, at most ``most``."""
    count = 0
    for look in range(_LOOKS if most else 0):
        if look:
            sleep(_LOOK_S)
        count = max(count, min(most, spare_processors()))
        if count == most:
            break
    return count


SLOT_BYTES: Final = 32 << 20
"""Space for the arrays of one value; the rest stays in its pickle. Only pages in use need memory."""
ROOM_BYTES: Final = 9 << 20
"""Space for a source to read into: a window of a file, and the rest of the one before."""
_TASKS: Final = 3
"""Tasks of each process: the present one, and others, so that it never waits for the submitter."""
_ALIGNMENT: Final = 64
_LENGTH_BYTES: Final = 8
"""Bytes of the length before every message."""
_PR_SET_PDEATHSIG: Final = 1
"""prctl(2): the signal that a process gets when its parent ends."""
_STANDARD_ERROR: Final = 2

Packed = tuple[bytes, list[tuple[int, int]]]
"""A pickle, and the places of its arrays in the shared memory."""


class Memory:
    """Memory shared with processes that are forked later: rooms to read into, then slots for values.

    Raises:
        OSError: no memory.
    """

    def __init__(self, rooms: int, slots: int) -> None:
        self._rooms_end = rooms * ROOM_BYTES
        size = self._rooms_end + slots * SLOT_BYTES
        self._bytes: Octets = np.frombuffer(mmap.mmap(-1, size), np.uint8)
        self._last_use = [0] * rooms
        """Number of the last value in each room, from 1; only one side lends memory."""
        self._room = 0

    def lend(self, size: int, await_use: Callable[[int], None]) -> Octets:
        """Return memory to read into: u8, ``size`` bytes; the next room, or new memory if that is too small.

        Args:
            await_use: takes the number of a value, and returns when that value is no longer read.
        """
        if size > ROOM_BYTES:
            return np.empty(size, np.uint8)
        self._room = (self._room + 1) % len(self._last_use)
        await_use(self._last_use[self._room])
        begin = self._room * ROOM_BYTES
        return self._bytes[begin : begin + size]

    def pack(self, value: Any, slot: int, number: int = 0) -> Packed:
        """Pickle a value, with its arrays in a slot as far as they fit.

        Args:
            number: number of the value, so that its arrays in rooms are not copied; 0: they are copied.
        """
        places: list[tuple[int, int]] = []
        origin = self._bytes.__array_interface__["data"][0]
        at = self._rooms_end + slot * SLOT_BYTES
        end = at + SLOT_BYTES

        def in_pickle(buffer: pickle.PickleBuffer) -> bool:
            """Put an array into shared memory; return whether it has to stay in the pickle."""
            nonlocal at
            data = np.frombuffer(buffer.raw(), np.uint8)
            begin = data.__array_interface__["data"][0] - origin
            if number and 0 <= begin < self._rooms_end:
                self._last_use[begin // ROOM_BYTES] = number
                places.append((begin, begin + len(data)))
                return False
            if at + len(data) > end:
                return True
            self._bytes[at : at + len(data)] = data
            places.append((at, at + len(data)))
            at += -(-len(data) // _ALIGNMENT) * _ALIGNMENT
            return False

        return pickle.dumps(value, protocol=5, buffer_callback=in_pickle), places

    def unpack(self, packed: Packed) -> Any:
        """Return a value whose arrays lie in this memory."""
        body, places = packed
        return pickle.loads(body, buffers=[self._bytes[begin:end] for begin, end in places])  # noqa: S301  ours


class Desk:
    """The other end: a process gets its tasks here, and answers them in order.

    Attributes:
        idle: called while there is no task; does the work that is due, and returns the time in s that it can
            wait, or None: until a task comes.
        end: called when no more tasks will come.
    """

    def __init__(self, link: socket.socket, memory: Memory, tasks: int) -> None:
        self._link, self._memory, self._tasks = link, memory, tasks
        self._requests: deque[tuple[int, Packed]] = deque()
        self._request_count = self._answer_count = 0
        self._lends = False
        self.idle: Callable[[], float | None] = lambda: None
        self.end: Callable[[], object] = lambda: None

    @property
    def awaited(self) -> bool:
        """Whether the submitter, if it keeps all tasks in use, waits for an answer or for the last task."""
        while _readable(self._link):
            self._receive()
        return self._request_count - self._answer_count >= self._tasks - 1

    def lend(self, size: int) -> Octets:
        """Return memory to read into, u8, ``size`` bytes; arrays of answers in it are not copied."""
        self._lends = True
        return self._memory.lend(size, self._await_use)

    def serve(self, work: Callable[..., Any]) -> None:
        """Do tasks until the other end is closed."""
        with suppress(OSError, EOFError):
            while True:
                while not self._requests:
                    if _readable(self._link, self.idle()):
                        self._receive()
                send(self._link, self._answer(work, *self._requests.popleft()))
                self._answer_count += 1
        self.end()

    def _answer(
        self, work: Callable[..., Any], slot: int, request: Packed
    ) -> tuple[Exception | None, Packed | None]:
        try:
            result = work(*self._memory.unpack(request))
            number = self._answer_count + 1 if self._lends else 0
            return None, self._memory.pack(result, 2 * slot + 1, number)
        except Exception as error:  # noqa: BLE001  whoever takes the answer gets it
            return portable(error), None

    def _await_use(self, answer: int) -> None:
        """Return when an answer is no longer valid: when ``_tasks`` later tasks were submitted."""
        while answer and self._request_count < answer + self._tasks:
            self._receive()

    def _receive(self) -> None:
        self._requests.append(receive(self._link))
        self._request_count += 1


class Workers:
    """Processes that run a function.

    Args:
        count: number of processes, at least 1.
        work: function that they run, as it is at ``start``; its arguments and its result are pickled.
        killed: exception to raise if one of them was killed.
        set_up: called in each process before its first task; the process then keeps the files that it reads.
        tasks: most tasks of each process.
        yields: see ``crowded``.

    Raises:
        OSError: no memory.
    """

    def __init__(
        self,
        count: int,
        work: Callable[..., Any],
        killed: CaptureError,
        *,
        set_up: Callable[[Desk], None] | None = None,
        tasks: int = _TASKS,
        yields: bool = False,
    ) -> None:
        self._count, self._work, self._set_up = count, work, set_up
        self._killed, self._yields, self._crowds = killed, yields, 0
        self._tasks, self._slots = tasks, tasks * count
        self._memory = Memory(self._slots + 1, 2 * self._slots)
        self._task_count = self._answer_count = 0
        self._results: deque[tuple[Exception | None, Any]] = deque()
        self._links: list[socket.socket] = []
        self.processes: list[int] = []

    def start(self) -> None:
        """Fork the processes at the first call; a later fork inherits more of what they need."""
        with suppress(OSError):  # then there are fewer, or none
            for _ in range(self._count):
                process, link = fork(self._serve)
                self.processes.append(process)
                self._links.append(link)
        self._count = 0

    def lend(self, size: int) -> Octets:
        """Return memory to read into: u8, ``size`` bytes; tasks that use it need not copy it.

        It belongs to the caller until this has been called as many times as there are rooms; the call waits
        until its former contents are no longer read.
        """
        return self._memory.lend(size, self._await)

    @property
    def waiting(self) -> int:
        """The number of results that can be taken, now or later."""
        return self._task_count - self._answer_count + len(self._results)

    @property
    def ready(self) -> bool:
        """Whether the oldest result can be taken without waiting."""
        if not self._results and self._answer_count < self._task_count:
            return _readable(self._next)
        return bool(self._results)

    @property
    def full(self) -> bool:
        """Whether a result must be taken before the next task, or there is no process."""
        return self.waiting >= self._tasks * len(self.processes)

    def crowded(self) -> bool:
        """Return whether the processes must yield and other programs use all processors.

        Only a second call in a row without a free processor returns True, because a short program may just
        run.
        """
        if not self._yields:
            return False
        works = self._answer_count < self._task_count and not _readable(self._next)
        self._crowds = self._crowds + 1 if spare_processors() < (0 if works else 1) else 0
        return self._crowds > 1

    def submit(self, *values: Any) -> None:
        """Submit the arguments of a task; after the call only lent memory is still read."""
        assert not self.full, "results must be taken first"
        slot, link = self._task_count % self._slots, self._links[self._task_count % len(self._links)]
        self._task_count += 1
        request = self._memory.pack(values, 2 * slot, self._task_count)
        with undisturbed():
            try:
                send(link, (slot, request))
            except OSError:
                self._give_up()

    def take(self) -> Any:
        """Wait for the oldest result, and return it; its arrays are valid until ``submit``.

        Raises:
            CaptureError: a process was killed.
            Exception: the exception of the function.
        """
        self._await(self._task_count - self.waiting + 1)
        failure, result = self._results.popleft()
        if failure is not None:
            raise failure
        return result

    def dismiss(self) -> None:
        """Let the processes end; results that were not taken are lost."""
        self._answer_count = self._task_count
        self._results.clear()
        for link in self._links:
            link.close()

    def close(self) -> None:
        """Dismiss the processes, and wait until they have ended. Closing twice does nothing."""
        self.dismiss()
        while self.processes:
            with suppress(ChildProcessError):  # no child is left if SIGCHLD is ignored
                os.waitpid(self.processes.pop(), 0)

    @property
    def _next(self) -> socket.socket:
        """The socket of the next answer."""
        return self._links[self._answer_count % len(self._links)]

    def _await(self, task: int) -> None:
        """Wait until a task is done; return at once if it is."""
        while self._answer_count < task:
            link = self._next
            select.select([link], [], [])
            with undisturbed():
                try:
                    failure, answer = receive(link)
                except (OSError, EOFError):
                    self._give_up()
                    return
                self._answer_count += 1
                self._results.append((failure, answer and self._memory.unpack(answer)))

    def _give_up(self) -> None:
        self._results += [(self._killed, None)] * (self._task_count - self._answer_count)
        self._answer_count = self._task_count

    def _serve(self, link: socket.socket) -> None:
        desk = Desk(link, self._memory, self._tasks)
        # An output stays locked, and other processes wait for it, as long as this one has it open. On Linux
        # the link of a descriptor shows whether it can be read.
        for number in map(int, os.listdir("/proc/self/fd")):  # noqa: PTH208  numbers, not paths
            with suppress(OSError):  # the folder itself
                needed = self._set_up and os.lstat(f"/proc/self/fd/{number}").st_mode & 0o400
                if number > _STANDARD_ERROR and number != link.fileno() and not needed:
                    os.close(number)
        if self._set_up is not None:
            self._set_up(desk)
        desk.serve(self._work)


class InOrder:
    """Runs a function on batches, one after the other; their results come in the same order.

    Args:
        work: the function; what it returns must not depend on the process that runs it.
        workers: run it too, if there are any.
    """

    def __init__(self, work: Callable[..., Any], workers: Workers | None = None) -> None:
        self._work, self._workers = work, workers
        self._results: deque[tuple[Any] | None] = deque()
        """Results that were not taken; None while a worker makes one."""

    def add(self, *values: Any, alone: bool = False) -> None:
        """Run the function on some values.

        It runs in this process if all workers are busy, if no processor is free for them, or if ``alone`` is
        set, for example because nothing else is left to do.
        """
        workers = self._workers
        if workers is not None and (alone or workers.crowded()):
            workers = None
        if workers is not None:
            workers.start()
        if workers is None or workers.full:
            self._results.append((self._work(*values),))
        else:
            workers.submit(*values)
            self._results.append(None)

    def results(self, most: int | None = None) -> Iterator[Any]:
        """Yield the finished results; wait while more than ``most`` results are not taken; None: never wait.

        The arrays of a result are valid until the next result is requested, or more values are added.
        """
        while self._results:
            workers, patient = self._workers, most is None or len(self._results) <= most
            if self._results[0] is None and patient and workers is not None and not workers.ready:
                return
            result = self._results.popleft()  # first: what fails must not be waited for again
            if result is None and workers is not None:
                result = (workers.take(),)
            assert result is not None
            yield result[0]


def fork(serve: Callable[[socket.socket], None]) -> tuple[int, socket.socket]:
    """Run a function in a forked process; return its process id, and the socket to it.

    The signals that end a program stay blocked as during the fork: the parent handles them.

    Args:
        serve: called in the other process with its end of the socket; the process ends with it.

    Raises:
        OSError: no process can be forked.
    """
    if sys.platform != "linux":
        raise OSError("on other systems, libraries do not support fork")
    link, other_end = socket.socketpair()
    parent = os.getpid()
    with other_end, undisturbed():
        try:
            process = os.fork()
        except OSError:
            link.close()
            raise
        if not process:
            link.close()
            with suppress(BaseException):
                ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
                if os.getppid() != parent:  # the parent had already ended
                    os._exit(1)
                gc.freeze()  # a collection would write to all shared pages, and so copy them
                serve(other_end)
            os._exit(0)
    return process, link


@contextmanager
def undisturbed() -> Iterator[None]:
    """Delay Ctrl-C: after half a request or answer, the connection could not be used any more."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    try:  # a pending signal raises in the call that blocks, after it has blocked
        signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def send(link: socket.socket, value: Any) -> None:
    """Send a value to the other process.

    Raises:
        OSError: the process has ended.
    """
    data = pickle.dumps(value, protocol=5)
    link.sendall(len(data).to_bytes(_LENGTH_BYTES, "big") + data)


def receive(link: socket.socket) -> Any:
    """Return a value from the other process.

    Raises:
        OSError: the process has ended.
        EOFError: the process has ended.
    """
    size = int.from_bytes(_received(link, _LENGTH_BYTES), "big")
    return pickle.loads(_received(link, size))  # noqa: S301  from our own process


def _received(link: socket.socket, size: int) -> bytes:
    """Return ``size`` bytes; they may come in parts if the process was stopped and continued (Ctrl-Z)."""
    parts = []
    while size:
        part = link.recv(size, socket.MSG_WAITALL)
        if not part:
            raise EOFError
        parts.append(part)
        size -= len(part)
    return b"".join(parts)


def _readable(link: socket.socket, wait_s: float | None = 0) -> bool:
    return bool(select.select([link], [], [], wait_s)[0])


def portable(error: Exception) -> Exception:
    """Return an exception that can be pickled; if needed, another one with the same text."""
    try:
        pickle.loads(pickle.dumps(error))  # noqa: S301  our own data
    except Exception:  # noqa: BLE001  unpickling may fail in any way
        return CaptureError(
            str(error) if isinstance(error, EdorasError) else f"{type(error).__name__}: {error}"
        )
    return error


def writer_killed(path: object) -> CaptureError:
    """Return the error for a process that was killed while it wrote a file."""
    return CaptureError(
        f"{path}: the process that wrote it was killed; `edoras recover {path}` repairs the file"
    )
