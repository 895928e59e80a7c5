"""The part that all live sources share: a thread reads a device into a bounded queue; batches come from it.

If a sink stalls (a slow disk, a terminal), this costs memory and no datagrams. When the queue is full, the
thread stops reading, the kernel's own buffer fills, and the kernel counts what it drops: there is one place
where frames can be lost, and it has a counter.

Also the network interfaces: which there are, and whether one may capture from them.
"""

from __future__ import annotations

import contextlib
import ctypes
import math
import os
import queue
import select
import socket
import struct
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import TYPE_CHECKING, Final

import msgspec
from msgspec.structs import replace

from edoras_tools.errors import CaptureError
from edoras_tools.io.frames.frame_batch import FrameBatch, FramePage, joined_frames
from edoras_tools.io.frames.linklayer import FrameSource, demux
from edoras_tools.model import InterfaceOutage, PacketBatch, SourceInfo, SourceStatistics

if TYPE_CHECKING:
    from types import EllipsisType

ANY_INTERFACE: Final = "any"
"""The name that means every interface."""

_SIOCGIFFLAGS: Final = 0x8913
_SIOCGIFHWADDR: Final = 0x8927
_IFF_UP: Final = 1 << 0
_IFF_LOOPBACK: Final = 1 << 3
_IFF_RUNNING: Final = 1 << 6
_NAME_LENGTH: Final = 16  # IFNAMSIZ


class Interface(msgspec.Struct, frozen=True):
    """One interface, or all of them.

    Attributes:
        name: the system's name, or ``any``.
        index: number of the interface; 0 for ``any``.
        hardware_type: ARPHRD number, which says how its frames start.
        up: whether it is up.
        loopback: whether what it sends comes in again.
        carrier: whether it has a carrier, as far as the system knows.
    """

    name: str
    index: int
    hardware_type: int
    up: bool
    loopback: bool
    carrier: bool = True


def interfaces() -> tuple[str, ...]:
    """Return the names of the interfaces, without ``any``."""
    return tuple(name for _, name in socket.if_nameindex())


def find_interface(name: str) -> Interface:
    """Look an interface up.

    Raises:
        CaptureError: there is no interface of that name; the message lists all names.
    """
    if name == ANY_INTERFACE:
        return Interface(name, index=0, hardware_type=-1, up=True, loopback=False)
    try:
        index, flags = socket.if_nametoindex(name), _ask(name, _SIOCGIFFLAGS)
        return Interface(
            name,
            index,
            hardware_type=_ask(name, _SIOCGIFHWADDR),
            up=bool(flags & _IFF_UP),
            loopback=bool(flags & _IFF_LOOPBACK),
            carrier=bool(flags & _IFF_RUNNING),
        )
    except (OSError, ValueError):
        raise missing_interface(name) from None


def possible(name: str) -> bool:
    """Return whether an interface may have that name (the kernel's ``dev_valid_name``)."""
    short = 0 < len(name.encode(errors="surrogateescape")) < _NAME_LENGTH
    return short and name not in {".", ".."} and not any(char in "/:" or char.isspace() for char in name)


def missing_interface(name: str) -> CaptureError:
    """Return the error for an interface that does not exist."""
    return CaptureError(f"{name}: no such interface; there are {', '.join((*interfaces(), ANY_INTERFACE))}")


def loopback_index() -> int | None:
    """Return the index of the loopback interface, or None."""
    for name in interfaces():
        with contextlib.suppress(CaptureError):  # an interface may go away while they are listed
            interface = find_interface(name)
            if interface.loopback:
                return interface.index
    return None


def _ask(name: str, request: int) -> int:
    """Return the 16-bit answer of an interface ``ioctl`` (``struct ifreq``)."""
    import fcntl

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        answer = fcntl.ioctl(any_socket, request, struct.pack("256s", name.encode()[: _NAME_LENGTH - 1]))
    return int(struct.unpack_from("=H", answer, _NAME_LENGTH)[0])


_CAP_NET_RAW: Final = 13
_CAPABILITY_VERSION: Final = 0x20080522
"""``_LINUX_CAPABILITY_VERSION_3``: header (version, process); effective, permitted, inheritable, twice."""


