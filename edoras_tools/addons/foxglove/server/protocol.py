"""Messages of the Foxglove WebSocket protocol, to bytes and back: no socket, no state.

Text messages are JSON objects with an ``op``. Binary ones start with one byte for their kind; integers are
little-endian. Both subprotocols have the same messages, but playback control needs ``foxglove.sdk.v1``: a
client of the other one takes the state of playback for an error.
https://github.com/foxglove/ws-protocol/blob/main/docs/spec.md

What clients request is here too: the playback of a recording, and messages to publish as CDR.
"""

from __future__ import annotations

import json
import struct
from base64 import b64encode
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol

import msgspec
import numpy as np

from edoras_tools.errors import ConfigError, EdorasError, WireError
from edoras_tools.ros.library import full_name
from edoras_tools.units import SECOND
from edoras_tools.wire.arrays import copy_rows, put_rows

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.io.topics.messages import Records
    from edoras_tools.io.topics.streams import Topic
    from edoras_tools.ros import TypeStore


PLAYBACK_SUBPROTOCOL: Final = "foxglove.sdk.v1"
"""The subprotocol that has playback control."""
SUBPROTOCOLS: Final = (PLAYBACK_SUBPROTOCOL, "foxglove.websocket.v1")
"""Supported subprotocols; the first supported one that a client offers is used."""

_MESSAGE: Final = 1
_MESSAGE_FIELDS: Final = [("operation", "u1"), ("subscription", "<u4"), ("time", "<u8")]
_BINARY: Final = 0x82
"""First byte of a complete binary frame (RFC 6455 5.2)."""
_FRAMES: Final = tuple(
    np.dtype([("first", "u1"), *length, *_MESSAGE_FIELDS])
    for length in (
        [("length", "u1")],
        [("code", "u1"), ("length", ">u2")],
        [("code", "u1"), ("length", ">u8")],
    )
)
"""Heads of frames with a message, by the form of their length (RFC 6455 5.2), with the message's own head."""
_FRAME_BYTES: Final = np.array([head.itemsize for head in _FRAMES])
_FIELD_BYTES: Final = np.dtype(_MESSAGE_FIELDS).itemsize
_LENGTH_CODES: Final = (0, 126, 127)
_SHORTEST: Final = (126, 1 << 16)
"""Smallest payloads in bytes that need the second and the third head."""

_BINARY_SCHEMAS: Final = ("protobuf", "flatbuffer")
"""Encodings of binary schemas, which are sent in Base64."""
_TIME: Final = struct.Struct("<BQ")
_PLAYBACK_STATE: Final = struct.Struct("<BBQf?I")
_PUBLISHED: Final = struct.Struct("<BI")
_CONTROL: Final = struct.Struct("<BBf?QI")
_STATUSES: Final = ("Playing", "Paused", "Buffering", "Ended")
_ERROR: Final = 2
_TEXT_MOST: Final = 1000
"""Maximum characters of a status, and bytes of a request's id, because these repeat clients' texts."""


class Channel(NamedTuple):
    """A topic that a client advertises, with the client's own number."""

    number: int
    topic: str
    type: str
    encoding: str


class Subscribe(NamedTuple):
    """Subscribe to topics: number of the subscription, index of the topic."""

    subscriptions: Sequence[tuple[int, int]]


class Unsubscribe(NamedTuple):
    """End subscriptions, by their numbers."""

    subscriptions: Sequence[int]


class Advertise(NamedTuple):
    """Announce channels to publish on."""

    channels: Sequence[Channel]


class Unadvertise(NamedTuple):
    """End channels, by their numbers."""

    channels: Sequence[int]


class Publish(NamedTuple):
    """Publish a message on the channel with this number."""

    channel: int
    data: bytes


class Control(NamedTuple):
    """Control playback; the answer contains the request's id."""

    request: PlaybackRequest
    request_id: str


class Opening(NamedTuple):
    """Ask for admission.

    Attributes:
        origin: origin of the web page; None: the client is no web page.
        token: token in the URL.
        host: name that it uses for the server.
        path: path of the requested page of the server; empty: it requests a WebSocket.
    """

    origin: str | None
    token: str
    host: str = ""
    path: str = ""


class RequestRefused(NamedTuple):
    """A request was already answered with an error; the reason, as text of any characters."""

    why: str


class Published(NamedTuple):
    """A message was published."""

    channel: Channel
    data: bytes


ClientEvent = Opening | RequestRefused | Published | Control
"""The requests of a client that its server must handle."""
Request = Subscribe | Unsubscribe | Advertise | Unadvertise | Publish | Control


