"""The requests of clients of a Foxglove server: playback of a recording, and messages to publish as CDR."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Final, Protocol

import msgspec

from edoras_tools.errors import ConfigError, EdorasError
from edoras_tools.ros.types.schema import full_name

if TYPE_CHECKING:
    from collections.abc import Callable

    from edoras_tools.ros import TypeStore


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
        ...

    @property
    def state(self) -> PlaybackState:
        """The current state."""
        ...

    @property
    def waiting(self) -> bool:
        """Whether it waits for the first client."""
        ...

    def control(self, request: PlaybackRequest) -> PlaybackState:
        """Apply a request soon; from any thread; return the state that follows."""
        ...


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