def claim_raw_sockets() -> None:
    """Let this thread open raw sockets, if the process is permitted to: CAP_NET_RAW becomes effective.

    A file capability that is only permitted (``cap_net_raw+p``) does not keep the program from starting in a
    container that lacks it, as an effective one (``+ep``) does; but the program has to ask for it.
    """
    header = (ctypes.c_uint32 * 2)(_CAPABILITY_VERSION, 0)
    values = (ctypes.c_uint32 * 6)()
    system = ctypes.CDLL(None)
    if system.capget(header, values) == 0:
        values[0] |= values[1] & 1 << _CAP_NET_RAW
        system.capset(header, values)


def denied(name: str) -> CaptureError:
    """Return the error for an interface that may not be opened."""
    return CaptureError(
        f"{name}: capturing needs CAP_NET_RAW: run it with sudo; "
        f"or once 'sudo setcap cap_net_raw+p {os.path.realpath(sys.executable)}'; "
        "or 'docker run --cap-add NET_RAW'; "
        "or receive the datagrams on a UDP socket with --listen, which needs no privilege"
    )


_AT_ONCE = 4 << 20
"""Maximum bytes of one batch, or one read of the device if that is more."""
_GATHER_S = 0.06
_LEAD_S = 0.05
"""Longest time before a batch is due at which the device is read: it may first wait for the kernel."""
_STEP_S = 0.1
"""How long ``discard`` waits for the thread at a time."""
_CHECK_S = 0.2
"""Longest time between two checks of whether the device can hold more, while frames gather in it."""
_SILENCE_S = 0.1
"""Time without frames after which the next frame ends a silence."""
_SOON_S = 0.005
"""Longest time that the first frame after a silence waits for others."""
_FEW = 4 << 10
"""Bytes below which a read is small: the next batch gathers from its first frame on, so batches are fewer."""
_DRAIN_S = 0.5
"""Time after ``stop`` in which the device delivers what it holds."""
_DRAIN_TURNS = 500
"""Reads after ``stop`` that are always made, so that a machine that stalls that long loses nothing."""


class Device(ABC):
    """A source of frames that is bound and receiving.

    Attributes:
        info: information on the source.
        drops: number of frames that the kernel lost, as of the last ``count``.
        linger_s: how long frames may gather after the first one, except after a silence; at most until a
            batch is due.
        look_s: how often to read even if no file descriptor is readable.
        outages: when an interface was away.
    """

    info: SourceInfo

    def __init__(self, linger_s: float, look_s: float) -> None:
        self.drops = 0
        self.linger_s = linger_s
        self.look_s = look_s
        self.outages: list[InterfaceOutage] = []

    @abstractmethod
    def filenos(self) -> tuple[int, ...]:
        """Return the file descriptors that become readable when frames have arrived."""

    @abstractmethod
    def read(self) -> FrameBatch | None:
        """Return the frames that have arrived, a few MiB at most; None if there are none; never wait."""

    @abstractmethod
    def count(self) -> None:
        """Update ``drops``."""

    def pressed(self) -> bool:
        """Return whether to read now, even if frames may gather for longer."""
        return False

    @abstractmethod
    def refuse(self) -> None:
        """Drop every packet from now on, if possible."""

    def drained(self) -> bool:
        """Return whether everything that came in has been read: after a read that found nothing, it has."""
        return True

    def failure(self) -> str | None:
        """Return why no more frames will come, or None."""
        return None

    @abstractmethod
    def close(self) -> None:
        """Release everything."""


