"""RTPS, the wire protocol of DDS (DDSI-RTPS 2.5, OMG formal/2022-04-01): headers, many messages in columns.

Headers are those of a message, and of each kind of submessage (8.3.7 and 9.4).

Each submessage has the byte order of its sender, given by a flag. So there are two layouts of each kind, the
second for big-endian senders. A sequence number is two words; the high one comes first in either order.

Parameter lists are announcements of participants about themselves and their endpoints (9.6.3). Reading is
lenient: a list that is cut, or has no end, is read as far as possible.

Columns have the submessages, and the samples in these. All messages of a batch are read in parallel: each
step reads the next submessage of every message. At most ``MOST_SUBMESSAGES`` are read of a message, and
``MOST_PARAMETERS`` of inline QoS.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from enum import IntEnum, IntFlag
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

import msgspec
import numpy as np

from edoras_tools.middleware.graph import ros_name
from edoras_tools.units import SECOND
from edoras_tools.wire.arrays import Integers, Mask, Octets, gather
from edoras_tools.wire.layout import Field, Layout

if TYPE_CHECKING:
    from numpy.typing import NDArray


PREFIX_BYTES: Final = 12
ENTITY_BYTES: Final = 4
GUID_BYTES: Final = PREFIX_BYTES + ENTITY_BYTES


class SubmessageKind(IntEnum):
    """Kinds of submessages (9.4.5.1.1); vendors have those from 0x80 on."""

    PAD = 0x01
    ACKNACK = 0x06
    HEARTBEAT = 0x07
    GAP = 0x08
    INFO_TS = 0x09
    INFO_SRC = 0x0C
    INFO_REPLY_IP4 = 0x0D
    INFO_DST = 0x0E
    INFO_REPLY = 0x0F
    NACK_FRAG = 0x12
    HEARTBEAT_FRAG = 0x13
    DATA = 0x15
    DATA_FRAG = 0x16
    SEC_BODY = 0x30
    SEC_PREFIX = 0x31
    SEC_POSTFIX = 0x32
    SRTPS_PREFIX = 0x33
    SRTPS_POSTFIX = 0x34


class SubmessageFlag(IntFlag):
    """Flags of submessages; the meaning of the second to the fourth bit depends on the kind."""

    LITTLE_ENDIAN = 0x01
    INLINE_QOS = 0x02
    """DATA and DATA_FRAG: a parameter list is in front of the data."""
    NO_TIMESTAMP = 0x02
    """INFO_TS: the following submessages have no time."""
    DATA = 0x04
    """DATA: it contains a sample."""
    KEY = 0x08
    """DATA: it contains a key only, of an instance that is disposed of."""
    FRAGMENT_KEY = 0x04
    """DATA_FRAG: its fragments are those of a key."""


SUBMESSAGE_NAMES: Final[Mapping[int, str]] = {int(item): item.name for item in SubmessageKind}
VENDOR_NAMES: Final[Mapping[int, str]] = {
    0x0101: "RTI Connext",
    0x0102: "OpenSplice",
    0x0103: "OpenDDS",
    0x0106: "InterCOM",
    0x0109: "CoreDX",
    0x010F: "eProsima Fast DDS",
    0x0110: "Eclipse Cyclone DDS",
    0x0111: "GurumDDS",
    0x0112: "RustDDS",
    0x0113: "Zhenrong ZRDDS",
    0x0114: "S2E Dust DDS",
}
"""Vendor names as registered at the OMG."""

RTPS_HEADER: Final = Layout(
    "rtps",
    "RTPS",
    Field("magic", 32, "the letters RTPS", base=16),
    Field("version_major", 8, "of the protocol", clause="DDSI-RTPS 2.5, 8.3.3"),
    Field("version_minor", 8, "of the protocol"),
    Field("vendor_id", 16, "who made the sender's DDS", base=16, names=VENDOR_NAMES),
    Field("guid_prefix", 8 * PREFIX_BYTES, "of the participant that sends it", kind="bytes"),
)


class Orders(NamedTuple):
    """A header in both byte orders."""

    little: Layout
    big: Layout

    def of(self, *, little: bool) -> Layout:
        """Return the layout of a byte order."""
        return self.little if little else self.big


def _orders(name: str, title: str, *fields: Field) -> Orders:
    head = (
        Field("submessage_id", 8, "which submessage", base=16, names=SUBMESSAGE_NAMES),
        Field("flags", 8, "the first bit: byte order; the others depend on the kind", base=16),
        Field("octets_to_next_header", 16, "bytes behind this field; 0: up to the end of the message"),
    )
    return Orders(
        Layout(f"rtps_{name}", title, *head, *fields, byte_order="little"),
        Layout(f"rtps_{name}_big", f"{title}, most significant byte first", *head, *fields),
    )


def _entity(name: str, doc: str) -> Field:
    return Field(name, 8 * ENTITY_BYTES, doc, kind="bytes", clause="DDSI-RTPS 2.5, 9.3.1.2")


def _sequence_number(name: str, doc: str) -> tuple[Field, Field]:
    return (
        Field(f"{name}_high", 32, f"{doc}: the high word", kind="int"),
        Field(f"{name}_low", 32, f"{doc}: the low word"),
    )


_READER: Final = _entity("reader_id", "of which reader; 00000000: of every one")
_WRITER: Final = _entity("writer_id", "of which writer")
_ENDS: Final = (_READER, _WRITER)
_INLINE: Final = (
    Field("extra_flags", 16, "0", base=16),
    Field("octets_to_inline_qos", 16, "bytes from behind this field to the inline QoS or the data"),
)

SUBMESSAGE: Final = _orders("submessage", "Submessage")
SUBMESSAGE_LAYOUTS: Final[Mapping[int, Orders]] = {
    SubmessageKind.ACKNACK: _orders(
        "acknack",
        "ACKNACK",
        *_ENDS,
        *_sequence_number("base", "all samples before it are there"),
        Field("num_bits", 32, "how many samples from there on are spoken of"),
    ),
    SubmessageKind.HEARTBEAT: _orders(
        "heartbeat",
        "HEARTBEAT",
        *_ENDS,
        *_sequence_number("first", "first sample that the writer still has"),
        *_sequence_number("last", "last sample that it has written"),
        Field("count", 32, "grows with every heartbeat that is not a copy"),
    ),
    SubmessageKind.GAP: _orders(
        "gap",
        "GAP",
        *_ENDS,
        *_sequence_number("gap_start", "first sample that will not come"),
        *_sequence_number("base", "the first one behind those that follow it"),
        Field("num_bits", 32, "of how many samples from there on bits tell whether they come"),
    ),
    SubmessageKind.INFO_TS: _orders(
        "info_ts",
        "INFO_TS",
        Field("seconds", 32, "since 1970, of all submessages that follow"),
        Field("fraction", 32, "of a second, in 1/2^32"),
    ),
    SubmessageKind.INFO_SRC: _orders(
        "info_src",
        "INFO_SRC",
        Field("unused", 32, "0"),
        Field("version_major", 8, "of the protocol"),
        Field("version_minor", 8, "of the protocol"),
        Field("vendor_id", 16, "who made the writer's DDS", kind="bytes"),
        Field("guid_prefix", 8 * PREFIX_BYTES, "of the participant that what follows is from", kind="bytes"),
    ),
    SubmessageKind.INFO_DST: _orders(
        "info_dst",
        "INFO_DST",
        Field("guid_prefix", 8 * PREFIX_BYTES, "of the participant that what follows is for", kind="bytes"),
    ),
    SubmessageKind.INFO_REPLY: _orders(
        "info_reply", "INFO_REPLY", Field("num_locators", 32, "where to answer: how many addresses")
    ),
    SubmessageKind.NACK_FRAG: _orders(
        "nack_frag",
        "NACK_FRAG",
        *_ENDS,
        *_sequence_number("writer_sn", "the sample"),
        Field("fragment_base", 32, "all fragments before it are there"),
        Field("num_bits", 32, "how many fragments from there on are spoken of"),
    ),
    SubmessageKind.HEARTBEAT_FRAG: _orders(
        "heartbeat_frag",
        "HEARTBEAT_FRAG",
        *_ENDS,
        *_sequence_number("writer_sn", "the sample"),
        Field("last_fragment_num", 32, "the last fragment that there is so far"),
        Field("count", 32, "grows with every one that is not a copy"),
    ),
    SubmessageKind.DATA: _orders(
        "data", "DATA", *_INLINE, *_ENDS, *_sequence_number("writer_sn", "the writer's count of its samples")
    ),
    SubmessageKind.DATA_FRAG: _orders(
        "data_frag",
        "DATA_FRAG",
        *_INLINE,
        *_ENDS,
        *_sequence_number("writer_sn", "the writer's count of its samples"),
        Field("fragment_starting_num", 32, "the first fragment in it, counted from 1"),
        Field("fragments_in_submessage", 16, "how many fragments"),
        Field("fragment_size", 16, "bytes of each but the last of the sample"),
        Field("sample_size", 32, "bytes of the whole sample"),
    ),
}
"""Header of each kind of submessage, including the common four bytes; other kinds have only these four."""
EVERY_RTPS_LAYOUT: Final = (
    RTPS_HEADER,
    *(layout for orders in (SUBMESSAGE, *SUBMESSAGE_LAYOUTS.values()) for layout in orders),
)
EMPTY_KINDS: Final = (SubmessageKind.PAD, SubmessageKind.INFO_TS)
"""Kinds for which a length of 0 does not mean: up to the end (9.4.5.1.3)."""
WITH_SEQUENCE_SET: Final = (SubmessageKind.ACKNACK, SubmessageKind.GAP)
INLINE_AT: Final = SUBMESSAGE_LAYOUTS[SubmessageKind.DATA].little.by_name["octets_to_inline_qos"].end
"""Origin of the offset ``octets_to_inline_qos``, in DATA and DATA_FRAG."""


BUILT_IN: Final[Mapping[bytes, str]] = {
    bytes.fromhex(entity): name
    for entity, name in (
        ("000001c1", "participant"),
        ("000002c2", "topics writer"),
        ("000002c7", "topics reader"),
        ("000003c2", "publications writer"),
        ("000003c7", "publications reader"),
        ("000004c2", "subscriptions writer"),
        ("000004c7", "subscriptions reader"),
        ("000100c2", "participants writer"),
        ("000100c7", "participants reader"),
        ("000200c2", "liveliness writer"),
        ("000200c7", "liveliness reader"),
        ("000300c3", "type lookup request writer"),
        ("000300c4", "type lookup request reader"),
        ("000301c3", "type lookup reply writer"),
        ("000301c4", "type lookup reply reader"),
    )
}
"""Endpoints of every participant (9.3.1.5)."""
ANNOUNCING: Final = (0x000100C2, 0x000003C2, 0x000004C2)
"""Entity ids of the writers that announce participants, publications and subscriptions."""
BUILT_IN_KIND: Final = 0xC0
"""Bits that are set in the last byte of a built-in entity id."""


MOST_PARAMETERS_READ: Final = 1 << 9
LONGEST_TEXT: Final = 1 << 10
"""Longest name, bytes; longer ones are cut."""
_MUST_UNDERSTAND: Final = 0x3FFF
"""Bits of a parameter id without the flags for vendors and for parameters that must be understood."""
_ENCAPSULATIONS: Final[dict[int, Literal["big", "little"]]] = {0x0002: "big", 0x0003: "little"}
"""Byte order by the representation of PL_CDR."""


class ParameterId(IntEnum):
    """The parameters that are read (table 9.18)."""

    PAD = 0x0000
    SENTINEL = 0x0001
    TOPIC_NAME = 0x0005
    TYPE_NAME = 0x0007
    RELIABILITY = 0x001A
    DURABILITY = 0x001D
    UNICAST_LOCATOR = 0x002F
    DEFAULT_UNICAST_LOCATOR = 0x0031
    HISTORY = 0x0040
    PARTICIPANT_GUID = 0x0050
    ENDPOINT_GUID = 0x005A
    ENTITY_NAME = 0x0062
    STATUS_INFO = 0x0071


_LOCATORS: Final = (ParameterId.UNICAST_LOCATOR, ParameterId.DEFAULT_UNICAST_LOCATOR)
_SHARED_MEMORY: Final = 16
"""Kind of a Fast DDS locator that is no network address (its ``LOCATOR_KIND_SHM``)."""
_RELIABLE: Final = 2
"""Reliable kind of reliability (9.3.2)."""
STATUS_NAMES: Final = {1: "disposed", 2: "unregistered"}


class Announcement(msgspec.Struct, frozen=True):
    """The announcement of a participant or an endpoint; absent values are empty or None.

    Attributes:
        guid: GUID of the endpoint, or of the participant.
        topic: name in DDS: ``rt/cmd_vel``.
        type: name in DDS: ``geometry_msgs::msg::dds_::Twist_``.
        name: name of the participant.
        shared_memory: whether it can be reached through its host's memory, without a network.
        reliable: whether a writer sends lost samples again; DDS's default for writers.
        transient_local: whether late subscribers get the last samples.
        depth: number of samples that it keeps; 0 if it is not given, or all are kept.
    """

    guid: bytes
    topic: str = ""
    type: str = ""
    name: str = ""
    shared_memory: bool = False
    reliable: bool = True
    transient_local: bool = False
    depth: int = 0

    @property
    def is_writer(self) -> bool:
        """Whether it is about a writer (table 9.1)."""
        return self.guid[-1:] in {b"\x02", b"\x03"}

    @property
    def ros_topic(self) -> str:
        """Name of the topic in ROS."""
        return ros_topic(self.topic)

    @property
    def ros_type(self) -> str:
        """Name of the type in ROS."""
        return ros_name(self.type)


def read_parameters(data: bytes) -> Iterator[tuple[int, bytes, Literal["big", "little"]]]:
    """Yield id, value and byte order of each parameter in an encapsulation; nothing if it is no list.

    Args:
        data: bytes from the encapsulation on.
    """
    order = _ENCAPSULATIONS.get(int.from_bytes(data[:2], "big"))
    if order is not None:
        yield from read_parameter_list(data[4:], order)


def read_parameter_list(
    data: bytes, order: Literal["big", "little"]
) -> Iterator[tuple[int, bytes, Literal["big", "little"]]]:
    """Yield id, value and byte order of each parameter in a list without encapsulation, such as inline QoS.

    Args:
        data: bytes from the first parameter on; bytes behind the last one are ignored.
        order: byte order.
    """
    at = 0
    for _ in range(MOST_PARAMETERS_READ):
        if at + 4 > len(data):
            return
        number = int.from_bytes(data[at : at + 2], order)
        size = int.from_bytes(data[at + 2 : at + 4], order)
        if number == ParameterId.SENTINEL or at + 4 + size > len(data):
            return
        yield number, data[at + 4 : at + 4 + size], order
        at += 4 + size


def read_status(data: bytes, order: Literal["big", "little"]) -> str:
    """Return the status of an instance in inline QoS; empty if there is none (9.6.4.9)."""
    for number, value, _ in read_parameter_list(data, order):
        if number & _MUST_UNDERSTAND == ParameterId.STATUS_INFO and len(value) >= 4:
            return " and ".join(name for bit, name in STATUS_NAMES.items() if value[3] & bit)
    return ""


def read_announcement(data: bytes) -> Announcement | None:
    """Read the announcement of a participant or an endpoint; None if it has no GUID.

    Args:
        data: bytes from the encapsulation on.
    """
    guids = dict.fromkeys((ParameterId.ENDPOINT_GUID, ParameterId.PARTICIPANT_GUID), b"")
    texts = dict.fromkeys((ParameterId.TOPIC_NAME, ParameterId.TYPE_NAME, ParameterId.ENTITY_NAME), "")
    numbers = {ParameterId.RELIABILITY: _RELIABLE, ParameterId.DURABILITY: 0, ParameterId.HISTORY: 0}
    shared_memory = False
    for number, value, order in read_parameters(data):
        parameter: Any = number & _MUST_UNDERSTAND
        if parameter in guids and len(value) >= GUID_BYTES:
            guids[parameter] = value[:GUID_BYTES]
        elif parameter in texts:
            texts[parameter] = _text(value, order)
        elif parameter in numbers:
            # The depth follows the kind keep_last, 0; behind keep_all it has no meaning.
            at = 4 + 4 * any(value[:4]) if parameter == ParameterId.HISTORY else 0
            numbers[parameter] = int.from_bytes(value[at : at + 4], order)
        elif parameter in _LOCATORS:
            shared_memory |= int.from_bytes(value[:4], order) == _SHARED_MEMORY
    guid, participant = guids.values()
    reliability, durability, depth = numbers.values()
    topic, kind, name = texts.values()
    owner, qos = guid or participant, (reliability >= _RELIABLE, durability > 0, depth)
    return Announcement(owner, topic, kind, name, shared_memory, *qos) if owner else None


def _text(value: bytes, order: Literal["big", "little"]) -> str:
    size = min(int.from_bytes(value[:4], order), LONGEST_TEXT)
    text = value[4 : 4 + size].split(b"\0", 1)[0].decode("utf-8", "replace")
    return text if text.isprintable() else "".join(item if item.isprintable() else "?" for item in text)


_TOPIC: Final = "rt/"
"""Prefix of ROS topics in DDS; topics of requests and replies keep theirs."""


def ros_topic(topic: str) -> str:
    """Return the ROS name of a DDS topic; the DDS name if it is no ROS topic.

    https://design.ros2.org/articles/topic_and_service_names.html
    """
    return topic.removeprefix(_TOPIC[:-1]) if topic.startswith(_TOPIC) else topic


MOST_SUBMESSAGES: Final = 1 << 10
MOST_PARAMETERS: Final = 1 << 6
NO_TIME: Final = -1
NOWHERE: Final = -1
"""A position that does not exist."""
_HEAD: Final = SUBMESSAGE.little.size
_SENTINEL: Final = 1
_STAMP: Final = SUBMESSAGE_LAYOUTS[SubmessageKind.INFO_TS]
_PREFIX_AT: Final = RTPS_HEADER.by_name["guid_prefix"].start
_SOURCE_AT: Final = SUBMESSAGE_LAYOUTS[SubmessageKind.INFO_SRC].little.by_name["guid_prefix"].start
_DESTINATION_AT: Final = SUBMESSAGE_LAYOUTS[SubmessageKind.INFO_DST].little.by_name["guid_prefix"].start


class Submessages(NamedTuple):
    """Submessages of some messages, in order; columns of one length.

    Attributes:
        row: i64 (n,), index of the message.
        start: i64 (n,), first byte in the data.
        end: i64 (n,), one past the last byte that exists.
        kind: u8 (n,), a ``SubmessageKind``, or another number.
        flags: u8 (n,), ``SubmessageFlag``.
        source: i64 (n,), position of the sending participant's GUID prefix.
        destination: i64 (n,), position of the receiving participant's GUID prefix; ``NOWHERE``: for all.
        time_ns: i64 (n,), time of writing, ns since 1970; ``NO_TIME`` if it is not given.
        whole: bool (n,), whether all its bytes exist.
    """

    row: Integers
    start: Integers
    end: Integers
    kind: Octets
    flags: Octets
    source: Integers
    destination: Integers
    time_ns: Integers
    whole: Mask

    def take(self, mask: NDArray[Any]) -> Submessages:
        """Return the submessages that a mask or indices select."""
        return Submessages(*(column[mask] for column in self))

    @property
    def little(self) -> Mask:
        """Whether each is little-endian: bool (n,)."""
        return np.asarray((self.flags & SubmessageFlag.LITTLE_ENDIAN) != 0)


class RtpsMessages(NamedTuple):
    """The contents of some messages.

    Attributes:
        submessages: all submessages.
        truncated: bool (n,), whether bytes of a message are missing.
        odd: bool (n,), whether a message has more submessages than are read.
    """

    submessages: Submessages
    truncated: Mask
    odd: Mask


def read_messages(data: Octets, offset: Integers, length: NDArray[np.integer[Any]]) -> RtpsMessages:
    """Read many messages; no contents can raise an error.

    Args:
        data: u8, contiguous buffer.
        offset: i64 (n,), first byte of each message.
        length: (n,), number of bytes that exist.
    """
    count = len(offset)
    end = offset + length
    truncated = length < RTPS_HEADER.size
    source, destination = offset + _PREFIX_AT, np.full(count, NOWHERE, np.int64)
    time_ns = np.full(count, NO_TIME, np.int64)
    place = offset + RTPS_HEADER.size
    active = np.flatnonzero(~truncated & (place < end))
    steps: list[tuple[NDArray[Any], ...]] = []
    while len(active) and len(steps) < MOST_SUBMESSAGES:
        room = end[active] - place[active] >= _HEAD
        truncated[active[~room]] = True
        active = active[room]
        at = place[active]
        head = gather(data, at, _HEAD)
        kind, flags = head[:, 0], head[:, 1]
        little = (flags & SubmessageFlag.LITTLE_ENDIAN) != 0
        size = _number(SUBMESSAGE, "octets_to_next_header", head, little)
        stop = at + _HEAD + size
        to_end = (size == 0) & ~_MAY_BE_EMPTY[kind]
        stop[to_end] = end[active[to_end]]
        whole = (stop <= end[active]) & (stop - at >= LEAST_BYTES[kind])
        no_time = (kind == SubmessageKind.INFO_TS) & ((flags & SubmessageFlag.NO_TIMESTAMP) != 0)
        whole |= no_time & (stop <= end[active])
        truncated[active[~whole]] = True
        stop = np.minimum(stop, end[active])
        for standard, target, inside in (
            (SubmessageKind.INFO_SRC, source, _SOURCE_AT),
            (SubmessageKind.INFO_DST, destination, _DESTINATION_AT),
        ):
            some = (kind == standard) & whole
            target[active[some]] = at[some] + inside
        some = np.flatnonzero((kind == SubmessageKind.INFO_TS) & whole & ~no_time)
        if len(some):
            stamps = gather(data, at[some], _STAMP.little.size)
            seconds, fraction = (
                _number(_STAMP, name, stamps, little[some]) for name in ("seconds", "fraction")
            )
            time_ns[active[some]] = seconds * SECOND + (fraction * SECOND >> 32)
        time_ns[active[no_time]] = NO_TIME
        steps.append(
            (active, at, stop, kind, flags, source[active], destination[active], time_ns[active], whole)
        )
        place[active] = stop
        active = active[place[active] < end[active]]
    odd = np.zeros(count, bool)
    odd[active] = True
    return RtpsMessages(_joined(steps), truncated, odd)


def _joined(steps: list[tuple[NDArray[Any], ...]]) -> Submessages:
    if not steps:
        none = np.zeros(0, np.int64)
        octets = np.zeros(0, np.uint8)
        return Submessages(none, none, none, octets, octets, none, none, none, np.zeros(0, bool))
    joined = Submessages(*(np.concatenate(column) for column in zip(*steps, strict=True)))
    return joined if len(steps) == 1 else joined.take(np.argsort(joined.row, kind="stable"))


def _least() -> Integers:
    least = np.full(256, _HEAD, np.int64)
    for kind, orders in SUBMESSAGE_LAYOUTS.items():
        least[kind] = orders.little.size
    return least


LEAST_BYTES: Final = _least()
"""Least size of a submessage of each kind, bytes."""
_MAY_BE_EMPTY: Final = np.isin(np.arange(256), EMPTY_KINDS)


def _number(orders: Orders, name: str, head: Octets, little: Mask) -> Integers:
    """Read a number from headers of both byte orders, i64 (n,)."""
    if little.all():
        return orders.little.column(name, head).astype(np.int64)
    return np.where(little, orders.little.column(name, head), orders.big.column(name, head)).astype(np.int64)


class SubmessageFields:
    """The fields of submessages of one kind.

    Args:
        data: u8, buffer of the submessages.
        submessages: submessages of that kind, all complete.
        kind: kind.
    """

    def __init__(self, data: Octets, submessages: Submessages, kind: SubmessageKind) -> None:
        self._orders, self._little = SUBMESSAGE_LAYOUTS[kind], submessages.little
        self._data, self._submessages = data, submessages
        self._head = gather(data, submessages.start, self._orders.little.size)

    def number(self, name: str) -> Integers:
        """Return a number, i64 (n,)."""
        return _number(self._orders, name, self._head, self._little)

    def sequence_number(self, name: str) -> Integers:
        """Return a sequence number, i64 (n,)."""
        return (self.number(f"{name}_high") << 32) + self.number(f"{name}_low")

    def guid(self, name: str) -> NDArray[np.void]:
        """Return the GUID of an endpoint, V16 (n,): ``writer_id`` at the source, ``reader_id`` at the target.

        If the destination is not given, the prefix is zero.
        """
        prefix = self._submessages.source if name == "writer_id" else self._submessages.destination
        # Reversed in an ACKNACK: it goes from the reader to the writer.
        if self._orders in _FROM_READERS:
            prefix = self._submessages.destination if name == "writer_id" else self._submessages.source
        slot = self._orders.little.by_name[name]
        out = np.zeros((len(prefix), GUID_BYTES), np.uint8)
        named_source = prefix != NOWHERE
        out[named_source, :PREFIX_BYTES] = gather(self._data, prefix[named_source], PREFIX_BYTES)
        out[:, PREFIX_BYTES:] = self._head[:, slot.start : slot.start + ENTITY_BYTES]
        return out.view(f"V{GUID_BYTES}")[:, 0]


_FROM_READERS: Final = (
    SUBMESSAGE_LAYOUTS[SubmessageKind.ACKNACK],
    SUBMESSAGE_LAYOUTS[SubmessageKind.NACK_FRAG],
)


class SampleData(NamedTuple):
    """The data in DATA and DATA_FRAG; columns of one length.

    Attributes:
        which: i64 (n,), index of the submessage.
        start: i64 (n,), first byte of the data in its encapsulation; for a fragment, of its part.
        end: i64 (n,), one past the last byte.
        fits: bool (n,), whether the header and the inline QoS are sound.
    """

    which: Integers
    start: Integers
    end: Integers
    fits: Mask

    def take(self, mask: NDArray[Any]) -> SampleData:
        """Return the data that a mask or indices select."""
        return SampleData(*(column[mask] for column in self))


def read_samples(data: Octets, submessages: Submessages, kind: SubmessageKind) -> SampleData:
    """Find the data of submessages, behind inline QoS.

    Args:
        data: u8, buffer of the submessages.
        submessages: all submessages of some messages.
        kind: ``DATA`` or ``DATA_FRAG``; cut submessages, and DATA without data, are left out.
    """
    members = (submessages.kind == kind) & submessages.whole
    if kind == SubmessageKind.DATA:
        members &= (submessages.flags & (SubmessageFlag.DATA | SubmessageFlag.KEY)) != 0
    which = np.flatnonzero(members)
    some = submessages.take(which)
    inline = SubmessageFields(data, some, kind).number("octets_to_inline_qos")
    start = some.start + INLINE_AT + inline
    # 8.3.7.2: a later version may add fields in between; fewer bytes than in this version are an error.
    least = some.start + SUBMESSAGE_LAYOUTS[kind].little.size
    fits = (start >= least) & (start <= some.end)
    start = np.where(fits, start, some.end)
    active = np.flatnonzero(fits & ((some.flags & SubmessageFlag.INLINE_QOS) != 0))
    fits[active] = False
    little = some.little
    for _ in range(MOST_PARAMETERS):
        active = active[start[active] + _HEAD <= some.end[active]]
        if not len(active):
            break
        head = gather(data, start[active], _HEAD)
        words = np.where(little[active, None], head.view("<u2"), head.view(">u2")).astype(np.int64)
        over = words[:, 0] == _SENTINEL
        start[active] += _HEAD + np.where(over, 0, words[:, 1])
        fits[active[over]] = True
        active = active[~over]
    start = np.where(fits, start, some.end)
    return SampleData(which, start, some.end, fits)


def sequence_set(data: bytes, at: int, end: int, *, little: bool, base: int, bits: int) -> list[int]:
    """Return the numbers of a sequence number set, or of a set of fragments (9.4.2.6, 9.4.2.8).

    Args:
        data: bytes that contain the set.
        at: position behind ``num_bits``.
        end: one past the submessage.
        little: whether the byte order is little-endian.
        base: number of the first bit.
        bits: number of bits; bits in missing words are ignored.
    """
    bits = min(bits, MOST_BITS, (end - at) // 4 * 32)
    order = "<u4" if little else ">u4"
    words = np.frombuffer(data, order, (bits + 31) // 32, at) if bits > 0 else np.zeros(0, order)
    set_bits = np.unpackbits(words.astype(">u4").view(np.uint8))[: max(bits, 0)]
    return [base + int(bit) for bit in np.flatnonzero(set_bits)]


MOST_BITS: Final = 256
"""Most bits of a valid set (8.3.5.5)."""


def guid_text(guid: bytes) -> str:
    """Return a GUID in the usual text form: ``0110..35.00000403``: prefix, entity id, in hex."""
    return f"{guid[:PREFIX_BYTES].hex()}.{guid[PREFIX_BYTES:].hex()}"
