"""The interfaces between a link and the rest: what it is given, objects with state, and their results.

``Reading`` is one datagram while it is read: its bytes, and its layers and findings so far. ``Site`` is the
knowledge about the place of a capture: the mission, and the peers and endpoints in its datagrams. A link that
has only headers needs none of the others. Types of higher layers are ``Any`` here; each docstring names the
type.

A link over TCP sets ``LinkProtocol.framing`` to an object of a class derived from :class:`Framing`, and names
its ports in ``LinkProtocol.transport`` with ``protocol="tcp"`` (or ``"either"``). Most links only implement
:meth:`Framing.lengths`: the length of the message that starts at a byte. ``io.frames.tcp`` puts the bytes of
each connection in order, calls it, and makes one row of a ``PacketBatch`` from each message, so
``recognise``, ``locate`` and ``dissect`` of the link see a message like a datagram.

Rules that every framing keeps:

1. It is frozen: knowledge of one connection is kept in the object that :meth:`Framing.state` returns.
2. It raises nothing, for any bytes.
3. A message longer than ``largest`` is none: no stream can make a reader keep more than that.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from typing import TYPE_CHECKING, Any, ClassVar, Final, Protocol

import msgspec
import numpy as np

from edoras_tools.errors import TruncatedError
from edoras_tools.model import Columns, Datagram, Finding, Layer, LayerField, PacketBatch, RosMessage
from edoras_tools.wire.arrays import PADDING, Integers, Mask, Octets, Places

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.wire.layout import Layout


class TopicSpace(Protocol):
    """The topics of a recording, to which a link adds its own."""

    @property
    def types(self) -> Any:
        """The ROS types, a ``ros.TypeStore``."""

    @property
    def mission(self) -> Any:
        """The ``mission.Mission``."""

    @property
    def endpoints(self) -> Endpoints | None:
        """The endpoints that announced themselves; None if nobody decodes announcements."""

    def used_names(self) -> set[str]:
        """Return the topic names that other messages have, or may get."""

    def place(self, name: str, type_name: str, metadata: Mapping[str, str]) -> int:
        """Return the channel of a topic, which is added at first use."""


class OwnTopics(Protocol):
    """Makes messages of a link's datagrams, on topics that are known only from their content."""

    def messages(self, batch: PacketBatch, columns: Columns) -> Iterable[Any]:
        """Return the ``io.topics.messages.Messages`` of a batch, as copies; batches come in order."""

    def offer(self) -> None:
        """Add the topics that are already known, before their first messages."""


class OwnRows(Protocol):
    """Reassembles pieces: each complete unit becomes a row after the row of its last piece."""

    def take(
        self, batch: PacketBatch, columns: Columns, decode: Callable[[PacketBatch], Columns]
    ) -> tuple[PacketBatch, Columns]:
        """Return a batch and its columns with the rows that become complete in it; batches come in order.

        Args:
            decode: decodes the new rows.
        """

    def notes(self) -> list[str]:
        """Return notes for users on the pieces, a line each."""


class Unwrapper(Protocol):
    """Extracts packets from their carriers (frames, for example), before a batch is decoded."""

    @property
    def pieces(self) -> int:
        """The number of carriers read."""

    def take(self, batch: PacketBatch) -> PacketBatch:
        """Return a batch with the packets that end in it as rows of their own; batches come in order."""

    def notes(self) -> list[str]:
        """Return notes for users on the carriers, a line each."""


class KnownSamples(msgspec.Struct, frozen=True, eq=False):
    """Samples of one topic with a known type, in the order of the rows; arrays have one length.

    Attributes:
        topic: ROS name of the topic.
        type: ROS type of the topic.
        row: row of the batch, i64.
        writers: GUIDs of the writers.
        writer: index of its writer in ``writers``, i64.
        sequence_number: number of the sample from its writer, i64.
        offset: start of the CDR encapsulation in the batch's data, i64.
        length: bytes, padding included, i32.
        written_ns: time of writing, i64, ns since 1970; -1 if unknown.
        valid: whether it is a whole message, bool.
    """

    topic: str
    type: str
    row: Places
    writers: list[bytes]
    writer: Integers
    sequence_number: Integers
    offset: Integers
    length: NDArray[np.int32]
    written_ns: Integers
    valid: Mask


