"""Sends messages of RACS2 again: as the cFS side (the WebSocket client), or as the ROS side (its server).

``BridgeTopics`` makes the messages of RACS2 in the form of its ROS side, and messages with the values in
their bodies. Its rules:

1. ``racs2_msg/msg/RACS2UserMsg`` is the type that the public ROS side publishes on the topic that a header
   names, and that it takes from ``/RACS2Bridge`` to send to cFS.
2. If a body is a ``RACS2Bridge_std_msgs``, its values get topics of ours below ``/racs2``, each field with
   the type of ``std_msgs`` that the public ``.proto`` file names beside it.
3. Names come from the network: a name that is no valid ROS name, or that has another use, gets no topic, and
   there are at most ``MOST_TOPICS`` topics. Whole datagrams are recorded all the same.
"""

from __future__ import annotations

import base64
import hashlib
import os
import re
import selectors
import socket
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from edoras_tools.addons.racs2 import link as racs2
from edoras_tools.addons.racs2.link import RACS2, Opcode, WebSocketFraming
from edoras_tools.errors import CaptureError, FieldError, OnFailure
from edoras_tools.io.net.sockets import address_of, bind, local_endpoint, resolve
from edoras_tools.io.net.transmit import ANSWER_WITHIN_S, SendStatistics, StreamTransmitter
from edoras_tools.io.topics.messages import RECORD, Messages, bodies_of, whole_messages
from edoras_tools.links.protocol import LinkSending, SendingSession
from edoras_tools.model import Columns, Endpoint, Finding, Link, PacketBatch
from edoras_tools.wire import cfe
from edoras_tools.wire.arrays import Integers, Mask, Places, by_value, copy_rows, gather
from edoras_tools.wire.envelope import ENCAPSULATION

if TYPE_CHECKING:
    from edoras_tools.links.doors import Framing, TopicSpace

_REQUEST: Final = (
    "GET / HTTP/1.1\r\nHost: racs2\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    f"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Protocol: {racs2.SUBPROTOCOL}\r\nSec-WebSocket-Key: "
)
_SWITCH: Final = (
    b"HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Accept: "
)
_MAGIC: Final = b"258EAFA5-E914-47DA-95CA-C5AB0DC85B11"
_HEADER: Final = re.compile(rb"(?m)^([^:\r\n]+):([^\r\n]*)")
_NORMAL: Final = (1000).to_bytes(2, "big")


def frame(opcode: Opcode, payload: bytes) -> bytes:
    """Return a frame from a server, which is not masked (section 5.2)."""
    size = len(payload)
    if size < 126:
        head = bytes([size])
    elif size < 1 << 16:
        head = b"\x7e" + size.to_bytes(2, "big")
    else:
        head = b"\x7f" + size.to_bytes(8, "big")
    return bytes([0x80 | opcode]) + head + payload


def masked_frame(opcode: Opcode, payload: bytes) -> bytes:
    """Return a frame from a client, which is masked (section 5.3)."""
    bare, key = frame(opcode, payload), os.urandom(4)
    at = len(bare) - len(payload)
    return bytes([bare[0], 0x80 | bare[1]]) + bare[2:at] + key + mask(payload, key)


def mask(payload: bytes, key: bytes) -> bytes:
    """Mask a payload, or remove its mask: both are XOR with the 4-byte key."""
    octets = np.frombuffer(payload, np.uint8)
    return (octets ^ np.resize(np.frombuffer(key, np.uint8), len(octets))).tobytes()


class BridgeClient(SendingSession):
    """The cFS side's connection: the handshake, answers to pings, the closing frame."""

    def __init__(self) -> None:
        self.connected = False
        self.next_ns = 0
        self._refusal = ""

    def due(self, *, now: int) -> Iterable[bytes]:
        """Return the request that makes the connection a WebSocket."""
        self.next_ns = SendingSession.next_ns
        return (f"{_REQUEST}{base64.b64encode(os.urandom(16)).decode()}\r\n\r\n".encode(),)

    def answer(self, data: bytes, *, now: int) -> Iterable[bytes]:
        """Take the server's answer to the request, or one of its frames."""
        if data.startswith(b"HTTP/"):
            self.connected = data.split(b" ", 2)[1] == b"101"
            self._refusal = "" if self.connected else data.partition(b"\r\n")[0].decode("ascii", "replace")
        elif data[0] & 15 == Opcode.PING:  # a server's frames are unmasked; a ping's length is one byte
            return (masked_frame(Opcode.PONG, data[2:]),)
        return ()

    def goodbye(self) -> Iterable[bytes]:
        """Close the WebSocket."""
        return (masked_frame(Opcode.CLOSE, _NORMAL),) if self.connected else ()

    def notes(self) -> Iterable[str]:
        """Return why the server refused the WebSocket."""
        return (f"the server refused: {self._refusal}",) if self._refusal else ()


