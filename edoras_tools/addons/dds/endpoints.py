"""The endpoints of a node on one topic: readers that follow its publishers, or a writer; and their losses.

**Readers.** DDS connects a reader only with writers that offer at least the requested policies, and a weaker
request gets less: no retransmissions, and no samples from before. So a subscription without its own policies
has one reader for each combination that the writers of its topic offer, and takes from it only the samples
of that kind of writers. A reader is made when discovery shows the first writer of its kind, before any
sample of it is read. It is deleted when other kinds have writers and its kind has none. While there is no
writer, one reader shows other nodes that we listen, but only after the time of discovery. The reason: Fast
DDS counts our reader as soon as it discovers it, but Cyclone DDS discovers an older writer up to a second
later. Samples published in between would be lost, and counted by nobody.

**Histories.** None of our readers overwrites a sample: samples wait until a thread takes them. Samples that a
publisher overwrote before we received them are not counted by Cyclone DDS: its sample-lost status stays 0,
and it gives no sequence numbers. On one machine this requires a full socket, whose drops the kernel counts:
``domain.dropped``. A writer keeps ``room`` samples until all reliable subscribers have acknowledged them,
though late subscribers get only as many as its depth. Samples that it then overwrites are counted here, from
the last time that everything was acknowledged: so the count may be too high, never too low.
"""

from __future__ import annotations

import math
import time
from collections import defaultdict
from typing import TYPE_CHECKING, Any, Final

from cyclonedds.core import DDSException
from msgspec.structs import replace

from edoras_tools.addons.dds.domain import UNACKNOWLEDGED_BYTES
from edoras_tools.addons.dds.messages import info_taker_of, is_little_endian, padded, rewritten, writer_of
from edoras_tools.errors import WireError
from edoras_tools.middleware.graph import Qos, TopicState

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from cyclonedds.pub import DataWriter
    from cyclonedds.sub import DataReader

    from edoras_tools.addons.dds.messages import TakeWithInfo
    from edoras_tools.ros import TypeStore

    OfferOf = Callable[[int], tuple[Qos, bool] | None]
    Readers = Mapping[Qos, tuple[DataReader[Any], TakeWithInfo]]

BLOCKING_MS: Final = 100
"""Time that a write waits for readers that are behind: DDS's own default. ROS waits for ever."""
_MOST_ROOM: Final = 1000
_USUAL_BYTES: Final = 50_000
"""Assumed maximum size of a message of variable size, bytes: up to it, a stopped reader delays nobody."""
_PATIENCE_S: Final = 0.02
_BREAK_S: Final = 0.2
_ALL: Final = math.inf
_FIRST_OFFER: Final = Qos(reliable=True, transient_local=False)


def offer_to(qos: Qos, offer: Qos) -> Qos:
    """Return the quality of service to request of a publisher: open policies are those that it offers."""
    return replace(
        qos,
        reliable=offer.reliable if qos.reliable is None else qos.reliable,
        transient_local=offer.transient_local if qos.transient_local is None else qos.transient_local,
    )


class TopicReaders:
    """The readers of a topic.

    Args:
        topic: ROS topic.
        type_name: ROS type.
        qos: requested quality of service; a policy that is None is that of each publisher.
        heard: called with each message.
        make: function that makes a reader.
        drop: function that deletes a reader.

    Attributes:
        readers: readers by their quality of service.
    """

    def __init__(
        self,
        topic: str,
        type_name: str,
        qos: Qos,
        heard: Callable[[bytes], None],
        make: Callable[[Qos], DataReader[Any]],
        drop: Callable[[DataReader[Any]], None],
    ) -> None:
        self.topic, self.type_name, self.heard = topic, type_name, heard
        self.follows = None in (qos.reliable, qos.transient_local)
        self.readers: Readers = {}
        self._qos, self._make, self._drop = qos, make, drop
        self._joined: dict[int, int] = {}
        self._given: dict[int, float] = {}
        self._known = not self.follows

    def follow(self, offers: Iterable[Qos], offer_of: OfferOf, *, settled: bool) -> list[bytes]:
        """Make a reader for each kind of writers, and delete all others; return the messages left in those.

        Args:
            offers: offers of all present writers.
            offer_of: see ``take``.
            settled: whether the time of discovery is over.
        """
        requests = {offer_to(self._qos, offer) for offer in offers}
        self._known = self._known or bool(requests)
        requests = requests or {*self.readers}
        if settled and not requests:
            requests = {offer_to(self._qos, _FIRST_OFFER)}
        for qos in requests - self.readers.keys():
            reader = self._make(qos)
            self.readers = {**self.readers, qos: (reader, info_taker_of(reader))}
        leftover: list[bytes] = []
        for qos in self.readers.keys() - requests:
            reader, take = self.readers[qos]
            while samples := take():
                leftover += [cdr for cdr, info in samples if self._is_first(qos, info, offer_of)]
            self.readers = {key: item for key, item in self.readers.items() if key != qos}
            self._drop(reader)
        return leftover

    def take(self, offer_of: OfferOf) -> Iterator[bytes]:
        """Yield the waiting messages, each once.

        Args:
            offer_of: returns the offer of a writer's handle, and whether the writer still exists.
        """
        for qos, (_, take) in self.readers.items():
            samples = take()
            if qos.transient_local and qos.depth and len(samples) > qos.depth:
                samples = self._recent(samples, qos.depth)
            for cdr, info in samples:
                if not self.follows or self._is_first(qos, info, offer_of):
                    yield cdr

    def _is_first(self, qos: Qos, info: Any, offer_of: OfferOf) -> bool:
        """Return whether no other reader has given this sample, or will.

        A sample that another reader gets before the reader of its kind is connected is taken from the other
        one, unless the reader of its kind will get it from the history of its writer.
        """
        handle, when = int(info.publication_handle), int(info.source_timestamp)
        offer, alive = offer_of(handle) or (qos, True)
        kind, latest = offer_to(self._qos, offer), self._given.get(handle, 0)
        if kind == qos:
            if latest == _ALL:
                return True
            self._given[handle] = _ALL if when > latest else latest
            return when > latest
        if latest == _ALL or (kind.transient_local and alive):
            return False
        self._given[handle] = max(when, latest)
        return when > latest

    def state(self) -> TopicState:
        """Return the policies of its readers, once a publisher is known."""
        return TopicState(tuple(self.readers) if self._known else (), missed=None)

    def _recent(self, samples: list[tuple[bytes, Any]], depth: int) -> list[tuple[bytes, Any]]:
        """Return samples; of those written before we discovered a writer, only its last ``depth``."""
        now, older = time.time_ns(), defaultdict[int, int](int)
        for _, info in samples:
            handle = info.publication_handle
            if info.source_timestamp < self._joined.setdefault(handle, now):
                older[handle] += 1
        recent = []
        for cdr, info in samples:
            handle = info.publication_handle
            if info.source_timestamp < self._joined[handle]:
                older[handle] -= 1
                if older[handle] >= depth:
                    continue
            recent.append((cdr, info))
        return recent