class SampleReader(Protocol):
    """Reads samples in datagrams: messages of writers that announce their topics and identify themselves."""

    def known_samples(
        self, types: Any, endpoints: Endpoints, batch: PacketBatch, rows: Places
    ) -> Iterator[KnownSamples]:
        """Yield the samples of each topic and type.

        Args:
            types: a ``ros.TypeStore``; None: no type is known.
            rows: rows of the link.
        """

    def rows_on(
        self, batch: PacketBatch, rows: Places, endpoints: Endpoints, holds: Callable[[str], bool]
    ) -> Places:
        """Return those of some rows that have a sample of a topic that ``holds`` accepts."""

    def writers(self, batch: PacketBatch, rows: Places) -> Iterable[bytes]:
        """Return the GUIDs of the writers to which some rows belong."""

    def topic_of(self, guid: bytes, endpoints: Endpoints) -> str:
        """Return the name of a writer's topic; also one for a topic that was not announced."""


class SampleStream(msgspec.Struct, frozen=True):
    """The samples of one writer.

    Attributes:
        topic: ROS name, or a substitute.
        count: number of captured samples, each counted once.
        first_ns: time of the first.
        last_ns: time of the last.
        longest_ns: longest time between two consecutive ones.
    """

    topic: str
    count: int
    first_ns: int
    last_ns: int
    longest_ns: int


class Follower:
    """The counts of a link in the batches of a stream, for ``info``; this one counts nothing."""

    def add(self, batch: PacketBatch, columns: Columns) -> None:
        """Add a batch; batches come in order."""

    def summary(self) -> dict[str, Any]:
        """Return the link's additions to ``info --json``."""
        return {}

    def counts(self) -> Sequence[Any]:
        """Return sequence counts of packets without a row, each a ``sessions.sequence.SequenceStream``."""
        return ()


class LinkEvidence(Follower):
    """The observations of a link in the batches of a stream, for the doctor; this one observes nothing.

    Attributes:
        datagrams: number of datagrams that the doctor has no rows of, and judges by these observations alone.
        reassembled: number of rows that were reassembled, not captured.
    """

    datagrams: int = 0
    reassembled: int = 0

    def samples(self) -> Sequence[SampleStream]:
        """Return the samples of each writer."""
        return ()

    def spans(self) -> list[tuple[int, int]]:
        """Return begin and end of each time in which something was captured, ns since 1970."""
        return []

    def rows(self, drops: int | None) -> list[Any]:
        """Return witness rows, each a ``diagnosis.ledger.Row``.

        Args:
            drops: number of frames that the capture itself lost; None if unknown.
        """
        return []

    def missing(self, drops: int | None) -> list[Any]:
        """Return the losses, each a ``diagnosis.missing.Missing``; see ``rows``."""
        return []


NOT_YET: Final = 0
"""The length of a message whose header is not complete yet."""
NOT_A_MESSAGE: Final = -1
"""The length at a byte where no message starts."""


class MessageContents(msgspec.Struct, frozen=True, eq=False):
    """The contents of the messages of one connection, if they differ from the messages' bytes.

    Attributes:
        data: contents end to end, u8.
        offset: start of each in ``data``, i64 (n,).
        length: bytes of each, i64 (n,).
        part: whether the message is only a part of one, bool (n,): its content comes with a later message.
    """

    data: Octets
    offset: Integers
    length: Integers
    part: Mask


class StreamState(Protocol):
    """The state of one connection, for a link whose messages depend on earlier ones.

    Attributes:
        foreign: whether the connection is another program's on the same port, so that nothing of it is kept.
    """

    foreign: bool

    def contents(self, data: Octets, offset: Integers, length: Integers, forward: Mask) -> MessageContents:
        """Return the contents of the next messages; they come in the order in which they were complete.

        Args:
            data: buffer with the messages, u8.
            offset: start of each, i64 (n,).
            length: bytes of each, i64 (n,).
            forward: direction of each, bool (n,); which end is which is unknown.
        """