class BridgeServer(SendingSession):
    """The ROS side's connection: the answer to the handshake and to pings, the closing frame.

    Attributes:
        place: address and port where it listens, as text.
    """

    def __init__(self) -> None:
        self.connected, self.place, self._refusal = False, "", ""

    def answer(self, data: bytes, *, now: int) -> Iterable[bytes]:
        """Take the client's handshake, or one of its frames."""
        if data.startswith(b"GET "):
            head = {name.strip().lower(): value.strip() for name, value in _HEADER.findall(data)}
            if head.get(b"upgrade", b"").lower() != b"websocket" or b"sec-websocket-key" not in head:
                self._refusal = "what connected asked for no WebSocket"
                return (b"HTTP/1.1 426 Upgrade Required\r\nContent-Length: 0\r\n\r\n",)
            self.connected = True
            proof = hashlib.sha1(head[b"sec-websocket-key"] + _MAGIC, usedforsecurity=False).digest()
            offered = head.get(b"sec-websocket-protocol", b"").partition(b",")[0].strip()
            protocol = b"Sec-WebSocket-Protocol: " + offered + b"\r\n" if offered else b""
            return (_SWITCH + base64.b64encode(proof) + b"\r\n" + protocol + b"\r\n",)
        if data[0] & 15 == Opcode.PING:  # a client's frames are masked; a ping's length is one byte
            return (frame(Opcode.PONG, mask(data[6:], data[2:6])),)
        return ()

    def absence(self) -> str:
        """Return why no cFS side is connected."""
        return self._refusal or f"no cFS side connected to the WebSocket server at {self.place}"

    def goodbye(self) -> Iterable[bytes]:
        """Close the WebSocket."""
        return (frame(Opcode.CLOSE, _NORMAL),) if self.connected else ()


class ServerTransmitter(StreamTransmitter):
    """A server of one client: the first that connects; later ones get no answer. It is a context manager.

    Args:
        place: endpoint to listen at.
        framing: framing that cuts the data of the client.

    Raises:
        CaptureError: it cannot listen there.
    """

    def __init__(self, place: Endpoint, framing: Framing) -> None:
        self.statistics = SendStatistics()
        self._framing, self._name, self._rest = framing, f"TCP {place}", b""
        family, address = resolve(place, self._name)
        self._socket = socket.socket(family, socket.SOCK_STREAM)
        self._selector = selectors.DefaultSelector()
        self._listens = True
        with OnFailure(self.__exit__):
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            bind(self._socket, address, self._name, "choose another with --target")
            self._socket.listen(1)
        self._selector.register(self._socket, selectors.EVENT_READ)
        self.target = self.local = local_endpoint(self._socket)

    def __exit__(self, *_: object) -> None:
        self._selector.close()
        self._socket.close()

    def fileno(self) -> int:
        """Return a descriptor that becomes readable when a client connects, and when it sends data."""
        return self._selector.fileno()

    def receive(self) -> list[tuple[bytes, Endpoint]]:
        """Accept the client, or return its complete messages.

        Raises:
            CaptureError: it closed the connection, or sends something else.
        """
        if self._listens and self._selector.select(0):
            self._accept()
        return [] if self._listens else super().receive()

    def send(self, payload: bytes | memoryview) -> bool:
        """Send one message; see ``StreamTransmitter``.

        Raises:
            CaptureError: there is no client, the connection is broken, or the client does not read.
        """
        if self._listens:
            raise CaptureError(f"{self._name}: nobody has connected")
        return super().send(payload)

    def _accept(self) -> None:
        """Accept the client, and use its socket in place of the listening one."""
        listener, (self._socket, address) = self._socket, self._socket.accept()
        self._selector.unregister(listener)
        listener.close()
        self._selector.register(self._socket, selectors.EVENT_READ)
        self._socket.settimeout(ANSWER_WITHIN_S)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._listens = False
        self.target = address_of(self._socket.family, address).endpoint
        self._name = f"TCP {self.target}"