def read_request(message: bytes, *, text: bool) -> Request:
    """Read a text or binary message of a client.

    Raises:
        WireError: it is not a supported request; the text says why.
    """
    try:
        return _read_text(json.loads(message)) if text else _read_binary(message)
    except (ValueError, RecursionError, KeyError, TypeError, AttributeError, struct.error) as error:
        raise WireError(f"not understood: {type(error).__name__} {error}") from None


def _read_text(fields: dict[str, Any]) -> Request:
    match fields["op"]:
        case "subscribe":
            items = fields["subscriptions"]
            return Subscribe([(_number(item["id"]), _number(item["channelId"])) for item in items])
        case "unsubscribe":
            return Unsubscribe([_number(item) for item in fields["subscriptionIds"]])
        case "advertise":
            return Advertise([_channel(item) for item in fields["channels"]])
        case "unadvertise":
            return Unadvertise([_number(item) for item in fields["channelIds"]])
        case other:
            raise WireError(f"this server does not support {_text(other)}")


def _read_binary(message: bytes) -> Request:
    operation = message[:1]
    if operation == b"\x01":
        _, channel = _PUBLISHED.unpack_from(message)
        return Publish(channel, message[_PUBLISHED.size :])
    if operation == b"\x03":
        _, command, speed, seeks, time_ns, length = _CONTROL.unpack_from(message)
        request_id = message[_CONTROL.size :]
        if command > 1 or len(request_id) != length or length > _TEXT_MOST:
            raise WireError("not understood: a malformed playback control request")
        request = PlaybackRequest(command == 0, speed, time_ns if seeks else None)
        return Control(request, request_id.decode())
    raise WireError(f"this server does not support operation {operation.hex() or 'none'}")


def _channel(item: dict[str, Any]) -> Channel:
    texts = (_text(item[key]) for key in ("topic", "schemaName", "encoding"))
    return Channel(_number(item["id"]), *texts)


def _number(value: object) -> int:
    if type(value) is not int or not 0 <= value < 1 << 32:
        raise WireError(f"not understood: {str(value)[:40]!r} is not a 32-bit number")
    return value


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise WireError(f"not understood: {str(value)[:40]!r} is not text")
    return value


def server_info(
    name: str, session: str, *, publish: bool, range_ns: tuple[int, int] | None
) -> dict[str, Any]:
    """Return a server's first message: its name, and the allowed actions of clients.

    Args:
        name: name of the server, shown by clients.
        session: id of the session; clients that reconnect keep their state if it is equal.
        range_ns: start and end of the played recording, ns since 1970; None: the traffic is live.
    """
    info: dict[str, Any] = {"op": "serverInfo", "name": name, "capabilities": ["time"], "sessionId": session}
    if publish:
        info["capabilities"].append("clientPublish")
        info["supportedEncodings"] = list(MESSAGE_ENCODINGS)
    if range_ns is not None:
        info["capabilities"].append("playbackControl")
        for key, time_ns in zip(("dataStartTime", "dataEndTime"), range_ns, strict=True):
            seconds, rest = divmod(time_ns, SECOND)
            info[key] = {"sec": seconds, "nsec": rest}
    return info


def channel(place: int, topic: Topic, definition: str) -> dict[str, Any]:
    """Return the description of a topic: its number, and its schema.

    Args:
        definition: complete ``ros2msg`` text of its type, if the topic has no own schema.
    """
    encoding, schema = topic.schema or ("ros2msg", definition.encode())
    text = b64encode(schema) if encoding in _BINARY_SCHEMAS else schema
    return {
        "id": place,
        "topic": topic.name,
        "encoding": topic.encoding,
        "schemaName": topic.type,
        "schemaEncoding": encoding,
        "schema": text.decode("utf-8", "replace"),
        **({"metadata": dict(topic.metadata)} if topic.metadata else {}),
    }