class DeviceSource(FrameSource):
    """A ``Source`` over a ``Device``.

    Reading starts in the constructor: nothing that arrives afterwards is missed without being counted.

    Args:
        device: is closed by ``close``.
        ready: called once, when ``batches`` starts or its interface is there for the first time.
        on_outage: called by ``batches`` for every interface that goes away, and again when it is back.
        queue_bytes: maximum bytes that wait for a slow consumer.

    Attributes:
        info: information on the source.
        statistics: the counts so far.
        started: set when ``batches`` starts.
        idle_s: without traffic, an empty batch is yielded this often, or every ``gather_s`` if that is
            longer, so that sinks flush and displays refresh.
        gather_s: minimum time between two batches, unless a few MiB wait: a batch of one datagram costs as
            much as one of a thousand. The first frames after a silence do not wait. The device is read when
            a batch is due, and more often if it cannot hold that much.
    """

    live = on_this_host = True

    def __init__(
        self,
        device: Device,
        *,
        ready: Callable[[], None] | None = None,
        on_outage: Callable[[InterfaceOutage], None] | None = None,
        idle_s: float = 0.1,
        queue_bytes: int = 128 << 20,
    ) -> None:
        super().__init__(SourceStatistics(outages=device.outages))
        self._info = device.info
        self.started = threading.Event()
        self.gather_s = _GATHER_S
        self._handed = -math.inf  # not 0: a monotonic clock may begin there
        self._device = device
        self._ready = ready
        self._on_outage = on_outage
        self._news = 0
        self.idle_s = idle_s
        self._queue_bytes = queue_bytes
        # None ends the queue, an exception ends it with an error. Signal handlers may use a SimpleQueue.
        self._queue: queue.SimpleQueue[FrameBatch | BaseException | None] = queue.SimpleQueue()
        self._queued = 0  # written by the thread only
        self._taken = 0  # written by the consumer only
        self._room = threading.Event()
        # Gets an item when frames are to stop gathering.
        self._enough: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._stopping = False
        self._deadline = 0.0  # while stopping: when to stop reading the device
        self._turns = 0  # and how often it was read since
        self._closed = False
        self._wake, self._waker = socket.socketpair()
        self._waker.setblocking(False)
        self._thread = threading.Thread(target=self._run, name=f"capture {self.info.name}", daemon=True)
        self._thread.start()

    def _batches(self) -> Iterator[PacketBatch]:
        """Yield what arrived since the last batch, until ``stop`` or until the device fails.

        Raises:
            CaptureError: the device failed; everything that it delivered has been yielded.
        """
        self.started.set()
        nothing = demux(FramePage().frames(1))
        while True:
            self._report_outages()
            if self._ready is not None and (not self._device.outages or self._device.outages[0].end_ns):
                self._ready()
                self._ready = None
            frames, end = self._waiting()
            self.statistics.kernel_drops = self._device.drops
            if frames:
                self._handed = time.monotonic()
                yield self._demuxed(joined_frames(frames) if len(frames) > 1 else frames[0])
            elif end is ...:
                yield nothing
            if end is not ...:
                yield from self._rest()
            if isinstance(end, BaseException):
                raise end
            if end is None:
                return

    def pace(self, gather_s: float, idle_s: float) -> None:
        """Set ``gather_s`` and ``idle_s``."""
        self.gather_s, self.idle_s = gather_s, idle_s

    def _due_s(self) -> float:
        """Return the seconds until a batch is due; 0 or less: it is due now."""
        return self._handed + self.gather_s - time.monotonic()

    def _gather(self) -> None:
        """Let frames gather after the last batch."""
        while not self._stopping and self._queued - self._taken < _AT_ONCE:
            wait_s = self._due_s()
            if wait_s <= 0:
                return
            with suppress(queue.Empty):
                self._enough.get(timeout=wait_s)

    def _waiting(self) -> tuple[list[FrameBatch], BaseException | EllipsisType | None]:
        """Take what waits, at most a few MiB: large batches cost less, so a slow consumer can catch up.

        Returns:
            The frames, and what ended the queue; an ellipsis if it has not ended.
        """
        batches: list[FrameBatch] = []
        size = 0
        idle_s = max(self.idle_s, self.gather_s)
        while size < _AT_ONCE:
            try:
                item = self._queue.get_nowait() if batches else self._queue.get(timeout=idle_s)
            except queue.Empty:
                break
            if item is None or isinstance(item, BaseException):
                return batches, item
            if not batches:
                self._gather()
            batches.append(item)
            size += item.data.size
            self._taken += item.data.size
            self._room.set()
        return batches, ...

    def stop(self) -> None:
        """End ``batches`` after what has arrived; for any thread or signal handler, any number of times."""
        self._stopping = True
        self._enough.put(None)
        try:
            self._waker.send(b"\0")
        except OSError:  # full: it wakes up anyway; closed: nothing to wake up
            return

    def discard(self) -> int:
        """End ``batches`` at once; return how many frames had arrived and were not yielded."""
        self.stop()
        count = 0
        while self._thread.is_alive() or not self._queue.empty():
            with suppress(queue.Empty):
                item = self._queue.get(timeout=_STEP_S)
                if not (item is None or isinstance(item, BaseException)):
                    count += len(item)
                    self._taken += item.data.size
                    self._room.set()
        return count

    def close(self) -> None:
        """Close the device; what it still holds is discarded."""
        if self._closed:
            return
        self._closed = True
        self.stop()
        self._room.set()
        self._thread.join()
        self.statistics.kernel_drops = self._device.drops
        self._device.close()
        self._wake.close()
        self._waker.close()

    def _report_outages(self) -> None:
        """Report interface outages; each is reported when it begins and when it ends."""
        outages = tuple(self.statistics.outages)
        count = sum(2 if outage.end_ns else 1 for outage in outages[self._news // 2 :])
        if self._on_outage is None or count == self._news % 2:
            return
        for number in range(self._news, self._news // 2 * 2 + count):
            outage = outages[number // 2]
            self._on_outage(outage if number % 2 else replace(outage, end_ns=0))
            self._news += 1

    def _run(self) -> None:
        """Read the device until stopped; the thread's function."""
        try:
            self._read()
        except BaseException as error:  # noqa: BLE001  raised in the consumer's thread
            self._queue.put(error)
        else:
            self._queue.put(None)

    def _read(self) -> None:
        device = self._device
        poll = select.poll()
        for fileno in (*device.filenos(), self._wake.fileno()):
            poll.register(fileno, select.POLLIN)
        pause = select.poll()
        pause.register(self._wake.fileno(), select.POLLIN)
        failure = None
        came = 0.0
        while not self._closed:
            if (self._stopping or failure) and not self._deadline:
                device.refuse()
                self._deadline = time.monotonic() + _DRAIN_S
                poll.unregister(self._wake.fileno())
            before = self._queued
            device.count()  # before what is read wakes the consumer
            more = self._drain()
            if self._queued > before:
                came = time.monotonic()
            failure = failure or device.failure()
            if self._deadline and (device.drained() or self._late()):
                break
            if not more and (self._deadline or not failure):
                few = self._queued - before < _FEW and device.look_s > self.gather_s
                self._linger(poll, pause, came, few=few)
        if failure:
            raise CaptureError(failure)

    def _linger(self, poll: select.poll, pause: select.poll, came: float, *, few: bool) -> None:
        """Wait for datagrams, then let more of them gather.

        Args:
            poll: the device's file descriptors, and the one that wakes the reader.
            pause: the file descriptor that wakes the reader.
            came: monotonic time in s at which the last datagram was read.
            few: the last read was small: fewer than ``_FEW`` bytes.
        """
        device = self._device
        silent = time.monotonic() - came > _SILENCE_S
        # A device that can hold much needs no wait for a first frame: more come before the batch is due.
        ready: object = not silent and not few and device.linger_s > _SOON_S
        if not ready or self._deadline:
            ready = poll.poll(5 if self._deadline else 1000 * max(device.look_s, self.gather_s / 3))
            silent = time.monotonic() - came > _SILENCE_S
        longest_s = _SOON_S if silent else self.gather_s if few else self._until_read_s()
        left_s = min(device.linger_s, longest_s)
        if self._deadline or (silent and not ready):
            return
        while left_s > 0 and not pause.poll(1000 * min(left_s, _CHECK_S)):
            left_s -= _CHECK_S
            if left_s > 0 and device.pressed():
                break

    def _until_read_s(self) -> float:
        """Return the seconds until the device is read for the next batch, shortly before that batch is due.

        If that is less than half of ``gather_s`` from now, the read is one batch later. The consumer decodes
        soon after the read, so that each thread wakes up once a batch.
        """
        read_s = max(self._due_s(), 0) - min(_LEAD_S, self.gather_s / 4)
        return read_s if read_s > self.gather_s / 2 else read_s + self.gather_s

    def _drain(self) -> bool:
        """Queue what the device holds; return whether to continue at once, because there may be more."""
        while (frames := self._device.read()) is not None:
            self._queued += frames.data.size
            self._queue.put(frames)
            if self._queued - self._taken >= _AT_ONCE and self._enough.empty():
                self._enough.put(None)
            self._wait_for_room()
            if self._closed or self._late() or (self._stopping and not self._deadline):
                return True
        return False

    def _wait_for_room(self) -> None:
        """Wait while the queue is full; this time does not count for the device's deadline."""
        while self._queued - self._taken > self._queue_bytes and not self._closed:
            self._room.wait(self.idle_s)
            self._room.clear()
            if self._deadline:
                self._deadline = time.monotonic() + _DRAIN_S

    def _late(self) -> bool:
        """Return whether the device has had enough time, and reads, to deliver what it holds."""
        if not self._deadline:
            return False
        self._turns += 1
        return self._turns > _DRAIN_TURNS and time.monotonic() > self._deadline