class Framing:
    """Cuts a byte stream into messages.

    Attributes:
        head: number of bytes that are enough to know the length of any message.
        largest: bytes of the longest message.
        sender: bytes of ``head`` that are the same in all messages of one end of a connection.
        checked: whether a message that is ``likely`` surely is one, for example by a check value.
    """

    head: ClassVar[int] = 1
    largest: ClassVar[int] = 65535
    sender: ClassVar[slice] = slice(0)
    checked: bool = False

    def lengths(self, data: Octets, at: Integers, end: Integers | int) -> Integers:
        """Return the bytes of the message that starts at each position.

        Args:
            data: contiguous buffer, u8; at least ``wire.arrays.window.PADDING`` bytes follow each ``end``.
            at: positions, i64 (n,), at most ``end``.
            end: end of the present bytes, for all or i64 (n,).

        Returns:
            Lengths, i64 (n,), header included; ``NOT_YET`` if more bytes are needed, and ``NOT_A_MESSAGE``
            if no message of this link starts there.
        """
        raise NotImplementedError

    def length(self, data: memoryview, at: int, end: int) -> int:
        """Return the same as ``lengths`` for one position; override it if that is faster."""
        return int(self.lengths(np.frombuffer(data, np.uint8), np.array([at], np.int64), end)[0])

    def cut(self, data: bytes) -> tuple[list[bytes], bytes, bool]:
        """Return the complete messages at the start of a stream, the rest, and whether that is no message."""
        messages: list[bytes] = []
        at, size, padded = 0, NOT_YET, memoryview(data + bytes(PADDING))
        while at < len(data):
            size = self.length(padded, at, len(data))
            if size <= 0 or at + size > len(data):
                break
            messages.append(data[at : at + size])
            at += size
        return messages, data[at:], size == NOT_A_MESSAGE

    def likely(self, data: Octets, at: Integers, end: Integers | int) -> Mask:
        """Return where a message probably starts, bool (n,): used to find the first one after missing bytes.

        The stricter it is, the better; ``lengths`` may accept positions that it does not.
        """
        return self.lengths(data, at, end) > 0

    def state(self) -> StreamState | None:
        """Return a new object for a new connection; None if each message is its own content."""
        return None


def prefixed(
    head: NDArray[Any], size: NDArray[Any], room: Integers | int, needed: int, largest: int
) -> Integers:
    """Return lengths like :meth:`Framing.lengths`, for a header that states them.

    Args:
        head: whether the header is possible, bool (n,).
        size: bytes of the message by its header, header included, integer (n,).
        room: number of present bytes from each position on.
        needed: bytes of the header.
        largest: see ``Framing``.
    """
    fits = head & (size >= needed) & (size <= largest)
    return np.where(room < needed, NOT_YET, np.where(fits, size, NOT_A_MESSAGE)).astype(np.int64)


class Reading:
    """The results of reading a datagram so far; a later error does not remove them.

    Attributes:
        data: payload.
        layers: layers, outermost first.
        findings: findings, including those of the capture.
        detail: whether every value of a message gets its own bytes.
    """

    detail = True

    def __init__(self, datagram: Datagram) -> None:
        self.datagram = datagram
        self.data = datagram.payload
        self.findings = datagram.findings
        self.layers: list[Layer] = []

    def read(self, layout: Layout, at: int, *, extra: tuple[LayerField, ...] = ()) -> dict[str, Any]:
        """Read a header, add its layer and return its values.

        Args:
            at: first byte, from the start of the payload.
            extra: fields to put before its own.

        Raises:
            TruncatedError: it is incomplete; ``TRUNCATED`` is set.
        """
        if len(self.data) - at < layout.size:
            self.truncated(layout.name, at, layout.size)
        values = layout.parse(self.data, at)
        fields = tuple(
            LayerField(
                slot.field.name,
                values[slot.field.name],
                at + slot.start,
                at + slot.end,
                slot.field.text(values[slot.field.name]),
                slot.field.doc,
            )
            for slot in layout.slots
        )
        self.layers.append(Layer(layout.name, layout.title, at, at + layout.size, extra + fields))
        return values

    def extend(self, field: LayerField) -> None:
        """Add a field to the last layer, and extend the layer to the end of the field."""
        layer = self.layers[-1]
        end = max(layer.end, field.end)
        self.layers[-1] = Layer(layer.name, layer.title, layer.start, end, (*layer.fields, field))

    def described(self, kind: int, at: int, end: int) -> bool:
        """Read the content of a packet by a dictionary of the link; return whether there is one for it.

        Args:
            kind: kind of the content, as a number of the link.
            at: first byte after that number.
            end: end of the packet.
        """
        return False

    def add(self, message: RosMessage, *layers: Layer) -> None:
        """Add a message that was read, and the layers of its values."""
        del message, layers

    def sample(self, topic: str, type_name: str, at: int, end: int) -> None:
        """Read a sample of DDS, if the reader knows its type.

        Args:
            topic: ROS name of its topic.
            type_name: ROS name of its type.
            at: first byte of its encapsulation.
            end: end of the sample.
        """
        del topic, type_name, at, end

    def truncated(self, layer: str, at: int, need: int) -> None:
        """Set ``TRUNCATED`` for a layer that is cut, and stop.

        Raises:
            TruncatedError: always.
        """
        self.findings |= Finding.TRUNCATED
        raise TruncatedError(layer, at, need, max(0, len(self.data) - at))


