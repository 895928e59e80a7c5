"""Playback of a recording, controlled by clients of a Foxglove server."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True)
class PlaybackRequest:
    """A client's request.

    Attributes:
        playing: play, or pause.
        speed: multiple of the recorded speed.
        seek_ns: time to seek to, ns since 1970; None: do not seek.
    """

    playing: bool
    speed: float
    seek_ns: int | None = None


@dataclass(frozen=True, slots=True)
class PlaybackState:
    """The state of playback.

    Attributes:
        status: ``Playing``, ``Paused``, ``Buffering`` or ``Ended``.
        time_ns: ns since 1970.
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
