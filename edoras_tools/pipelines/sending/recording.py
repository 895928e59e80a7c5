"""A recording of sent and received datagrams.

Rules:

1. A datagram is in the file ``FLUSH_NS`` after it was sent or received, however busy the sending is: a killed
   run loses at most one second. ``receive`` ensures this; the sending loop calls it every 20 ms.
2. From half of that time on, waiting datagrams are written as soon as nothing is due for ``_CALM_NS``: then
   writing delays no datagram.
3. The time of a received datagram is when it was read.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from edoras_tools.io.frames.frame_batch import frames_of
from edoras_tools.io.frames.linklayer import Demux
from edoras_tools.model import Endpoint, SourceInfo, SourceStatistics
from edoras_tools.pipelines.capture.record import FLUSH_NS, Target, open_sink
from edoras_tools.pipelines.recorder import PushedSource
from edoras_tools.units import MILLISECOND

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.io.formats.watched import OutputLoss
    from edoras_tools.io.net.transmit import Arrival, SendStatistics, Wire
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.sessions.faults.kinds import Fault
    from edoras_tools.sessions.outgoing import Outgoing

_CALM_NS: Final = 10 * MILLISECOND
"""Quiet time in which a block is written; the sending loop never waits longer than 20 ms."""
_BLOCK: Final = 256
"""Datagrams written at once, which takes a few ms."""
_MOST: Final = 200_000
"""Waiting datagrams from which all are written at once, even if this delays others."""


class SentRecording:
    """A wire that records its traffic.

    Args:
        wire: the wire.
        target: output of the recording.
        bench: mission, types and decoders.

    Raises:
        CaptureError: the recording cannot be written.
    """

    def __init__(self, wire: Wire, target: Target, bench: Workbench) -> None:
        self.now, self.ends = wire.now, wire.ends
        self._wire, self._bench = wire, bench
        self._source = PushedSource(SourceInfo(f"sent to {wire.ends[1]}", "replay"), SourceStatistics())
        self._sink = open_sink(target, self._source, bench)
        self._demux = Demux()
        self._waiting: list[tuple[int, Endpoint, Endpoint, bytes]] = []
        self._faults: list[Fault] = []
        self._epoch_ns = wire.epoch_ns()
        self._written_ns = wire.now()

    @property
    def losses(self) -> Sequence[OutputLoss]:
        """Outputs that were removed during writing."""
        return self._sink.losses

    @property
    def statistics(self) -> SendStatistics:
        """Counters of the datagrams."""
        return self._wire.statistics

    def epoch_ns(self) -> int:
        """Return the difference between ns since 1970 and the wire's time."""
        return self._epoch_ns

    def wait(self, until_ns: int) -> bool:
        """Wait, and use the time for writing if it is long enough."""
        while until_ns - (now := self.now()) >= _CALM_NS and now - self._written_ns >= FLUSH_NS // 2:
            self._write(_BLOCK)
        return self._wire.wait(until_ns)

    def send(self, out: Outgoing, first: int, last: int) -> int:
        """Send datagrams ``first`` up to ``last``, not included; return the number that left."""
        now = self.now()
        sent = self._wire.send(out, first, last)
        for index in range(first, last):
            self._keep(now, *self.ends, out[index])
        return sent

    def put(self, payload: bytes) -> bool:
        """Send one datagram of the caller's own; return whether it left."""
        self._keep(self.now(), *self.ends, payload)
        return self._wire.put(payload)

    def receive(self) -> list[Arrival]:
        """Return the arrived datagrams, and write those that have waited long enough."""
        arrived = self._wire.receive()
        now = self.now()
        for item in arrived:
            self._keep(now, item.source, item.destination, item.payload)
        if now - self._written_ns >= FLUSH_NS:
            self._write(_MOST)
        return arrived

    def note(self, faults: Sequence[Fault]) -> None:
        """Record injected faults."""
        self._faults += faults

    def close(self) -> None:
        """Write the rest, and complete the recording.

        Raises:
            CaptureError: the recording cannot be written.
        """
        try:
            while self._waiting or self._faults:
                self._write(_MOST)
        finally:
            self._sink.close(self._source.statistics)

    def _keep(self, now: int, source: Endpoint, destination: Endpoint, payload: bytes) -> None:
        self._waiting.append((now + self._epoch_ns, source, destination, payload))
        if len(self._waiting) >= _MOST:
            self._write(_MOST)

    def _write(self, most: int) -> None:
        rows, self._waiting = self._waiting[:most], self._waiting[most:]
        if rows:
            frames = frames_of(rows, self._source.statistics.frames + 1)
            batch = self._demux.demux(frames)
            self._sink.write(batch, self._bench.columns.decode(batch))
            self._source.statistics.frames += len(frames)
            self._source.statistics.datagrams += len(batch)
        if self._faults:
            self._sink.write_faults(self._faults)
        self._faults = []
        self._sink.flush()
        if not self._waiting:
            self._written_ns = self.now()
