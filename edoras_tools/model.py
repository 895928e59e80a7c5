"""The values that walk through the pipeline: batches of datagrams, their columns, and what is read from them.

Everything here is frozen. Arrays are numpy arrays of one length, one element a datagram; nobody writes into
an array that was handed over.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Final, Literal, NamedTuple
from zlib import crc32

import msgspec
import numpy as np

from edoras_tools.older import Flags
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from typing_extensions import Self

    from edoras_tools.errors import EdorasError


NO_MSG_ID = -1
"""``Columns.msg_id`` of a datagram that holds no space packet."""
NO_ROUTE = -1
"""``Columns.route`` of a datagram that no configured topic claims."""


def rate_hz(count: int, span_ns: int) -> float:
    """Return the rate of messages in Hz between the first and the last, as every command defines a rate.

    Args:
        count: number of messages, the first and the last included.
        span_ns: time from the first to the last, ns; the rate is 0 if this is 0.
    """
    return (count - 1) * SECOND / span_ns if count > 1 and span_ns > 0 else 0.0


class Finding(Flags):
    """A departure from the protocols or from what receivers accept; one bit each, so one column holds all.

    The bits are recorded in ``/edoras/datagrams``: never renumber one, append.
    """

    TRUNCATED = 1 << 0
    LENGTH_MISMATCH = 1 << 1
    CHECKSUM_BAD = 1 << 2
    CHECKSUM_ABSENT = 1 << 3
    SEQUENCE_UNSET = 1 << 4
    ENVELOPE_OVERRUN = 1 << 5
    STALE_TAIL = 1 << 6
    CDR_INVALID = 1 << 7
    UNKNOWN_MSG_ID = 1 << 8
    SBN_SIZE_MISMATCH = 1 << 9
    SBN_UNKNOWN_TYPE = 1 << 10
    SBN_ID_MISMATCH = 1 << 11
    OVER_CI_BUFFER = 1 << 12
    OVER_BRIDGE_BUFFER = 1 << 13
    BRIDGE_DROPS_LENGTH = 1 << 14
    HEADER_ONLY = 1 << 15
    INVALID_MSG_ID = 1 << 16
    WRONG_DIRECTION = 1 << 17
    UNKNOWN_FUNCTION_CODE = 1 << 18
    COMMAND_LENGTH = 1 << 19
    OVER_SOFTWARE_BUS = 1 << 20
    SBN_VERSION_MISMATCH = 1 << 21
    SBN_NO_MESSAGE = 1 << 22
    SBN_LEGACY_HEADER = 1 << 23
    CDR_BIG_ENDIAN = 1 << 24
    FRAGMENT = 1 << 25
    CAPTURE_CUT = 1 << 26
    STRUCT_LENGTH = 1 << 27
    CDR_TRAILING = 1 << 28
    CDR_TOO_LONG = 1 << 29
    STREAM_GAP = 1 << 30
    STREAM_RESENT = 1 << 31

    @property
    def label(self) -> str:
        """The name in files, JSON and on screen, as ``length_mismatch``."""
        return str(self.name).lower()

    @property
    def labels(self) -> list[str]:
        """The labels of every bit that is set, lowest bit first."""
        return [bit.label for bit in self]


UNKNOWABLE: Final = (
    Finding.TRUNCATED
    | Finding.LENGTH_MISMATCH
    | Finding.CHECKSUM_BAD
    | Finding.CHECKSUM_ABSENT
    | Finding.ENVELOPE_OVERRUN
    | Finding.CDR_INVALID
    | Finding.CDR_TRAILING
    | Finding.CDR_TOO_LONG
    | Finding.SBN_SIZE_MISMATCH
    | Finding.COMMAND_LENGTH
    | Finding.HEADER_ONLY
    | Finding.SBN_LEGACY_HEADER
    | Finding.STRUCT_LENGTH
)
"""Findings that a datagram must not get if the capture itself cut it."""


NO_FINDINGS = Finding(0)


class Transport(msgspec.Struct, frozen=True):
    """How the messages of a link travel.

    Attributes:
        protocol: ``udp``: one message a datagram; ``tcp``: messages one after the other in a stream;
            ``either``.
        ports: usual destination ports; for TCP, the ports that are listened on.
        first: end that speaks first: ``client``, ``server`` or ``either``.
    """

    protocol: Literal["udp", "tcp", "either"] = "udp"
    ports: tuple[int, ...] = ()
    first: Literal["client", "server", "either"] = "client"

    @property
    def udp(self) -> bool:
        """Whether its messages may be datagrams."""
        return self.protocol != "tcp"

    @property
    def tcp(self) -> bool:
        """Whether its messages may come in a stream."""
        return self.protocol != "udp"


class Link(int):
    """The names and properties of a link; as a number it is its code, which columns and recordings hold.

    Each link is one object, in the table :mod:`edoras_tools.links.table`. Code asks a link for its properties
    (``link.to_cfs``, ``link.peers``), never which link it is.

    Attributes:
        code: number in recordings; never renumbered.
        name: name for people, as ``CI``.
        label: name in files, JSON and options, as ``ci``.
        colour: colour of its name on a terminal; a name that rich knows.
        doc: description, one line.
        transport: protocol, ports, and the end that speaks first.
        to_cfs: whether messages travel towards cFS on it; this and ``from_cfs`` may both be true.
        from_cfs: whether messages travel away from cFS on it.
        packets: whether it carries space packets.
        peers: whether a header names the sender: SpacecraftID and ProcessorID.
        bridge: kind of the EDORAS bridge whose routes it carries: ``ground``, ``flight``, or empty for none.
        bridge_ports: parameters of such a bridge that hold the link's ports.
        receive_buffer: bytes of the usual receiver's buffer; 0 if its size does not matter.
        over_receive_buffer: finding of a datagram that is longer than that buffer.
        largest: bytes of the largest space packet that a datagram can hold.
        header_bytes: bytes in front of the space packet.
        last_hop: whether flight apps forward their commands on it, as values without a header.
        dictionary: whether a dictionary of F Prime describes the content of its packets.
        samples: whether its datagrams hold samples of DDS.
        in_packets: whether packets of other links may carry its units, as ``Mission.pdu_msg_ids`` states.
        several: whether a datagram may hold several messages; the link itself finds them.
        quotes: whether each message holds the beginning of a datagram of another link.
    """

    code: ClassVar[int] = 0
    name: ClassVar[str] = "UDP"
    label: ClassVar[str] = "other"
    colour: ClassVar[str] = "dim"
    doc: ClassVar[str] = "of no link: kept, and not dissected"
    transport: ClassVar[Transport] = Transport()
    to_cfs: ClassVar[bool] = False
    from_cfs: ClassVar[bool] = False
    packets: ClassVar[bool] = False
    peers: ClassVar[bool] = False
    bridge: ClassVar[str] = ""
    bridge_ports: ClassVar[tuple[str, ...]] = ()
    receive_buffer: ClassVar[int] = 0
    over_receive_buffer: ClassVar[Finding] = NO_FINDINGS
    largest: ClassVar[int] = 65507
    header_bytes: ClassVar[int] = 0
    last_hop: ClassVar[bool] = False
    dictionary: ClassVar[bool] = False
    samples: ClassVar[bool] = False
    in_packets: ClassVar[bool] = False
    several: ClassVar[bool] = False
    quotes: ClassVar[bool] = False

    @property
    def only_to_cfs(self) -> bool:
        """Whether messages travel only towards cFS on it."""
        return self.to_cfs and not self.from_cfs

    @property
    def only_from_cfs(self) -> bool:
        """Whether messages travel only away from cFS on it."""
        return self.from_cfs and not self.to_cfs

    def __new__(cls) -> Self:
        """Return the one object of this link."""
        if "_only" not in cls.__dict__:
            cls._only = super().__new__(cls, cls.code)
        return cls._only

    _only: ClassVar[Self]

    def __reduce__(self) -> tuple[type[Link], tuple[()]]:
        return type(self), ()

    def __repr__(self) -> str:
        return f"<link {self.label}>"


OTHER: Final = Link()
"""No link: the datagram is kept, and not dissected."""


class Endpoint(msgspec.Struct, frozen=True, order=True):
    """An IP address in text form and a UDP or TCP port."""

    address: str
    port: int

    def __str__(self) -> str:
        host = f"[{self.address}]" if ":" in self.address else self.address
        return f"{host}:{self.port}"


class Peer(NamedTuple):
    """Identity of an SBN peer: its spacecraft and processor, never its address."""

    spacecraft_id: int
    processor_id: int

    def __str__(self) -> str:
        return f"{self.spacecraft_id}:{self.processor_id}"


class Datagram(NamedTuple):
    """One complete captured datagram, or one message of a TCP stream.

    Attributes:
        number: number of its frame in the source, from 1 as Wireshark counts.
        time_ns: capture time, ns since 1970-01-01 UTC.
        link_type: pcap LINKTYPE of ``frame``.
        frame: frame as captured, link layer header included.
        payload: UDP payload, reassembled if there were fragments; for a stream, one message.
        payload_offset: start of ``payload`` in ``frame``; -1 if the payload was reassembled.
        original_length: bytes of the frame on the wire; more than ``len(frame)`` if the capture cut it; -1
            for a packet taken out of transfer frames, which has none.
        source: sender.
        destination: receiver.
        findings: departures that the capture shows.
        stream: whether it is a message of a TCP stream; ``frame`` is then one segment that holds it alone.
        topic: for a message from a recording without datagrams, index of its topic in ``Mission.routes``;
            ``NO_ROUTE`` for datagrams. Such a message has no addresses.
    """

    number: int
    time_ns: int
    link_type: int
    frame: bytes
    payload: bytes
    payload_offset: int
    original_length: int
    source: Endpoint
    destination: Endpoint
    findings: Finding = NO_FINDINGS
    stream: bool = False
    topic: int = NO_ROUTE


RECORDED: Final = np.dtype([("topic", "<u2"), ("sequence", "<u4"), ("publish_ns", "<i8")])
"""Row of a message from a recording without datagrams: index of its topic in ``Mission.routes``, sequence
number and publish time (ns since 1970), which the recording has in addition to the capture time."""


class PacketBatch(msgspec.Struct, frozen=True, eq=False):
    """Datagrams, and messages of TCP streams, as columns over one contiguous byte buffer.

    All arrays have the batch's length. Offsets point into ``data``. A batch may have one row, or none.

    Attributes:
        data: u8, bytes that all offsets point into, with complete frames.
        number: i64, number of the frame in its source, from 1.
        time_ns: i64, capture time, ns since 1970-01-01 UTC.
        link_type: u16, pcap LINKTYPE of the frame.
        frame_offset: i64, start of the frame, link layer header included.
        frame_length: i32, captured bytes of the frame.
        original_length: i32, bytes of the frame on the wire; -1 for a packet taken out of transfer frames,
            which are rows of their own.
        offset: i64, start of the UDP payload; it lies outside its frame if it was reassembled from fragments.
        length: i32, captured bytes of the UDP payload.
        source_address: u32, IPv4 as a number; for IPv6 an index into ``ipv6``.
        source_port: u16, UDP or TCP port of the sender.
        destination_address: u32, as ``source_address``.
        destination_port: u16, UDP or TCP port of the receiver.
        ip_version: u8, 4 or 6.
        capture_findings: u32, findings that one datagram alone does not show: ``FRAGMENT``, ``CAPTURE_CUT``,
            ``STREAM_GAP``, ``STREAM_RESENT``, and mistakes in transfer frames.
        ipv6: IPv6 addresses, 16 bytes each; the address columns hold indexes of them.
        streams: bool, rows that come from TCP streams; None if no row does.
        recorded: ``RECORDED``, for the rows of a recording without datagrams; these rows are messages
            without frames and addresses, with ``original_length`` -1. None for datagrams.
    """

    data: NDArray[np.uint8]
    number: NDArray[np.int64]
    time_ns: NDArray[np.int64]
    link_type: NDArray[np.uint16]
    frame_offset: NDArray[np.int64]
    frame_length: NDArray[np.int32]
    original_length: NDArray[np.int32]
    offset: NDArray[np.int64]
    length: NDArray[np.int32]
    source_address: NDArray[np.uint32]
    source_port: NDArray[np.uint16]
    destination_address: NDArray[np.uint32]
    destination_port: NDArray[np.uint16]
    ip_version: NDArray[np.uint8]
    capture_findings: NDArray[np.uint32]
    ipv6: tuple[bytes, ...] = ()
    streams: NDArray[np.bool_] | None = None
    recorded: NDArray[np.void] | None = None

    def __len__(self) -> int:
        return len(self.time_ns)

    def __getitem__(self, index: int) -> Datagram:
        """Return one datagram, copied out of the buffer.

        Raises:
            IndexError: there is no such datagram.
        """
        frame_offset, offset = int(self.frame_offset[index]), int(self.offset[index])
        frame_end = frame_offset + int(self.frame_length[index])
        payload_end = offset + int(self.length[index])
        inside = frame_offset <= offset and payload_end <= frame_end
        source, destination = self.ends(index)
        return Datagram(
            number=int(self.number[index]),
            time_ns=int(self.time_ns[index]),
            link_type=int(self.link_type[index]),
            frame=self.data[frame_offset:frame_end].tobytes(),
            payload=self.data[offset:payload_end].tobytes(),
            payload_offset=offset - frame_offset if inside else -1,
            original_length=int(self.original_length[index]),
            source=source,
            destination=destination,
            findings=Finding(int(self.capture_findings[index])),
            stream=self.streams is not None and bool(self.streams[index]),
            topic=NO_ROUTE if self.recorded is None else int(self.recorded["topic"][index]),
        )

    def ends(self, index: int) -> tuple[Endpoint, Endpoint]:
        """Return source and destination of a row's datagram."""
        source = Endpoint(self.address(int(self.source_address[index]), index), int(self.source_port[index]))
        address = self.address(int(self.destination_address[index]), index)
        return source, Endpoint(address, int(self.destination_port[index]))

    def address(self, value: int, index: int) -> str:
        """Return an element of an address column of row ``index`` as text."""
        if self.ip_version[index] == 6:
            return str(ipaddress.IPv6Address(self.ipv6[value]))
        return ".".join(map(str, value.to_bytes(4, "big")))  # a tenth of the time of ``ipaddress``

    def fixed(self, address: NDArray[np.uint32]) -> NDArray[np.uint64]:
        """Return an address column as numbers that mean the same in every batch, u64.

        Args:
            address: ``source_address``, ``destination_address``, or one of both in each row.
        """
        number = address.astype(np.uint64)
        if self.ipv6:
            wide = self.ip_version == 6
            table = np.array([crc32(item) | 1 << 32 for item in self.ipv6], np.uint64)
            number[wide] = table[address[wide]]
        return number

    @property
    def captured(self) -> Self:
        """The rows that were captured, without packets that were taken out of transfer frames."""
        own = self.original_length >= 0
        return self if own.all() else self.take(own)

    def take(self, rows: NDArray[Any] | slice) -> Self:
        """Return the rows of an index array, a mask or a slice, over the same buffer."""
        return type(self)(
            **{
                name: value if value is None or name in {"data", "ipv6"} else value[rows]
                for name in self.__struct_fields__
                for value in (getattr(self, name),)
            }
        )


