"""Where datagrams come from and where they go: files, live capture, sockets, recordings.

A ``Source`` yields packet batches, a ``Sink`` writes them. Methods that only some of them implement have a
default here, so that callers need not ask for a class: a source derives from :class:`SourceDefaults`, or from
:class:`SourceOver` where it changes what another source yields; a sink derives from :class:`Sink`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Protocol

import msgspec

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from edoras_tools.links.doors import Endpoints, Framing
    from edoras_tools.model import Columns, HostCounters, PacketBatch, SourceInfo, SourceStatistics
    from edoras_tools.sessions.faults.rules import Fault
    from edoras_tools.sessions.sequence import SequenceCounts
    from edoras_tools.structs import Structs
    from edoras_tools.wire.arrays import Integers, Mask, Octets

    Room = Callable[[int], Octets]
    """Returns memory of a given size in bytes, u8."""
    Choice = Callable[[Octets, NDArray[np.int32]], Mask]
    """Returns which datagrams are needed, from the link and the MsgId of each."""

__all__ = ["RecordingOptions", "Sink", "Source", "SourceDefaults", "SourceOver"]


class RecordingOptions(msgspec.Struct, frozen=True):
    """Contents of a recording, and when a new file starts.

    Attributes:
        filter: expression that selected the datagrams, for the metadata record.
        split_bytes: approximate size of a file at which a new one starts; 0: never.
        split_ns: capture time in one file at which a new one starts; 0: never.
        split_count: number of datagrams in one file after which a new one starts; 0: never.
        datagrams: whether to write ``/edoras/datagrams``.
        structs: C structs in packets; None: only cFE's own.
        transforms: whether to write ``/tf``, made from the poses.
        jobs: most processes that share the work; more than one only for MCAP that is not split by size.
        yields: whether to share the work only while a processor is free, for the sake of other recorders.
        sequences: sequence counts shared with other consumers of the same batches; None: own ones.
        endpoints: DDS endpoints discovered so far; None: DDS samples have no topics.
        topics: of a recording without datagrams: numbers of the topics to write; None: all.
        offered: quality of service of every topic, as the YAML of ``ros2 bag``; empty if unknown.
        apart: a ``pipelines.reading.Independence``, which takes all batches; None: not recorded.
    """

    filter: str = ""
    split_bytes: int = 0
    split_ns: int = 0
    split_count: int = 0
    datagrams: bool = True
    structs: Structs | None = None
    offered: str = ""
    transforms: bool = False
    jobs: int = 1
    yields: bool = False
    sequences: SequenceCounts | None = None
    endpoints: Endpoints | None = None
    topics: Collection[int] | None = None
    apart: Any = None

    @property
    def splits(self) -> bool:
        """Whether the recording is written in parts."""
        return bool(self.split_bytes or self.split_ns or self.split_count)


class SourceDefaults(Protocol):
    """Properties and methods of a source besides reading; the defaults are those of a file of frames."""

    @property
    def live(self) -> bool:
        """Whether the source has no end of its own: only ``stop`` ends it."""
        return False

    on_this_host: bool = False
    """Whether the source captures on this host now: times and drops are those of this host."""
    part: int = 0
    """Number of the clock of the last batch; the order of events of two different clocks is unknown."""
    section: int = 0
    """Number of breaks before the last batch: times at which every file begun so far had ended."""
    header: Mapping[str, Any] = {}
    """The header of a cFE file; empty for other formats."""

    def stop(self) -> None:
        """End the batches of a live source after what has arrived; for any thread or signal handler."""
        self.discard()

    def discard(self) -> int:
        """End the batches of a live source at once; return the number of frames that were discarded."""
        return 0

    def pace(self, gather_s: float, idle_s: float) -> None:
        """Set the shortest time in s between batches of a live source, and the longest without traffic."""
        del gather_s, idle_s

    def follow(self, framings: Mapping[int, Framing]) -> None:
        """Read the TCP streams of these ports only; by default, of the links' usual ports.

        Call it before the first batch.
        """
        del framings

    def narrow(self, period: Callable[[int], tuple[int, int]]) -> None:
        """Announce that only the datagrams of a period are needed: a source with an index may skip others.

        All datagrams of the period are yielded in order, and also the first and the last datagram of the
        input. Call it before the first batch.

        Args:
            period: takes the time of the first datagram, ns since 1970; returns the first time of the period,
                and the first time after it.
        """
        del period

    def choose(self, choice: Choice) -> None:
        """Announce which datagrams are needed: a recording with an index may skip others.

        Some are yielded in any case: datagrams of no link, the first of all, the earliest, the latest, and
        the first of each endpoint that has an identity. Call it before the first batch.

        Args:
            choice: takes links and MsgIds.
        """
        del choice

    def published(self, number: Integers) -> Integers | None:
        """Return recorded publish times of datagrams of the last batch, ns, after ``choose``; else None."""
        return None

    @property
    def files(self) -> Sequence[str]:
        """The names of the files that are read as one source; empty for a single file."""
        return ()

    def origin(self, number: Integers) -> Integers:
        """Return the index in ``files`` of the origin of datagrams of the last batch; 0 for a single file."""
        return number * 0

    def borrow(self, room: Room) -> None:
        """Read into memory from ``room(size)``, if that saves copying it.

        ``room`` must not return memory that batches still use, or that it returned last.
        """
        del room

    def decoded(self, batch: PacketBatch, decode: Callable[[PacketBatch], Columns]) -> Columns:
        """Return the columns of the batch yielded last; ``decode`` makes them if the source has none."""
        return decode(batch)

    def recorder_counts(self) -> str:
        """Return the recorder's counters as JSON; empty if the recording was changed or has none."""
        return ""

    def faults(self) -> list[Fault]:
        """Return the faults that a proxy or a replay injected, if the recording contains them."""
        return []

    def host(self) -> list[HostCounters]:
        """Return the counters of the recording host's kernel, if the recording contains them."""
        return []


class Source(SourceDefaults, Protocol):
    """Yields datagrams, one batch at a time."""

    @property
    def info(self) -> SourceInfo:
        """Information on the source."""

    @property
    def statistics(self) -> SourceStatistics:
        """The counts so far; the same object each time."""

    def batches(self) -> Iterator[PacketBatch]:
        """Yield all datagrams, once.

        Raises:
            CaptureError: the input is damaged; raised after everything that could be read.
        """

    def close(self) -> None:
        """Close files and sockets; may be called at any time, and twice."""


class SourceOver(SourceDefaults):
    """A source that wraps another one; it behaves like the inner source where it does not override it."""

    def __init__(self, source: Source) -> None:
        self._source = source

    @property
    def info(self) -> SourceInfo:
        """Information on the inner source."""
        return self._source.info

    @property
    def statistics(self) -> SourceStatistics:
        """The counts of the inner source."""
        return self._source.statistics

    def close(self) -> None:
        """Close the inner source."""
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
        """Write the present counters of this host's kernel, if the format stores them."""
        del host

    def flush(self) -> None:
        """Write everything received so far to the file; called at least once a second when live.

        Raises:
            CaptureError: the output cannot be written.
        """

    def cut_short(self, *, empty: bool) -> None:
        """Note, before ``close``, that the input ended early; ``empty``: it had no datagram."""
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

    def summary(self) -> dict[str, Any]:
        """Return counts of what clients were sent, in the form of ``foxglove`` in ``live --json``."""