class _Sending(LinkSending):
    """Messages of one direction, in new frames."""

    port = racs2.BRIDGE_WEBSOCKET_PORT
    renews = True
    up = False
    instead = "edoras replay sends recorded messages; a new one comes from a node of cFS or ROS"

    def __init__(self, link: Link) -> None:
        super().__init__(link)
        self._other_way = 0

    def outgoing_rows(self, batch: PacketBatch, columns: Columns) -> Mask:
        """Return which messages go in this direction: to ROS with a topic's name, to cFS with a MsgId."""
        own = super().outgoing_rows(batch, columns)
        this_way: Mask = own & (
            (gather(batch.data, batch.offset, 1)[:, 0] <= cfe.HIGHEST_MSG_ID >> 8) == self.up
        )
        self._other_way += int(np.count_nonzero(own & ~this_way))
        text = "go to ROS: --to racs2" if self.up else "go to cFS: --to racs2:up"
        self.refusals = [f"{self._other_way:,} of them {text} sends those"] if self._other_way else []
        return this_way

    def renew(self, messages: Sequence[bytes], time_ns: Integers) -> tuple[list[bytes], Integers]:
        """Put each message in a frame."""
        make = frame if self.up else masked_frame
        return [make(Opcode.BINARY, item) for item in messages], time_ns


class BridgeSending(_Sending):
    """Messages to ROS."""

    framing = WebSocketFraming()

    def __init__(self, link: Link) -> None:
        super().__init__(link)
        self.session = BridgeClient()


class ServerSending(_Sending):
    """Messages to cFS, whose side connects to this program."""

    own_transport = up = True

    def __init__(self, link: Link) -> None:
        super().__init__(link)
        self._server = self.session = BridgeServer()

    def transmitter(self, target: Endpoint) -> ServerTransmitter:
        """Listen at the target."""
        transmitter = ServerTransmitter(target, WebSocketFraming())
        self._server.place = str(transmitter.local)
        return transmitter


