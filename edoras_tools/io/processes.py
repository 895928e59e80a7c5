"""Forked processes that do tasks while this one goes on: all that uses a second processor is made of these.

Two threads that work in numpy pass Python's lock to each other hundreds of times per batch; two processes do
not. Arrays go through shared memory, everything else is pickled through a socket. The rules:

1. The processes take turns, so answers come in the order of the tasks. Each has at most so many tasks whose
   answers were not taken; whoever submits more takes the oldest first.
2. The arrays of an answer are valid until the next task is submitted.
3. A source may read into lent memory, on either side. What lies in it is not copied; it is lent again when
   the tasks that use it are done, or the answers that use it are no longer valid.
4. A process ends when the other end of its socket is closed, and is killed when its parent dies, so that
   nothing keeps writing for nobody.
5. Where no process can be forked, there are none, and whoever asks does the work.
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
from collections import deque
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.errors import CaptureError, EdorasError
from edoras_tools.io.outputs import ENDING
from edoras_tools.io.processors import spare_processors

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

SLOT_BYTES: Final = 32 << 20
"""Space for the arrays of one value; the rest stays in its pickle. Only pages in use need memory."""
ROOM_BYTES: Final = 9 << 20
"""Space for a source to read into: a window of a file, and the rest of the one before."""
_TASKS: Final = 3
"""Tasks of each process: the one that it works on, and others, so that it never waits for whoever submits."""
_ALIGNMENT: Final = 64
_LENGTH_BYTES: Final = 8
"""Bytes of the length before every message."""
_PR_SET_PDEATHSIG: Final = 1
"""prctl(2): the signal that a process gets when its parent ends."""
_STANDARD_ERROR: Final = 2

Packed = tuple[bytes, list[tuple[int, int]]]
"""A pickle, and where its arrays are in the shared memory."""


class Memory:
    """Memory that processes forked later share: rooms to read into, then slots for values on their way.

    Raises:
        OSError: no memory.
    """

    def __init__(self, rooms: int, slots: int) -> None:
        self._rooms_end = rooms * ROOM_BYTES
        size = self._rooms_end + slots * SLOT_BYTES
        self._bytes: NDArray[np.uint8] = np.frombuffer(mmap.mmap(-1, size), np.uint8)
        self._last_use = [0] * rooms
        """The number of the last value in each room, from 1; only one side lends."""
        self._room = 0

    def lend(self, size: int, await_use: Callable[[int], None]) -> NDArray[np.uint8]:
        """Return memory to read into: u8, ``size`` bytes; the next room, or new memory if that is too small.

        Args:
            await_use: returns when the value with a number is no longer read.
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
            number: of the value, if its arrays in rooms stay where they are; 0: they are copied, too.
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
    """The other end: where a process gets its tasks, and answers them in order.

    Attributes:
        idle: called where there is no task; does what is due, and returns how long it can wait, in s; None:
            until a task comes.
        end: called when there will be no task.
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
        """Whether an answer is waited for, or the last one worked on; where all tasks are always in use."""
        while _readable(self._link):
            self._receive()
        return self._request_count - self._answer_count >= self._tasks - 1

    def lend(self, size: int) -> NDArray[np.uint8]:
        """Return memory to read into: u8, ``size`` bytes; answers with what lies in it need not copy that."""
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
        """Return when an answer is no longer valid: when so many later tasks were submitted."""
        while answer and self._request_count < answer + self._tasks:
            self._receive()

    def _receive(self) -> None:
        self._requests.append(receive(self._link))
        self._request_count += 1


class Workers:
    """Processes that run a function.

    Args:
        count: how many, at least 1.
        work: what they run, as it is at ``start``; its arguments and its result are pickled.
        killed: what is raised where one of them was killed.
        set_up: called in each process before its first task; it then keeps the files that are open.
        tasks: how many tasks each has at most.
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
        """Fork the processes at the first call; the later that is, the more of what they need is made."""
        with suppress(OSError):  # then there are fewer, or none
            for _ in range(self._count):
                process, link = fork(self._serve)
                self.processes.append(process)
                self._links.append(link)
        self._count = 0

    def lend(self, size: int) -> NDArray[np.uint8]:
        """Return memory to read into: u8, ``size`` bytes; tasks that use it need not copy it.

        It belongs to the caller until this has been called as many times as there are rooms; the call waits
        until its former contents are no longer read.
        """
        return self._memory.lend(size, self._await)

    @property
    def waiting(self) -> int:
        """How many results can be taken, now or later."""
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
        """Look whether the processes yield, and others run on all processors: a task is done no sooner here.

        Something short may run just now: only a second look in a row that finds no processor tells so.
        """
        if not self._yields:
            return False
        works = self._answer_count < self._task_count and not _readable(self._next)
        self._crowds = self._crowds + 1 if spare_processors() < (0 if works else 1) else 0
        return self._crowds > 1

    def submit(self, *values: Any) -> None:
        """Hand over the arguments of a task; afterwards only lent memory is still read."""
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
            Exception: what the function raised.
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
        """Where the next answer comes from."""
        return self._links[self._answer_count % len(self._links)]

    def _await(self, task: int) -> None:
        """Wait until a task is done, perhaps long ago."""
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
        if self._set_up is None:
            # The output stays locked, and other processes wait, as long as this one has their files open.
            for number in map(int, os.listdir("/proc/self/fd")):  # noqa: PTH208  numbers, not paths
                if number > _STANDARD_ERROR and number != link.fileno():
                    with suppress(OSError):  # the folder itself
                        os.close(number)
        else:
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
        """The results that were not taken; None where a worker makes one."""

    def add(self, *values: Any, alone: bool = False) -> None:
        """Run the function on some values.

        It runs here if all workers are busy, if no processor is free for them, or if that is asked for, as
        where nothing else is left to be done.
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
        """Yield the results that are there, and wait while there are more than ``most`` others.

        The arrays of a result are valid until the next one is asked for, or more is added.
        """
        while self._results:
            result, workers = self._results[0], self._workers
            if result is None and workers is not None:
                if not workers.ready and (most is None or len(self._results) <= most):
                    return
                result = (workers.take(),)
            del self._results[0]
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
        EOFError: likewise.
    """
    size = int.from_bytes(_received(link, _LENGTH_BYTES), "big")
    return pickle.loads(_received(link, size))  # noqa: S301  from our own process


def _received(link: socket.socket, size: int) -> bytes:
    """Return so many bytes; where the process is stopped and goes on (Ctrl-Z), they come in parts."""
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