class Columns(msgspec.Struct, frozen=True, eq=False):
    """The values that ``decode.columns`` reads from a batch, one element a datagram.

    Offsets point into the batch's ``data``. Columns of an absent layer hold the value stated below.

    Attributes:
        link: u8, the code of a ``Link``.
        spacecraft: u8, number of the spacecraft, from 1; see ``decode.spacecraft``.
        sbn_msg_type: i16, SBN MsgType; -1 where there is no SBN header.
        processor_id: u32, SBN ProcessorID of the sender; 0 where there is none.
        spacecraft_id: u32, SBN SpacecraftID of the sender; 0 where there is none.
        packet_offset: i64, start of the space packet; -1 where there is none.
        packet_length: i32, bytes of the space packet that are in the datagram; 0 where there is none.
        msg_id: i32, cFE MsgId; ``NO_MSG_ID`` where there is none.
        sequence_flags: u8, 0 to 3.
        sequence_count: u16, 0 to 16383.
        function_code: i16, function code of a command; -1 for telemetry or none.
        mission_time_ns: i64, time in the telemetry header, ns since its epoch; -1 where there is none.
        header_length: u8, cFE header bytes, primary header included; 0 where there is none.
        headers: u8, index into ``wire.cfe.HEADERS`` of the headers that the packet is read with.
        cdr_offset: i64, first byte of the CDR encapsulation; -1 where there is no whole envelope.
        cdr_length: i32, CDR bytes, encapsulation included; 0 where there is no whole envelope.
        route: i16, index into ``Mission.routes``; ``NO_ROUTE`` where no route of this link claims the MsgId.
        findings: u32, set of ``Finding`` bits.
    """

    link: NDArray[np.uint8]
    spacecraft: NDArray[np.uint8]
    sbn_msg_type: NDArray[np.int16]
    processor_id: NDArray[np.uint32]
    spacecraft_id: NDArray[np.uint32]
    packet_offset: NDArray[np.int64]
    packet_length: NDArray[np.int32]
    msg_id: NDArray[np.int32]
    sequence_flags: NDArray[np.uint8]
    sequence_count: NDArray[np.uint16]
    function_code: NDArray[np.int16]
    mission_time_ns: NDArray[np.int64]
    header_length: NDArray[np.uint8]
    headers: NDArray[np.uint8]
    cdr_offset: NDArray[np.int64]
    cdr_length: NDArray[np.int32]
    route: NDArray[np.int16]
    findings: NDArray[np.uint32]

    def __len__(self) -> int:
        return len(self.link)

    def take(self, rows: NDArray[Any] | slice) -> Self:
        """Return the rows of an index array, a mask or a slice."""
        return type(self)(**{name: getattr(self, name)[rows] for name in self.__struct_fields__})


