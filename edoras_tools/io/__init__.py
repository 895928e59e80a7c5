"""Where datagrams come from and where they go: files, live capture, sockets, recordings.

A ``Source`` yields packet batches, a ``Sink`` writes them. What not every one of them can do has a default
here, so that nobody asks for the class of one: a source is made from :class:`SourceDefaults`, or from
:class:`SourceOver` where it changes what another one yields; a sink from :class:`Sink`.
"""

from __future__ import annotations

from operator import attrgetter
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from edoras_tools.links.framing import Framing
    from edoras_tools.model import Columns, HostCounters, PacketBatch, SourceInfo, SourceStatistics
    from edoras_tools.sessions.faults.fault import Fault

    Room = Callable[[int], NDArray[np.uint8]]
    """Returns memory of a size, u8."""
    Choice = Callable[[NDArray[np.uint8], NDArray[np.int32]], NDArray[np.bool_]]
    """Tells which datagrams are chosen, by the link and the MsgId of each."""

__all__ = ["Sink", "Source", "SourceDefaults", "SourceOver"]


class SourceDefaults(Protocol):
    """What a source can do besides being read, and is: the defaults are those of a file of frames."""

    @property
    def live(self) -> bool:
        """Whether it has no end of its own: ``stop`` ends it."""
        return False

    @property
    def on_this_host(self) -> bool:
        """Whether it captures on this host now: the times are this clock's, the drops this kernel's."""
        return False

    @property
    def part(self) -> int:
        """Number of the clock of the last batch; the order of events of two clocks is not known."""
        return 0

    @property
    def section(self) -> int:
        """How often all files that had begun before the last batch had ended before it."""
        return 0

    @property
    def header(self) -> Mapping[str, Any]:
        """The header of a file of cFE; else empty."""
        return {}

    def stop(self) -> None:
        """Let a live source's batches end after what has arrived; for any thread or signal handler."""
        self.discard()

    def discard(self) -> int:
        """Let a live source's batches end at once; return how many frames had arrived and are not yielded."""
        return 0

    def pace(self, gather_s: float, idle_s: float) -> None:
        """Set the least time between two batches of a live source, and the most, where nothing arrives."""
        del gather_s, idle_s

    def follow(self, framings: Mapping[int, Framing]) -> None:
        """Read the TCP streams of these ports, and no others; without it, of the links' usual ports.

        Call it before the first batch.
        """
        del framings

    def narrow(self, period: Callable[[int], tuple[int, int]]) -> None:
        """Take note that only datagrams of a time are asked for: a source with an index may pass over others.

        All of that time come, in their order; the first datagram of all, and the last, too. Call it before
        the first batch.

        Args:
            period: takes the time of the first datagram, ns since 1970; returns the first time that is asked
                for, and the one after the last.
        """
        del period

    def choose(self, choice: Choice) -> None:
        """Take note of which datagrams are asked for: a recording that knows may pass over others.

        Those of no link come too, the first of all, the earliest, the latest, and the first of each endpoint
        that has an identity. Call it before the first batch.

        Args:
            choice: takes links and MsgIds.
        """
        del choice

    def published(self, number: NDArray[np.int64]) -> NDArray[np.int64] | None:
        """Return publish times of datagrams of the last batch, if others that they need were passed over."""
        return None

    @property
    def files(self) -> Sequence[str]:
        """The names of the files that are read as one; none of one file."""
        return ()

    def origin(self, number: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the place in ``files`` of what datagrams of the last batch are from; 0 of one file."""
        return number * 0

    def borrow(self, room: Room) -> None:
        """Read into memory from ``room(size)``, if that saves copying it.

        ``room`` must not return memory that batches still use, or that it returned last.
        """
        del room

    def decoded(self, batch: PacketBatch, decode: Callable[[PacketBatch], Columns]) -> Columns:
        """Return the columns of the batch that was yielded last, by ``decode`` if they are not there yet."""
        return decode(batch)

    def recorder_counts(self) -> str:
        """Return what its recorder counted, as JSON, of a recording that is just as it was completed."""
        return ""

    def faults(self) -> list[Fault]:
        """Return the faults that a proxy or a replay injected, of a recording that has them."""
        return []

    def host(self) -> list[HostCounters]:
        """Return what the kernel of the recording host counted, of a recording that has it."""
        return []


class Source(SourceDefaults, Protocol):
    """Yields datagrams, one batch at a time."""

    @property
    def info(self) -> SourceInfo:
        """Information on the source."""
        ...

    @property
    def statistics(self) -> SourceStatistics:
        """The counts so far; the same object each time."""
        ...

    def batches(self) -> Iterator[PacketBatch]:
        """Yield all datagrams, once.

        Raises:
            CaptureError: the input is damaged; raised after everything that could be read.
        """
        ...

    def close(self) -> None:
        """Close files and sockets; may be called at any time, and twice."""


class SourceOver(SourceDefaults):
    """A source over another one: all that it does not change is the other's."""

    def __init__(self, source: Source) -> None:
        self._source = source

    @property
    def info(self) -> SourceInfo:
        """Information on the other."""
        return self._source.info

    @property
    def statistics(self) -> SourceStatistics:
        """The other's counts."""
        return self._source.statistics

    def close(self) -> None:
        """Close the other."""
        self._source.close()


for _name in (name for name in vars(SourceDefaults) if not name.startswith("_")):
    setattr(SourceOver, _name, property(attrgetter(f"_source.{_name}")))


class Sink(Protocol):
    """The interface of every sink."""

    @property
    def room(self) -> Room | None:
        """Returns memory for a source to read into, if that saves copying it; see ``Source.borrow``."""
        return None

    def write(self, batch: PacketBatch, columns: Columns) -> None:
        """Write a batch and its columns; the caller must not change them afterwards.

        Raises:
            CaptureError: the output cannot be written.
        """

    def write_faults(self, faults: Sequence[Fault]) -> None:
        """Write injected faults, with times in ns since 1970, if the format stores them."""
        del faults

    def write_host(self, host: HostCounters) -> None:
        """Write what the kernel of this host counts now, if the format stores it."""
        del host

    def flush(self) -> None:
        """Write everything received so far to the file; called at least once a second when live.

        Raises:
            CaptureError: the output cannot be written.
        """

    def cut_short(self, *, empty: bool) -> None:
        """Take note, before ``close``, that the input did not come to its end; ``empty``: nothing came."""
        del empty

    def close(self, statistics: SourceStatistics) -> None:
        """Complete the output and close it; closing twice does nothing.

        Args:
            statistics: the source's counts, for formats that can store them.

        Raises:
            CaptureError: the output cannot be written.
        """


class DisplaySink(Sink, Protocol):
    """A sink that clients watch over a network."""

    @property
    def addresses(self) -> tuple[str, str]:
        """What a browser opens: Foxglove's application, and our own page."""
        ...

    def summary(self) -> dict[str, Any]:
        """Return what clients were sent, in the form of ``foxglove`` in ``live --json``."""
        ...