def advertise(channels: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the message that offers topics, with descriptions from ``channel``."""
    return {"op": "advertise", "channels": channels}


def error_status(text: str, about: str = "") -> dict[str, Any]:
    """Return the message that shows a problem; a later one on the same subject replaces it."""
    status = {"op": "status", "level": _ERROR, "message": text[:_TEXT_MOST]}
    return {**status, "id": about[:_TEXT_MOST]} if about else status


def time(time_ns: int) -> bytes:
    """Return the message that sets a client's clock, ns since 1970."""
    return _TIME.pack(2, time_ns)


def playback_state(state: PlaybackState, request_id: str = "") -> bytes:
    """Return the message with the state of playback, as an answer if a request id is given."""
    name = request_id.encode()
    fields = _STATUSES.index(state.status), state.time_ns, state.speed, state.seeked, len(name)
    return _PLAYBACK_STATE.pack(5, *fields) + name


def message_frames(
    records: Records, rows: NDArray[np.int64], subscriptions: NDArray[np.int64]
) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Return WebSocket frames with messages of topics.

    Args:
        rows: i64 (n,), indices of the messages, at least one.
        subscriptions: i64 (n,), subscription number for each of ``rows``.

    Returns:
        u8, frames in sequence; i64 (n,), end of each.
    """
    length = records.end[rows] - records.start[rows]
    payload = length + _FIELD_BYTES
    kinds = np.searchsorted(_SHORTEST, payload, side="right")
    head_bytes = _FRAME_BYTES[kinds]
    ends = np.cumsum(head_bytes + length)
    starts = ends - head_bytes - length
    frames = np.empty(int(ends[-1]), np.uint8)
    for kind in np.unique(kinds).tolist():
        these = np.flatnonzero(kinds == kind)
        heads = np.empty(len(these), _FRAMES[kind])
        heads["first"], heads["length"] = _BINARY, payload[these]
        if kind:
            heads["code"] = _LENGTH_CODES[kind]
        heads["operation"] = _MESSAGE
        heads["subscription"], heads["time"] = subscriptions[these], records.log_time[rows[these]]
        put_rows(frames, starts[these], heads)
    copy_rows(frames, starts + head_bytes, np.frombuffer(records.data, np.uint8), records.start[rows], length)
    return frames, ends


class PlaybackRequest(msgspec.Struct, frozen=True):
    """A client's request.

    Attributes:
        playing: whether to play, or to pause.
        speed: multiple of the recorded speed.
        seek_ns: time to seek to, ns since 1970; None: do not seek.
    """

    playing: bool
    speed: float
    seek_ns: int | None = None


class PlaybackState(msgspec.Struct, frozen=True):
    """The state of playback.

    Attributes:
        status: ``Playing``, ``Paused``, ``Buffering`` or ``Ended``.
        time_ns: present time in the recording, ns since 1970.
        speed: multiple of the recorded speed.
        seeked: whether it was reached by seeking.
    """

    status: str
    time_ns: int
    speed: float
    seeked: bool = False


class Player(Protocol):
    """Plays a recording, controlled by clients."""

    @property
    def range_ns(self) -> tuple[int, int]:
        """Start and end of the recording, ns since 1970."""

    @property
    def state(self) -> PlaybackState:
        """The current state."""

    @property
    def waiting(self) -> bool:
        """Whether it waits for the first client."""

    def control(self, request: PlaybackRequest) -> PlaybackState:
        """Apply a request soon; from any thread; return the state that follows."""


MESSAGE_ENCODINGS: Final = ("cdr", "json")
"""Encodings that clients may publish in."""


class Publisher:
    """The topics that clients may publish.

    Args:
        unknown: returns the reason why a topic that was not added may not be published.
    """

    def __init__(self, types: TypeStore, unknown: Callable[[str], str]) -> None:
        self._types, self._unknown = types, unknown
        self._topics: dict[str, tuple[str, Callable[[bytes], str | None]]] = {}

    @property
    def topics(self) -> list[str]:
        """The topics that may be published, sorted."""
        return sorted(self._topics)

    def accept(self, topic: str, type_name: str, send: Callable[[bytes], str | None]) -> None:
        """Allow clients to publish a topic.

        Args:
            type_name: type, which ``types`` has.
            send: sends a message as CDR, on the server's thread; returns why it was refused, or None.
        """
        self._topics[topic] = type_name, send

    def refusal(self, topic: str, type_name: str, encoding: str) -> str:
        """Return the reason why a client may not publish such messages on a topic; empty if it may."""
        if topic not in self._topics:
            return self._unknown(topic)
        expected = self._topics[topic][0]
        if full_name(type_name) != full_name(expected):
            return f"{topic} has type {expected}, not {type_name or 'a type without name'}"
        if encoding not in MESSAGE_ENCODINGS:
            return f"{topic}: {encoding} is not understood; publish {' or '.join(MESSAGE_ENCODINGS)}"
        return ""

    def publish(self, topic: str, type_name: str, encoding: str, data: bytes) -> str:
        """Send a client's message; return the reason why it was refused, or an empty text."""
        why = self.refusal(topic, type_name, encoding)
        if why:
            return why
        expected, send = self._topics[topic]
        try:
            return send(self._cdr(expected, encoding, data)) or ""
        except EdorasError as error:
            return f"{topic}: {error}"

    def _cdr(self, type_name: str, encoding: str, data: bytes) -> bytes:
        if encoding == "cdr":
            self._types.decode(type_name, data)
            return data
        try:
            values = json.loads(data)
        except (ValueError, RecursionError) as error:
            raise ConfigError(f"is not JSON: {error}") from None
        if not isinstance(values, dict):
            raise ConfigError("a message must be a JSON object")
        return self._types.encode(type_name, values)