class LayerField(NamedTuple):
    """One named value of a layer and the bytes it was read from.

    Attributes:
        name: name in the standard, as in the tree, the filters and the JSON.
        value: int, float, bytes, str or a plain list.
        start: first byte, from the start of the UDP payload.
        end: one past the last byte.
        text: value as text for people, as ``0x1827`` or ``command``.
        doc: description of the field, one line.
    """

    name: str
    value: Any
    start: int
    end: int
    text: str = ""
    doc: str = ""


class Layer(NamedTuple):
    """One dissected header or body.

    Attributes:
        name: short name, as ``ccsds`` or ``sbn``.
        title: title in the tree.
        start: first byte, from the start of the UDP payload.
        end: one past the last byte.
        fields: fields in wire order.
    """

    name: str
    title: str
    start: int
    end: int
    fields: tuple[LayerField, ...]

    def values(self) -> dict[str, Any]:
        """Return the fields' values by name."""
        return {item.name: item.value for item in self.fields}


class RosMessage(msgspec.Struct, frozen=True):
    """A decoded ROS message.

    Attributes:
        type: ROS type name, as ``geometry_msgs/msg/Twist``.
        topic: configured topic.
        values: field values as nested dicts, as ``TypeStore.decode`` returns them.
        cdr: CDR bytes, encapsulation included, without padding.
        shipped: whether its type is one of the built-in structs of cFE.
    """

    type: str
    topic: str
    values: Mapping[str, Any]
    cdr: bytes
    shipped: bool = False


