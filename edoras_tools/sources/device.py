"""What all live sources share: a thread that empties a device into a bounded queue, and the batches from it.

A sink that stalls (a slow disk, a terminal) costs memory and not datagrams. When the queue is full the
thread leaves the device alone, the kernel's own buffer fills, and the kernel counts what it drops: there is
one place where frames can be lost, and it has a counter.
"""

from __future__ import annotations

import queue
import select
import socket
import threading
import time
from typing import TYPE_CHECKING, Protocol

import numpy as np

from edoras_tools.errors import CaptureError
from edoras_tools.model import PacketBatch, SourceStatistics
from edoras_tools.sources.framing import PADDING
from edoras_tools.sources.linklayer import Demux

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from edoras_tools.model import SourceInfo
    from edoras_tools.sources.linklayer import FrameBatch

_DRAIN_S = 0.5
"""How long after ``stop`` the device may take to give up what it holds,"""
_DRAIN_TURNS = 500
"""and how often it is asked at least: a machine that stood still for so long cuts nothing off."""


class Device(Protocol):
    """Something that frames come out of, bound and receiving.

    Attributes:
        info: what the source is.
        drops: frames that the kernel lost, as of the last ``count``.
        linger_s: how long to let frames gather once there is one; 0 where the device itself gathers them.
    """

    info: SourceInfo
    drops: int
    linger_s: float

    def filenos(self) -> tuple[int, ...]:
        """Return the file descriptors that become readable when frames are there."""

    def read(self) -> FrameBatch | None:
        """Return what is there, a few MiB at most, None when there is nothing; never wait."""

    def count(self) -> None:
        """Bring ``drops`` up to date."""

    def refuse(self) -> None:
        """Let nothing more in, where that can be done."""

    def drained(self) -> bool:
        """Tell whether everything that came in has been read."""

    def failure(self) -> str | None:
        """Return why nothing more will come, None while all is well."""

    def close(self) -> None:
        """Give everything back."""


class DeviceSource:
    """A ``Source`` over a ``Device``.

    Reading starts with construction: nothing that arrives after it is missed silently.

    Args:
        device: taken over, and closed by ``close``.
        ready: called once when ``batches`` starts.
        idle_s: with no traffic, an empty batch is handed over this often: sinks flush, displays refresh.
        queue_bytes: what may wait for a slow consumer.

    Attributes:
        info: what the source is.
        statistics: what it counted so far.
        started: set when ``batches`` starts.
    """

    def __init__(
        self,
        device: Device,
        *,
        ready: Callable[[], None] | None = None,
        idle_s: float = 0.1,
        queue_bytes: int = 128 << 20,
    ) -> None:
        self.info = device.info
        self.statistics = SourceStatistics()
        self.started = threading.Event()
        self._device = device
        self._ready = ready
        self._idle_s = idle_s
        self._queue_bytes = queue_bytes
        self._demux = Demux()
        # None ends the queue, an exception ends it badly. A SimpleQueue may be used in signal handlers.
        self._queue: queue.SimpleQueue[FrameBatch | BaseException | None] = queue.SimpleQueue()
        self._queued = 0  # written by the thread only
        self._taken = 0  # written by the consumer only
        self._room = threading.Event()
        self._stopping = False
        self._deadline = 0.0  # once stopping: until when the device may take
        self._turns = 0  # and how often it was asked since
        self._closed = False
        self._wake, self._waker = socket.socketpair()
        self._waker.setblocking(False)
        self._thread = threading.Thread(target=self._run, name=f"capture {self.info.name}", daemon=True)
        self._thread.start()

    def batches(self) -> Iterator[PacketBatch]:
        """Hand over what arrived since the last hand-over, until ``stop`` or until the device fails.

        Raises:
            CaptureError: the device failed; everything it gave has been handed over.
        """
        self.started.set()
        if self._ready is not None:
            self._ready()
        nothing = _nothing()
        while True:
            try:
                item = self._queue.get(timeout=self._idle_s)
            except queue.Empty:
                self.statistics.kernel_drops = self._device.drops
                yield nothing
                continue
            self.statistics.kernel_drops = self._device.drops
            if item is None:
                return
            if isinstance(item, BaseException):
                raise item
            self._taken += item.data.size
            self._room.set()
            yield self._hand_over(item)

    def stop(self) -> None:
        """End ``batches`` after what has arrived; for any thread or signal handler, as often as you like."""
        self._stopping = True
        try:
            self._waker.send(b"\0")
        except OSError:  # full: it wakes anyway; closed: nothing to wake
            return

    def close(self) -> None:
        """Give the device back, whatever is still in it."""
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

    def _hand_over(self, frames: FrameBatch) -> PacketBatch:
        """Demux a batch and bring the statistics up to date."""
        batch = self._demux.demux(frames)
        statistics = self.statistics
        statistics.frames += len(frames)
        statistics.bytes += int(frames.length.sum())
        statistics.datagrams += len(batch)
        statistics.skipped = self._demux.skipped
        return batch

    def _run(self) -> None:
        """Empty the device until told to stop; the thread's life."""
        try:
            self._read()
        except BaseException as error:  # noqa: BLE001  whatever it is belongs to the thread that consumes
            self._queue.put(error)
        else:
            self._queue.put(None)

    def _read(self) -> None:
        device = self._device
        poll = select.poll()
        for fileno in (*device.filenos(), self._wake.fileno()):
            poll.register(fileno, select.POLLIN)
        failure = None
        while not self._closed:
            if (self._stopping or failure) and not self._deadline:
                device.refuse()
                self._deadline = time.monotonic() + _DRAIN_S
                poll.unregister(self._wake.fileno())
            more = self._drain()
            device.count()
            failure = failure or device.failure()
            if self._deadline and (device.drained() or self._late()):
                break
            if not more and (self._deadline or not failure):
                poll.poll(5 if self._deadline else 100)
                time.sleep(0 if self._deadline else device.linger_s)
        if failure:
            raise CaptureError(failure)

    def _drain(self) -> bool:
        """Queue what the device holds; return whether there may be more, something else being due."""
        while (frames := self._device.read()) is not None:
            self._queued += frames.data.size
            self._queue.put(frames)
            self._wait_for_room()
            if self._closed or self._late() or (self._stopping and not self._deadline):
                return True
        return False

    def _wait_for_room(self) -> None:
        """Wait while the queue is full; the time that takes is the consumer's and not the device's."""
        while self._queued - self._taken > self._queue_bytes and not self._closed:
            self._room.wait(self._idle_s)
            self._room.clear()
            if self._deadline:
                self._deadline = time.monotonic() + _DRAIN_S

    def _late(self) -> bool:
        """Tell whether the device has had its time, and its turns, to give up what it holds."""
        if not self._deadline:
            return False
        self._turns += 1
        return self._turns > _DRAIN_TURNS and time.monotonic() > self._deadline


def _nothing() -> PacketBatch:
    """Return a batch of no datagrams."""
    wide, narrow = np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int32)
    address, port = np.empty(0, dtype=np.uint32), np.empty(0, dtype=np.uint16)
    return PacketBatch(
        data=np.zeros(PADDING, dtype=np.uint8),
        number=wide,
        time_ns=wide,
        link_type=port,
        frame_offset=wide,
        frame_length=narrow,
        original_length=narrow,
        offset=wide,
        length=narrow,
        source_address=address,
        source_port=port,
        destination_address=address,
        destination_port=port,
        ip_version=np.empty(0, dtype=np.uint8),
        capture_findings=address,
    )
