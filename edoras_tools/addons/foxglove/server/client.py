"""One client of a Foxglove server: its subscriptions, and its queue. No socket, no clock.

1. A message on a subscribed topic is sent, waits, or is dropped; the three counts always add up to all
   messages.
2. It counts as sent when the socket took its last byte. The queue is limited: the server waits for no client.
3. If not all messages of one call fit, the latest are kept. Messages already in the queue stay.
4. Answers are never dropped: a client with too many waiting answers is disconnected.
5. At most one time for the clock waits, and it is the latest.
6. The first clock time of a ``foxglove.websocket.v1`` client is one second early. Lichtblick divides the
   number of messages of a topic by the time that its clock has shown, and warns of a high frequency above 60
   Hz. Without that second it would warn at the second message of a topic with 40 Hz.
7. The reason for refusing messages of a channel is sent at the first one, and again after one was accepted.
"""

from __future__ import annotations

import json
import logging
from collections import deque
from collections.abc import Iterator, Sequence
from http import HTTPStatus
from itertools import islice
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import parse_qs

import msgspec
import numpy as np
from websockets.exceptions import NegotiationError
from websockets.frames import Frame, Opcode
from websockets.http11 import Request, Response
from websockets.protocol import State
from websockets.server import ServerProtocol

from edoras_tools.addons.foxglove.server import page, protocol
from edoras_tools.errors import WireError
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from numpy.typing import NDArray

    SharedFrames = tuple[memoryview, NDArray[np.int64], NDArray[np.int64]]
    """Frames with messages, their ends, and the sizes of the first 0, 1, 2, ... messages; see ``_Piece``."""
    from websockets.typing import Subprotocol

    from edoras_tools.io.topics.messages import Records
    from edoras_tools.model import Endpoint

MOST_MESSAGES: Final = 8192
"""Maximum messages that wait for a client."""
MOST_WAITING_BYTES: Final = 8 << 20
"""Maximum bytes of messages that wait for a client; a single message may be larger."""
MOST_ANSWERS: Final = 1000
"""Maximum answers that wait for a client."""
_MOST_RECEIVED: Final = 1 << 20
"""Maximum bytes of a message from a client."""
_MOST_CHANNELS: Final = 1000
"""Maximum channels that a client may advertise."""
_PIECES: Final = 64
"""Maximum pieces given to a socket at once."""
_TLS_HANDSHAKE: Final = 0x16
"""First byte of a TLS connection (RFC 8446 5.1)."""
_GOING_AWAY: Final = 1001
_DATA: Final = frozenset({Opcode.TEXT, Opcode.BINARY, Opcode.CONT})
_SILENT: Final = logging.getLogger("edoras_tools.websocket")
_SILENT.disabled = True  # Python prints reports of loggers without a handler: every failed handshake


class _Piece(msgspec.Struct):
    """A part of the output: an answer, or frames with messages.

    Attributes:
        ends: i64 (n,), end of each message in the bytes; None for an answer.
        sizes: i64 (n + 1,), size of the first 0, 1, 2, ... messages without their heads.
        bytes_sent: number of bytes taken by the socket.
        sent: number of messages taken completely.
    """

    data: memoryview
    ends: NDArray[np.int64] | None = None
    sizes: NDArray[np.int64] | None = None
    bytes_sent: int = 0
    sent: int = 0