class Decoded(msgspec.Struct, frozen=True):
    """Everything that was read from one datagram; if decoding stops, the layers before that are kept.

    Attributes:
        datagram: the bytes and their addresses.
        link: link that the datagram was assigned to.
        layers: dissected layers, outermost first.
        findings: all departures.
        message: ROS message, if one decoded.
        stop: reason why decoding stopped; None if it reached the end.
        summary: one short line for the packet list.
        more: further messages, if one datagram holds several.
    """

    datagram: Datagram
    link: Link
    layers: tuple[Layer, ...]
    findings: Finding
    message: RosMessage | None = None
    stop: EdorasError | None = None
    summary: str = ""
    more: tuple[RosMessage, ...] = ()

    @property
    def messages(self) -> tuple[RosMessage, ...]:
        """All messages of the datagram."""
        return (self.message, *self.more) if self.message else ()

    @property
    def link_name(self) -> str:
        """Name of the link for people; for traffic of no link, name of the transport."""
        return "TCP" if self.datagram.stream and self.link is OTHER else self.link.name

    def layer(self, name: str) -> Layer | None:
        """Return the first layer with a name, or None."""
        return next((item for item in self.layers if item.name == name), None)


class CutDatagram(msgspec.Struct, frozen=True):
    """A datagram that was never complete: it lacks fragments.

    Attributes:
        time_ns: capture time, ns since 1970-01-01 UTC.
        source: sender; its port is 0 if ``head`` is empty.
        destination: receiver, likewise.
        head: first bytes of the UDP payload, at most 56; empty unless just its first fragment came.
    """

    time_ns: int
    source: Endpoint
    destination: Endpoint
    head: bytes