MOST_ENDPOINTS: Final = 1 << 14
"""Most endpoints that are kept; others stay unknown."""
_MOST_HEARD: Final = 1 << 14


class Announced(Protocol):
    """The announcement of an endpoint."""

    @property
    def guid(self) -> bytes:
        """Its globally unique identifier."""

    @property
    def topic(self) -> str:
        """The topic's name on the wire; empty for a participant."""

    @property
    def ros_topic(self) -> str:
        """The topic's ROS name."""

    @property
    def ros_type(self) -> str:
        """The topic's ROS type."""


class Peers:
    """The identity of each endpoint: the first one that it sends.

    SBN distinguishes peers by identity, never by address. It reports a second identity from one endpoint as
    an unknown peer.
    """

    def __init__(self) -> None:
        self._first: dict[tuple[str, int], tuple[tuple[int, int], int]] = {}

    def introduce(self, endpoint: tuple[str, int], identity: tuple[int, int], number: int) -> tuple[int, int]:
        """Return the identity of an endpoint, which is this one if it has none yet.

        Args:
            endpoint: address as text, and port.
            identity: SpacecraftID and ProcessorID.
            number: number of the datagram that contains it.
        """
        return self._first.setdefault(endpoint, (identity, number))[0]

    def identity(self, endpoint: tuple[str, int], number: int) -> tuple[int, int] | None:
        """Return the identity that an endpoint had when a datagram came, or None.

        Messages of one TCP segment have one number: ask for the number before it, so that messages beside the
        first identity are not judged by it, whichever comes first.
        """
        identity, since = self._first.get(endpoint, ((0, 0), number + 1))
        return identity if since <= number else None


class Endpoints:
    """Writers, readers and participants, as they announce themselves.

    The first announcement of each counts, from its datagram on.

    Attributes:
        announced: announcement of each endpoint and the number of its datagram, by GUID.
    """

    def __init__(self) -> None:
        self.announced: dict[bytes, tuple[Announced, int]] = {}
        self._heard: set[bytes] = set()

    def is_new(self, payload: bytes) -> bool:
        """Return whether an announcement is new: announcements are repeated."""
        if payload in self._heard:
            return False
        if len(self._heard) >= _MOST_HEARD:
            self._heard.clear()
        self._heard.add(payload)
        return True

    def learn(self, announcement: Announced, number: int) -> None:
        """Add an announcement in a datagram."""
        entry = self.announced.get(announcement.guid)
        if entry is None and len(self.announced) < MOST_ENDPOINTS:
            self.announced[announcement.guid] = announcement, number
        elif entry is not None and number < entry[1]:
            self.announced[announcement.guid] = entry[0], number

    def topics(self) -> dict[str, str]:
        """Return the type of each announced topic, by ROS names."""
        return {item.ros_topic: item.ros_type for item, _ in self.announced.values() if item.topic}

    def find(self, guid: bytes, number: int | None = None) -> Announced | None:
        """Return the announcement of an endpoint before a datagram, or at any time; None: there is none."""
        entry = self.announced.get(guid)
        return entry[0] if entry and (number is None or entry[1] <= number) else None

    def since(self, guids: Sequence[bytes]) -> Integers:
        """Return the number of the first datagram from which the topic of each endpoint is known, i64.

        It is the largest i64 for an endpoint that is never known.
        """
        never = np.iinfo(np.int64).max
        entries = [self.announced.get(guid) for guid in guids]
        return np.array([item[1] if item and item[0].topic else never for item in entries], np.int64)


class Site(Protocol):
    """The knowledge about the place of a capture, from the mission and from its datagrams so far."""

    @property
    def bridge_ports(self) -> Mask:
        """Ports where flight bridges listen, bool (65536,)."""

    @property
    def identities(self) -> AbstractSet[tuple[int, int]]:
        """Pairs (SpacecraftID, ProcessorID) in the mission."""

    @property
    def peers(self) -> Peers:
        """Identities by endpoint; they grow as datagrams are read, in order."""

    @property
    def endpoints(self) -> Endpoints:
        """Writers and readers that announced themselves; they grow as datagrams are read, in order."""

    @property
    def types(self) -> Any:
        """The ROS types, a ``ros.TypeStore``; None if none are known."""

    @property
    def frames(self) -> Mapping[int, Any]:
        """Format of the frames that carry packets to a port, by port; see ``mission.FramedPort.format``."""

    @property
    def pdu_msg_ids(self) -> NDArray[np.int32]:
        """MsgIds of packets that each hold a unit of a link which is ``in_packets``, i32."""