class FoxgloveClient:
    """A client, from connecting to closing.

    Args:
        address: address of the other end.
        controls: whether it may control playback.

    Attributes:
        address: as given.
        opened: whether it was admitted.
        failed: whether to disconnect it now.
        ending: whether to disconnect it when everything is sent.
        dropped: number of messages dropped because it was too slow.
        published: number of messages accepted from it.
        refused: number of messages refused.
    """

    def __init__(self, address: Endpoint, *, publishes: bool, controls: bool) -> None:
        self.address, self._publishes, self._controls = address, publishes, controls
        self._websocket = ServerProtocol(
            select_subprotocol=_choose_subprotocol, max_size=_MOST_RECEIVED, logger=_SILENT
        )
        self._response: Response | None = None
        self._plain = True
        """Whether all requests so far were for pages, on a connection that is kept."""
        self._text, self._fragments = False, bytearray()
        self._subscription = np.zeros(0, np.int64)
        self._channels: dict[int, protocol.Channel] = {}
        self._told: set[tuple[int, str]] = set()
        self._queue: deque[_Piece] = deque()
        self._clock: _Piece | None = None
        self._clock_ns = -1
        self._answers = self._waiting = self._waiting_bytes = self._sent = self._sent_bytes = 0
        self.dropped = self.published = self.refused = 0
        self.opened = self.failed = self.ending = self._answered = False

    @property
    def plays(self) -> bool:
        """Whether it is a client that controls playback, and receives its state."""
        return self._controls and self._websocket.subprotocol == protocol.PLAYBACK_SUBPROTOCOL

    @property
    def subscriptions(self) -> int:
        """Number of topics that it has subscribed to."""
        return int(np.count_nonzero(self._subscription >= 0))

    @property
    def due(self) -> bool:
        """Whether something must be sent, or it must be disconnected."""
        return bool(self._queue) or self.ending or self.failed

    @property
    def connected(self) -> bool:
        """Whether it was admitted, and has not left."""
        return self.opened and not self.failed and self._websocket.state is State.OPEN

    def receive(self, data: bytes) -> list[protocol.ClientEvent]:
        """Handle received bytes, ``b""`` at the end of the connection; return the events for the server."""
        # Much faster than a WebSocket handshake; each browser sends such a request once a second.
        request = page.plain_request(data) if self._plain and not self._queue else None
        self._plain = request is not None
        if request is not None:
            return [_opening(*request)]
        if data:
            self._websocket.receive_data(data)
        else:
            self._websocket.receive_eof()
        events = [event for item in self._websocket.events_received() for event in self._read(item)]
        wrong = self._websocket.handshake_exc
        if wrong is not None and data and not self._answered:
            self._answered = True
            reason = "it speaks TLS; use http:// or ws://" if data[0] == _TLS_HANDSHAKE else str(wrong)
            events.append(protocol.RequestRefused(reason))
        self._collect()
        return events

    def accept(self, topics: int, answers: Sequence[dict[str, Any] | bytes]) -> None:
        """Admit it, with this number of topics, and send these answers first."""
        assert self._response is not None
        self._subscription = np.full(topics, -1, np.int64)
        self._websocket.send_response(self._response)
        self.opened = True
        self._collect()
        for answer in answers:
            self.tell(answer)

    def refuse(self, status: int, text: str) -> None:
        """Refuse it with an HTTP status and a line of text."""
        self._answered = True
        self._websocket.send_response(self._websocket.reject(status, f"{text}\n"))
        self._collect()

    def serve(self, answer: page.HttpAnswer) -> None:
        """Answer it with a page instead of a WebSocket."""
        self._answered = True
        self._append(_Piece(memoryview(answer.whole("keep-alive" if self._plain else "close"))))
        self.ending = not self._plain

    def close(self) -> None:
        """Send a close frame, after everything that waits."""
        if self.connected:
            self._websocket.send_close(_GOING_AWAY)
            self._collect()

    def add_topic(self) -> None:
        """Allow it to subscribe to one more topic."""
        self._subscription = np.append(self._subscription, -1)

    def wants(self, place: int) -> bool:
        """Return whether it has subscribed to a topic."""
        return bool(self._subscription[place] >= 0)

    def give(self, records: Records, shared: dict[tuple[bytes, int], SharedFrames] | None = None) -> None:
        """Queue messages of the topics that it subscribed to; if not all fit, the latest.

        Args:
            shared: frames of these records made for other clients: most clients have the same subscriptions.
        """
        subscription = self._subscription[records.channel_id]
        rows = np.flatnonzero(subscription >= 0)
        if not len(rows) or not self.connected:
            return
        length = records.end[rows] - records.start[rows]
        count = self._fitting(length)
        self.dropped += len(rows) - count
        if count:
            shared = {} if shared is None else shared
            key = subscription.tobytes(), count
            if key not in shared:
                rows, length = rows[-count:], length[-count:]
                frames, ends = protocol.message_frames(records, rows, subscription[rows])
                shared[key] = frames.data, ends, np.concatenate([[0], np.cumsum(length)])
            self._queue.append(_Piece(*shared[key]))
            self._waiting += count
            self._waiting_bytes += int(shared[key][2][-1])

    def tell(self, answer: dict[str, Any] | bytes) -> None:
        """Queue an answer, as text or binary message."""
        if self.connected:
            if isinstance(answer, bytes):
                self._websocket.send_binary(answer)
            else:
                self._websocket.send_text(json.dumps(answer).encode())
            self._collect()

    def tell_time(self, time_ns: int) -> None:
        """Send a time for its clock, ns since 1970."""
        if self.connected and time_ns != self._clock_ns:
            if self._clock_ns < 0 and self._websocket.subprotocol != protocol.PLAYBACK_SUBPROTOCOL:
                self._append(_Piece(_clock_frame(max(time_ns - SECOND, 0))))
            self._clock_ns = time_ns
            data = _clock_frame(time_ns)
            if self._clock is not None and not self._clock.bytes_sent:
                self._clock.data = data
            else:
                self._clock = _Piece(data)
                self._append(self._clock)

    def answer(self, channel: protocol.Channel, why: str) -> None:
        """Count a message that it published; if it was refused, send the reason, unless already sent."""
        if why:
            self.refused += 1
            self._tell_once(channel.number, why, channel.topic)
        else:
            self.published += 1
            self._told = {item for item in self._told if item[0] != channel.number}

    def to_send(self) -> list[memoryview]:
        """Return the pieces for the socket; call ``advance`` afterwards."""
        return [piece.data[piece.bytes_sent :] for piece in islice(self._queue, _PIECES)]

    def advance(self, count: int) -> None:
        """Record that a socket took this many bytes of ``to_send``."""
        while count:
            piece = self._queue[0]
            step = min(count, len(piece.data) - piece.bytes_sent)
            piece.bytes_sent += step
            count -= step
            if piece.ends is not None and piece.sizes is not None:
                sent = int(np.searchsorted(piece.ends, piece.bytes_sent, side="right"))
                size = int(piece.sizes[sent] - piece.sizes[piece.sent])
                self._sent += sent - piece.sent
                self._waiting -= sent - piece.sent
                self._sent_bytes += size
                self._waiting_bytes -= size
                piece.sent = sent
            if piece.bytes_sent == len(piece.data):
                self._queue.popleft()
                self._answers -= piece.ends is None
                if piece is self._clock:
                    self._clock = None

    def summary(self) -> dict[str, Any]:
        """Return counts of the messages that it subscribed to, and of those that it published."""
        return {
            "address": str(self.address),
            "sent": self._sent,
            "bytes": self._sent_bytes,
            "dropped": self.dropped,
            "waiting": self._waiting,
            "published": self.published,
            "refused": self.refused,
        }

    def _fitting(self, length: NDArray[np.int64]) -> int:
        """Return the number of the last messages that can be queued."""
        latest = np.cumsum(length[::-1][: MOST_MESSAGES - self._waiting])
        fits = int(np.searchsorted(latest, MOST_WAITING_BYTES - self._waiting_bytes, side="right"))
        return fits if self._waiting else max(fits, 1)

    def _read(self, item: Request | Response | Frame) -> Iterator[protocol.ClientEvent]:
        """Handle a request or a frame; yield events that only the server can answer."""
        if isinstance(item, Request):
            self._response = self._websocket.accept(item)
            if self._response.status_code in {HTTPStatus.SWITCHING_PROTOCOLS, HTTPStatus.UPGRADE_REQUIRED}:
                self._answered = True
                host, origin = (" ".join(item.headers.get_all(name)) for name in ("Host", "Origin"))
                opening = _opening(item.path, host, origin or None)
                socket = self._response.status_code == HTTPStatus.SWITCHING_PROTOCOLS
                yield opening._replace(path="") if socket else opening
            else:
                self._websocket.send_response(self._response)  # the error is in handshake_exc
        elif isinstance(item, Frame) and item.opcode in _DATA and self.connected:
            if item.opcode is not Opcode.CONT:
                self._text, self._fragments = item.opcode is Opcode.TEXT, bytearray()
            self._fragments += item.data
            if item.fin:
                try:
                    yield from self._obey(protocol.read_request(bytes(self._fragments), text=self._text))
                except WireError as error:
                    self.tell(protocol.error_status(str(error)))

    def _obey(self, request: protocol.Request) -> Iterator[protocol.ClientEvent]:
        match request:
            case protocol.Subscribe(wanted):
                for number, place in wanted:
                    self._subscribe(number, place)
            case protocol.Unsubscribe(numbers):
                self._subscription[np.isin(self._subscription, numbers)] = -1
            case protocol.Control():
                if not self._controls:
                    raise WireError("this server does not support playbackControl")
                yield request
            case protocol.Advertise(channels):  # a refusal is sent at the channel's first message
                if len(self._channels) + len(channels) > _MOST_CHANNELS:
                    raise WireError(f"no client may advertise more than {_MOST_CHANNELS} channels")
                self._channels |= {channel.number: channel for channel in channels}
            case protocol.Unadvertise(numbers):
                for number in numbers:
                    self._channels.pop(number, None)
                self._told = {item for item in self._told if item[0] not in numbers}
            case protocol.Publish(number) if not self._publishes:
                self.refused += 1
                self._tell_once(number, "this server does not support clientPublish")
            case protocol.Publish(number, data):
                if number not in self._channels:
                    raise WireError(f"channel {number} was not advertised")
                yield protocol.Published(self._channels[number], data)

    def _tell_once(self, number: int, why: str, about: str = "") -> None:
        """Send the reason why a message of a channel was refused, unless it was sent."""
        if (number, why) not in self._told and len(self._told) < _MOST_CHANNELS:
            self._told.add((number, why))
            self.tell(protocol.error_status(why, about))

    def _subscribe(self, number: int, place: int) -> None:
        if place >= len(self._subscription):
            self.tell(protocol.error_status(f"there is no channel {place} to subscribe to"))
        elif self.wants(place) or number in self._subscription:
            text = f"channel {place} or subscription {number} is subscribed already"
            self.tell(protocol.error_status(text))
        else:
            self._subscription[place] = number

    def _collect(self) -> None:
        """Queue the output of the WebSocket."""
        for data in self._websocket.data_to_send():
            if data:
                self._append(_Piece(memoryview(data)))
            else:
                self.ending = True

    def _append(self, answer: _Piece) -> None:
        self._queue.append(answer)
        self._answers += 1
        self.failed |= self._answers > MOST_ANSWERS


def _opening(path: str, host: str, origin: str | None) -> protocol.Opening:
    """Return the parts of a request for a page."""
    path, _, query = path.partition("?")
    # ws://HOST:PORT/?token=...: in the handshake a web page can only choose the URL.
    return protocol.Opening(origin, parse_qs(query).get("token", [""])[-1], host, path)


def _choose_subprotocol(_: ServerProtocol, offered: Sequence[Subprotocol]) -> Subprotocol:
    """Return the first supported subprotocol that a client offers."""
    for name in offered:
        if name in protocol.SUBPROTOCOLS:
            return name
    names = " or ".join(protocol.SUBPROTOCOLS)
    raise NegotiationError(f"it offers {', '.join(offered) or 'no subprotocol'}, not {names}")


def _clock_frame(time_ns: int) -> memoryview:
    return memoryview(Frame(Opcode.BINARY, protocol.time(time_ns)).serialize(mask=False))