class InterfaceOutage(msgspec.Struct, frozen=True):
    """A time in which an interface delivered nothing because it was absent, down or without carrier.

    Attributes:
        interface: name of the interface.
        why: ``not there``, ``down`` or ``without carrier``, when this was noticed.
        start_ns: start of the outage, ns since 1970-01-01 UTC.
        end_ns: end of the outage, ns since 1970-01-01 UTC; 0 while it lasts.
    """

    interface: str
    why: str
    start_ns: int
    end_ns: int = 0

    @classmethod
    def from_text(cls, values: Mapping[str, str]) -> Self:
        """Return the outage that ``as_json`` wrote, from a recording that holds its values as text.

        Raises:
            ValueError: a value is missing or is no number.
        """
        try:
            start_ns, end_ns = int(values["start_ns"]), int(values["end_ns"])
            return cls(values["interface"], values["why"], start_ns, end_ns)
        except KeyError as error:
            raise ValueError(f"no {error}") from error

    def as_json(self) -> dict[str, Any]:
        """Return the outage in the form of ``record --json``."""
        return {
            "interface": self.interface,
            "why": self.why,
            "start_ns": self.start_ns,
            "end_ns": self.end_ns or None,
        }


class SocketCounters(msgspec.Struct, frozen=True):
    """Counters of the kernel for a UDP socket.

    Attributes:
        port: port that it listens on.
        address: address that it listens on, in text form.
        inode: number that differs from that of an earlier socket of the same port.
        queued: bytes that wait in it, the kernel's own overhead included.
        drops: datagrams dropped since it was opened because it was full.
    """

    port: int
    address: str
    inode: int
    queued: int
    drops: int


