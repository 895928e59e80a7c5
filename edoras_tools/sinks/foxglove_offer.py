"""What a Foxglove server offers its clients, and what it asks of whoever runs it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

from edoras_tools.websocket import Guard

if TYPE_CHECKING:
    from collections.abc import Mapping


@dataclass(frozen=True, slots=True)
class PlaybackRequest:
    """What a client wants of playback.

    Attributes:
        playing: go on, or pause.
        speed: times the recorded speed.
        seek_ns: go there, ns since 1970; None: stay.
    """

    playing: bool
    speed: float
    seek_ns: int | None = None


@dataclass(frozen=True, slots=True)
class PlaybackState:
    """Where playback is.

    Attributes:
        status: ``Playing``, ``Paused``, ``Buffering`` or ``Ended``.
        time_ns: ns since 1970.
        speed: times the recorded speed.
        seeked: it jumped here.
    """

    status: str
    time_ns: int
    speed: float
    seeked: bool = False


class Player(Protocol):
    """Plays a recording back, and obeys."""

    @property
    def range_ns(self) -> tuple[int, int]:
        """When the recording starts and ends, ns since 1970."""
        ...

    @property
    def state(self) -> PlaybackState:
        """Where it is."""
        ...

    def control(self, request: PlaybackRequest) -> PlaybackState:
        """Do what is wanted soon, on any thread; return where it will be."""
        ...


class Publisher(Protocol):
    """Takes what clients publish, on any thread."""

    def refusal(self, topic: str, type_name: str, encoding: str) -> str:
        """Return why a client may not publish there; empty where it may."""

    def publish(self, topic: str, type_name: str, encoding: str, data: bytes) -> str:
        """Take a message; return why not, empty where it was taken."""


@dataclass(frozen=True, slots=True)
class Offer:
    """What all clients are offered.

    Attributes:
        name: of the server, as clients show it.
        definitions: complete ``ros2msg`` texts by type.
        publisher: takes what clients publish; None: they may not.
        player: plays a recording back; None: the traffic is live.
        session: clients that come again keep what they have, if it is the same still.
        guard: who may come at all.
    """

    name: str
    definitions: Mapping[str, str]
    publisher: Publisher | None = None
    player: Player | None = None
    session: str = ""
    guard: Guard = field(default_factory=Guard)
