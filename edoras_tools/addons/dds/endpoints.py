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

**Types.** Classes of messages in Cyclone DDS are equal to those of rmw_cyclonedds: final structs, ROS's
member names, ``byte`` and ``char`` as ``uint8``. Cyclone DDS checks every sample against them, and other DDS
programs can request them.

**Bytes.** For a topic made in Python a sample is already bytes: ``dds_write`` takes a pointer and a size, and
``ddspy_take`` returns bytes. Both are internal to cyclonedds, so only this file uses them. If they are not as
expected, the public functions (to objects and back) do the same, slower.

**Padding.** CDR in RTPS is padded to 4 bytes, here little-endian, with the number of padding bytes in the
two low bits of the options (DDS-XTypes 1.3, 7.6.3.1.2). Not all writers set them.
"""

from __future__ import annotations

import ctypes
import math
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Final

from cyclonedds.core import DDSException, InstanceState, SampleState, ViewState
from cyclonedds.idl import IdlStruct, make_idl_struct
from cyclonedds.idl import types as idl
from cyclonedds.internal import DDS, InvalidSample
from msgspec.structs import replace

from edoras_tools.addons.dds.domain import UNACKNOWLEDGED_BYTES
from edoras_tools.errors import ConfigError, WireError
from edoras_tools.middleware.graph import Qos, TopicState, dds_name
from edoras_tools.ros.library import PLACEHOLDER, MessageField, Shape, full_name

if TYPE_CHECKING:
    from cyclonedds.pub import DataWriter
    from cyclonedds.sub import DataReader

    from edoras_tools.ros import TypeStore

    Write = Callable[[bytes], int]
    TakeWithInfo = Callable[[], list[tuple[bytes, Any]]]

    OfferOf = Callable[[int], tuple[Qos, bool] | None]
    Readers = Mapping[Qos, tuple[DataReader[Any], TakeWithInfo]]

_PRIMITIVES: Final = {
    "bool": bool,
    "byte": idl.uint8,
    "char": idl.uint8,
    "float32": idl.float32,
    "float64": idl.float64,
    **{
        f"{kind}{bits}": getattr(idl, f"{kind}{bits}") for kind in ("int", "uint") for bits in (8, 16, 32, 64)
    },
}


class DdsTypes:
    """Makes the class of a ROS type, once.

    Args:
        types: store with the definitions.
    """

    def __init__(self, types: TypeStore) -> None:
        self._types = types
        self._made: dict[str, type[IdlStruct]] = {}

    def of(self, type_name: str) -> type[IdlStruct]:
        """Return the class of a message type.

        Raises:
            ConfigError: the type has a part that cyclonedds for Python cannot express.
            RouteError: the type is not known.
        """
        name = full_name(type_name)
        if name not in self._made:
            members = {item.name: self._member(name, item) for item in self._types.fields(name)}
            dotted = dds_name(name).replace("::", ".")
            data_type: Any = make_idl_struct(
                dotted.rpartition(".")[2], dotted, members or {PLACEHOLDER: idl.uint8}, dataclassify=False
            )
            data_type.__init__ = _fill  # a base class with it would become a base of the DDS type
            self._made[name] = data_type
        return self._made[name]

    def _member(self, owner: str, field: MessageField) -> Any:
        if field.type == "wstring":
            raise ConfigError(
                f"{owner}.{field.name}: cyclonedds for Python knows no wstring; use --ros zenoh for this type"
            )
        one: Any = _PRIMITIVES.get(field.type)
        if field.type == "string":
            one = Annotated[str, idl.bounded_str(field.string_bound)] if field.string_bound else str
        elif one is None:
            one = self.of(field.type)
        # like idl.array[one, size] and idl.sequence[one, size], but the latter takes no more than 65535
        if field.shape is Shape.ARRAY:
            return Annotated[Sequence[one], idl.array(one, field.size)]
        if field.shape is Shape.SEQUENCE:
            return Annotated[Sequence[one], idl.sequence(one, field.size or None)]
        return one


def _fill(self: IdlStruct, **values: Any) -> None:
    """Store all members, also with names of Python keywords or cyclonedds methods; dataclasses cannot."""
    self.__dict__.update(values)


_MOST_SAMPLES: Final = 256
"""Most samples taken at once: one topic must not keep the others waiting."""
ANY_STATE: Final = SampleState.Any | ViewState.Any | InstanceState.Any
"""Samples in any state: the mask for taking samples and for the wait set."""


class _Sample(ctypes.Structure):
    _fields_ = (("data", ctypes.c_char_p), ("size", ctypes.c_size_t))


def writer_of(writer: DataWriter[Any]) -> Write:
    """Return a function that writes a sample with encapsulation, padded to 4; it returns a ``DDS_RETCODE``.

    Other Python threads run while a write waits for space.
    """
    try:
        prototype = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_int32, ctypes.POINTER(_Sample))
        dds_write = prototype(("dds_write", DDS._dll_handle))  # noqa: SLF001  see above
        entity = writer._ref  # noqa: SLF001
    except AttributeError:
        return plain_writer_of(writer)
    return lambda cdr: dds_write(entity, _Sample(cdr, len(cdr)))


def info_taker_of(reader: DataReader[Any]) -> TakeWithInfo:
    """Return a function that takes the waiting samples, at most ``_MOST_SAMPLES``, each with ``SampleInfo``.

    A sample is encapsulation, body and padding.
    """
    try:
        from cyclonedds._clayer import ddspy_read, ddspy_take  # type: ignore[import-not-found]

        entity = reader._ref  # noqa: SLF001
        if isinstance(ddspy_read(entity, ANY_STATE, 1), int):  # a sample may already be there
            return plain_taker_of(reader)
    except (ImportError, AttributeError, TypeError):
        return plain_taker_of(reader)

    def take() -> list[tuple[bytes, Any]]:
        samples = ddspy_take(entity, ANY_STATE, _MOST_SAMPLES)
        if isinstance(samples, int):
            raise DDSException(samples, "while taking samples")
        return [item for item in samples if item[1].valid_data]

    return take


def plain_writer_of(writer: DataWriter[Any]) -> Write:
    """Return a function like that of ``writer_of``, made of public parts only."""
    of = writer.topic.data_type.__idl__

    def write(cdr: bytes) -> int:
        try:
            writer.write(of.deserialize(cdr))
        except DDSException as error:
            return error.code
        except Exception:  # noqa: BLE001  cyclonedds tells of bytes that do not fit by whatever went wrong
            return DDSException.DDS_RETCODE_BAD_PARAMETER
        return DDSException.DDS_RETCODE_OK

    return write


def plain_taker_of(reader: DataReader[Any]) -> TakeWithInfo:
    """Return a function like that of ``info_taker_of``, made of public parts only."""
    of = reader.topic.data_type.__idl__
    return lambda: [
        (of.serialize(sample), sample.sample_info)
        for sample in reader.take(_MOST_SAMPLES)
        if not isinstance(sample, InvalidSample)
    ]


_LITTLE: Final = b"\x00\x01"
"""Representation of little-endian CDR, as ROS 2 sends it."""
_PAD_BITS: Final = 3


def is_little_endian(cdr: bytes) -> bool:
    """Return whether a message is little-endian CDR and has a body."""
    return cdr[:2] == _LITTLE and len(cdr) > 4


def padded(cdr: bytes) -> bytes:
    """Return a message as little-endian CDR, padded to a multiple of 4 bytes as RTPS requires."""
    extra = -len(cdr) % 4
    return cdr if not extra else _LITTLE + bytes((0, extra)) + cdr[4:] + bytes(extra)


def trimmed(types: TypeStore, type_name: str, cdr: bytes) -> bytes:
    """Return a valid message without its padding, as it was before writing.

    Args:
        types: store with the type.
        type_name: type of the message.
        cdr: message as received.
    """
    if extra := cdr[3] & _PAD_BITS:
        return cdr[:3] + bytes((cdr[3] ^ extra,)) + cdr[4:-extra]
    if cdr[-1] or len(cdr) == types.fixed_size(type_name):
        return cdr
    end = types.extent(type_name, cdr)
    return cdr[:end] if len(cdr) - end <= _PAD_BITS else cdr


def rewritten(types: TypeStore, type_name: str, cdr: bytes) -> bytes:
    """Return a message as ROS 2 itself writes it: Cyclone DDS accepts fewer forms than our reader.

    Raises:
        WireError: it is not a valid message of its type.
    """
    return types.encode(type_name, types.decode(type_name, cdr))


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