class HostCounters(msgspec.Struct, frozen=True):
    """Counters of a host's kernel; None if a counter cannot be read.

    Attributes:
        time_ns: time of reading, ns since 1970.
        sockets: sockets on the links' ports.
        receive_buffer_errors: UDP datagrams dropped by full sockets since the start, IPv4 and IPv6.
        reassembly_failures: IP packets that were not reassembled because fragments were missing, since the
            start.
        interface_drops: received frames that interfaces dropped since the start.
        cpu_ticks: processor time of all kinds since the start, in clock ticks.
        steal_ticks: part of it in which the machine waited for its own host.
        msg_max: ``fs.mqueue.msg_max``, the greatest depth of a cFS pipe.
        rmem_default: ``net.core.rmem_default``, bytes of a socket's buffer unless it asks for more.
        rmem_max: ``net.core.rmem_max``, most bytes that a socket can ask for.
    """

    time_ns: int
    sockets: tuple[SocketCounters, ...] = ()
    receive_buffer_errors: int | None = None
    reassembly_failures: int | None = None
    interface_drops: int | None = None
    cpu_ticks: int | None = None
    steal_ticks: int | None = None
    msg_max: int | None = None
    rmem_default: int | None = None
    rmem_max: int | None = None


class SourceStatistics(msgspec.Struct):
    """Counters of a source; they may be read at any time.

    Attributes:
        frames: frames read.
        datagrams: UDP datagrams handed over.
        skipped: frames that are not UDP datagrams.
        bytes: frame bytes read.
        kernel_drops: frames that the kernel or a full queue lost before the source saw them; None if the
            source does not count them, as for pcap files.
        total_bytes: size of the whole input if it is known, for progress; else 0.
        position: bytes of the input consumed so far, on the scale of ``total_bytes``.
        warnings: warnings for people, one line each.
        outages: outages of interfaces, in order of time; the last one may still last.
        passed_over: datagrams of a recording that were not read, because nothing needs them.
        cut: datagrams that lack fragments, at most 16,384 and those that still wait; filled at the end.
        shared: datagrams left out because another capture, read together with this one, has them.
        astray: for each datagram that did not reach the place of another capture on its way, which is read
            together with this one: time (ns since 1970), fingerprint, and whether this is certain.
        begins: of conversations that the capture which begins first lacks: both endpoints, and the time, ns
            since 1970, at which the first capture that has it begins.
    """

    frames: int = 0
    datagrams: int = 0
    skipped: int = 0
    bytes: int = 0
    passed_over: int = 0
    kernel_drops: int | None = None
    total_bytes: int = 0
    position: int = 0
    warnings: list[str] = msgspec.field(default_factory=list)
    outages: list[InterfaceOutage] = msgspec.field(default_factory=list)
    cut: list[CutDatagram] = msgspec.field(default_factory=list)
    shared: int = 0
    astray: list[tuple[int, int, bool]] = msgspec.field(default_factory=list)
    begins: list[tuple[Endpoint, Endpoint, int]] = msgspec.field(default_factory=list)

    @property
    def ended(self) -> bool:
        """Whether all of an input of known size was read."""
        return 0 < self.total_bytes <= self.position