class CountedWriter:
    """A writer with a count of overwritten samples.

    Args:
        topic: ROS topic.
        type_name: ROS type.
        qos: offered quality of service.
        room: number of samples kept until they are acknowledged; 0 for all.
        writer: writer made with these values.
        types: types that include this one.

    Attributes:
        overwritten: upper bound of the samples that a reliable subscriber may not have received.
    """

    def __init__(
        self, topic: str, type_name: str, qos: Qos, room: int, writer: DataWriter[Any], types: TypeStore
    ) -> None:
        self.topic, self.type_name, self.overwritten = topic, type_name, 0
        self._qos, self._types, self._writer = qos, types, writer
        self._room = room if qos.reliable else 0
        self._write = writer_of(writer)
        self._sent = self._acknowledged = 0
        self._again_s = 0.0

    def publish(self, cdr: bytes) -> None:
        """Publish a message.

        Raises:
            WireError: the message is not valid, or lost because a reliable subscriber has been behind for
                ``BLOCKING_MS``: this happens only if all samples are kept, or large ones.
        """
        if self._room and self._sent - self._acknowledged >= self._room:
            self._count()
        refused = DDSException.DDS_RETCODE_BAD_PARAMETER
        code = self._write(padded(cdr)) if is_little_endian(cdr) else refused
        if code == refused:
            code = self._write(padded(rewritten(self._types, self.type_name, cdr)))
        if code:
            raise WireError(f"{self.topic}: a message of {self.type_name} is lost: {_loss(code)}")
        self._sent += 1

    def state(self) -> TopicState:
        """Return its offer, and the number of overwritten samples."""
        return TopicState((self._qos,), overwritten=self.overwritten)

    def _count(self) -> None:
        """Count that the next sample overwrites one, unless all are acknowledged within a short time."""
        now = time.monotonic()
        patience = _PATIENCE_S if now >= self._again_s else 0
        if acknowledged(self._writer, patience):
            self._acknowledged = self._sent
            return
        self.overwritten += 1
        if patience:
            self._again_s = now + _BREAK_S


def acknowledged(writer: DataWriter[Any], patience_s: float = 0) -> bool:
    """Return whether reliable subscribers acknowledge all written samples within a time."""
    try:
        return bool(writer.wait_for_acks(round(patience_s * 1e9)))
    except AttributeError:  # cyclonedds 11.0.1 asks the wrong class whether its time is over
        return False


def room_of(qos: Qos, size: int | None) -> int:
    """Return the number of samples that a writer keeps until they are acknowledged.

    Args:
        size: size of a message, bytes; None if it varies.
    """
    fitting = UNACKNOWLEDGED_BYTES // (size or _USUAL_BYTES)
    return max(qos.depth, min(_MOST_ROOM, fitting)) if qos.depth else 0


def _loss(code: int) -> str:
    """Return the reason of a failed write in words."""
    if code == DDSException.DDS_RETCODE_TIMEOUT:
        return f"a reliable subscriber did not keep up for {BLOCKING_MS} ms"
    return str(DDSException(code, "while writing"))