MOST_TOPICS: Final = 256
TO_CFS_TOPIC: Final = "/RACS2Bridge"
"""The topic that the public ROS side subscribes to."""
USER_TYPE: Final = "racs2_msg/msg/RACS2UserMsg"
VALUES_PREFIX: Final = "/racs2"
_RESERVED: Final = ("/edoras/", "/cfs/", "/fprime/", f"{VALUES_PREFIX}/", "/tf/")
"""Beginnings of topic names that this package uses, and ``/tf``."""
_NAME: Final = re.compile(rb"/?(?!.*__)[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
_CUT: Final = np.uint32(Finding.FRAGMENT | Finding.CAPTURE_CUT)
_USER: Final = np.dtype(
    [
        *RECORD,
        ("encapsulation", "<u4"),
        ("cfs_message_id", "<u4"),
        ("body_data_length", "<u4"),
        ("count", "<u4"),
    ]
)
"""``RACS2UserMsg`` as a record, up to the bytes of its body."""


class _Target(NamedTuple):
    """Where messages go, and the rows of these messages.

    Attributes:
        topic: topic of the messages themselves.
        values: prefix of the topics of their values.
        msg_id: MsgId in cFS; 0 for messages from cFS to ROS.
        rows: i64, rows of the batch.
    """

    topic: str
    values: str
    msg_id: int
    rows: Places


class BridgeTopics:
    """Makes messages of what the bridges send; see :class:`~edoras_tools.links.doors.OwnTopics`."""

    def __init__(self, space: TopicSpace) -> None:
        self._space, self._other_topics = space, space.used_names()
        self._known: set[str] = set()

    def offer(self) -> None:
        """Do nothing: the messages themselves name the topics."""

    def messages(self, batch: PacketBatch, columns: Columns) -> Iterator[Messages]:
        """Yield the messages of a batch; they hold no references to its data."""
        for target in _targets(batch, columns):
            if self._may_have(target.topic):
                yield _user_messages(target, batch, self._place(target.topic, USER_TYPE))
            for topic, type_name, values in _values(target, batch):
                if self._may_have(topic):
                    yield self._value_messages(type_name, values, batch, self._place(topic, type_name))

    def _place(self, topic: str, type_name: str) -> int:
        return self._space.place(topic, type_name, {"link": RACS2.label})

    def _may_have(self, topic: str) -> bool:
        """Return whether a topic is kept; there are at most ``MOST_TOPICS``, and none of another maker."""
        if topic not in self._known and topic not in self._other_topics and len(self._known) < MOST_TOPICS:
            self._known.add(topic)
        return topic in self._known

    def _value_messages(
        self, type_name: str, values: list[tuple[int, Any]], batch: PacketBatch, channel_id: int
    ) -> Messages:
        """Return a ``std_msgs`` message for each value; a value that the type cannot hold is left out."""
        bodies, rows = [], []
        for row, value in values:
            try:
                cdr = self._space.types.encode(type_name, {"data": value})
            except FieldError:  # a varint may be longer than its field
                continue
            bodies.append(cdr[ENCAPSULATION.size :])
            rows.append(row)
        where = np.array(rows, np.int64)
        return bodies_of(bodies, batch.time_ns[where].tolist(), channel_id, where)


def _targets(batch: PacketBatch, columns: Columns) -> Iterator[_Target]:
    """Yield the whole messages of a batch, by destination; messages without a valid ROS name are left out."""
    rows = np.flatnonzero((columns.link == RACS2) & (columns.findings & _CUT == 0))
    headers = gather(batch.data, batch.offset[rows], racs2.BRIDGE_HEADER)
    names, which = np.unique(headers.view(f"S{racs2.BRIDGE_HEADER}")[:, 0], return_inverse=True)
    for place, members in by_value(which):
        msg_id = int.from_bytes(headers[members[0], :2].tobytes(), "big")
        if msg_id <= cfe.HIGHEST_MSG_ID:
            yield _Target(TO_CFS_TOPIC, f"{VALUES_PREFIX}/msg_id_{msg_id:04x}", msg_id, rows[members])
            continue
        name = bytes(names[place]).partition(b"\0")[0]
        if _NAME.fullmatch(name):
            topic = f"/{name.decode().removeprefix('/')}"
            if topic != TO_CFS_TOPIC and not f"{topic}/".startswith(_RESERVED):
                yield _Target(topic, VALUES_PREFIX + topic, 0, rows[members])


def _user_messages(target: _Target, batch: PacketBatch, channel_id: int) -> Messages:
    """Return a ``RACS2UserMsg`` for each message; its length is that of the transferred body."""
    rows, log_time = target.rows, batch.time_ns[target.rows]
    size = batch.length[rows].astype(np.int64) - racs2.BRIDGE_HEADER
    start = np.cumsum(size) - size
    pool = np.empty(int(size.sum()), np.uint8)
    copy_rows(pool, start, batch.data, batch.offset[rows] + racs2.BRIDGE_HEADER, size)
    heads = np.zeros(len(rows), _USER)
    heads["cfs_message_id"], heads["body_data_length"] = target.msg_id, size
    heads["count"] = size
    return whole_messages(rows, heads, channel_id, 0, log_time, log_time, (pool, start, size))


def _values(target: _Target, batch: PacketBatch) -> Iterator[tuple[str, str, list[tuple[int, Any]]]]:
    """Yield the topic, the type, and the (row, value) pairs of each field in the bodies."""
    by_name: dict[str, list[tuple[int, Any]]] = {}
    for row in target.rows.tolist():
        start = int(batch.offset[row])
        body = batch.data[start + racs2.BRIDGE_HEADER : start + int(batch.length[row])].tobytes()
        for name, value in (racs2.std_msgs_values(body) or {}).items():
            by_name.setdefault(name, []).append((row, value))
    for name, values in by_name.items():
        yield f"{target.values}/{name}", f"std_msgs/msg/{racs2.BODY_FIELDS[name].type}", values