class SourceInfo(msgspec.Struct, frozen=True):
    """Description of a source.

    Attributes:
        name: file path, ``-`` or interface name.
        kind: ``pcap``, ``pcapng``, ``mcap``, ``live`` or ``udp``.
        time_resolution_ns: step of its timestamps, ns: 1, 1000, ...
        snap_length: most bytes of a frame that the capture keeps.
        attachments: mission files and similar files that the source carries, by name.
        definitions: message definitions that it carries, complete ``ros2msg`` texts by type.
        read_with: options that its datagrams are read with, as ``decode.Options.described``; a recording
            keeps them.
        damage: reason why some topics are unknown, for a damaged recording of messages.
        links: labels of the links in a complete recording; None if it does not state them.
        apart: whether each datagram of a recording can be read without the others, as it was recorded.
        sound: whether none of its conversations is left out as another program's traffic.
    """

    name: str
    kind: str
    time_resolution_ns: int = 1
    snap_length: int = 262144
    attachments: Mapping[str, bytes] = msgspec.field(default_factory=dict)
    definitions: Mapping[str, str] = msgspec.field(default_factory=dict)
    read_with: Mapping[str, str] = msgspec.field(default_factory=dict)
    damage: str = ""
    links: frozenset[str] | None = None
    apart: bool = False
    sound: bool = False


def concatenate(batches: Sequence[PacketBatch]) -> PacketBatch:
    """Join batches end to end into one; the buffers are copied.

    Args:
        batches: at least one.
    """
    if len(batches) == 1:
        return batches[0]
    starts = np.cumsum([0, *(len(batch.data) for batch in batches[:-1])])
    tables = np.cumsum([0, *(len(batch.ipv6) for batch in batches[:-1])])
    columns: dict[str, Any] = {}
    for name in PacketBatch.__struct_fields__:
        values = [getattr(batch, name) for batch in batches]
        if name in {"frame_offset", "offset"}:
            values = [value + start for value, start in zip(values, starts, strict=True)]
        elif name in {"source_address", "destination_address"}:
            values = [
                np.where(batch.ip_version == 6, value + np.uint32(table), value)
                for batch, value, table in zip(batches, values, tables, strict=True)
            ]
        elif name == "streams":
            if all(value is None for value in values):
                continue
            values = [
                np.zeros(len(batch), bool) if value is None else value
                for batch, value in zip(batches, values, strict=True)
            ]
        elif name == "recorded" and values[0] is None:  # messages are never merged with datagrams
            continue
        columns[name] = sum(values, ()) if name == "ipv6" else np.concatenate(values)
    return PacketBatch(**columns)
