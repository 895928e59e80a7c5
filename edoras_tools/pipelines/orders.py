"""Where to send, as whom, how fast: what replay and inject are told alike."""

from __future__ import annotations

import socket
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.errors import ConfigError, RouteError
from edoras_tools.model import NO_MSG_ID, Endpoint, Link
from edoras_tools.pipelines.safety import fits, is_loopback
from edoras_tools.sessions.outgoing import ChecksumRule, SequenceRule
from edoras_tools.sessions.pacing import Pacing
from edoras_tools.sessions.profile import MILLISECOND, SECOND
from edoras_tools.wire.sbn import Peer

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.mission import Mission
    from edoras_tools.sessions.outgoing import Outgoing

CAP_HZ: Final = 1000.0
"""Datagrams a second that another machine is sent at most, unless said otherwise."""
_LOOPBACK: Final = "127.0.0.1"
_ANY: Final = "0.0.0.0"  # noqa: S104  which of our addresses telemetry is sent to is not known
_LISTEN_NS: Final = 2 * SECOND
_DEAF_NS: Final = 100 * MILLISECOND
_IDENTITY: Final = Peer(0x42, 3)


class To(StrEnum):
    """Who receives."""

    CI = "ci"
    SBN = "sbn"
    GROUND = "ground"

    @property
    def link(self) -> Link:
        """The link that leads there."""
        return {"ci": Link.CI, "sbn": Link.SBN, "ground": Link.TO}[self.value]


class Role(StrEnum):
    """How to behave as an SBN peer: as stock SBN, as the public bridge, or only as captured."""

    STOCK = "stock"
    BRIDGE = "bridge"
    CAPTURED = "captured"


@dataclass(frozen=True, slots=True)
class Orders:
    """How to send.

    Attributes:
        to: who receives.
        target: where; None: on this machine, at the port that the mission names.
        sender: SBN identity; None: as captured, and the mission's or 66:3 for the session.
        role: SBN behaviour.
        listen: where answers come in; None: on this machine, at the port that the mission names.
        deaf: hear nothing but what an SBN link answers.
        wait_for: gates: ``peer``, ``to-enabled``, ``event:TEXT``; ``nothing`` for none.
        timeout_ns: how long to wait for them.
        linger_ns: how long to listen after the last datagram; None: two seconds, if there is an ear.
        allow: patterns of what may be sent, as ``0x18*``; none allows all.
        speed: of the recording's own times.
        rates: messages a second: (pattern, Hz), and the pattern ``*`` alone is all messages evenly.
        unpaced: as fast as it goes.
        max_rate_hz: never faster; 0: ``CAP_HZ`` to other machines.
        unlimited: no cap.
        yes: another machine is meant.
        sequence: what to do with sequence words.
        checksum: what to do with checksums.
        passes: how often; 0 for no end.
        step: begin in single steps.
    """

    to: To = To.CI
    target: Endpoint | None = None
    sender: Peer | None = None
    role: Role = Role.STOCK
    listen: Endpoint | None = None
    deaf: bool = False
    wait_for: Sequence[str] = ()
    timeout_ns: int = 10 * SECOND
    linger_ns: int | None = None
    allow: Sequence[str] = ()
    speed: float = 1.0
    rates: Sequence[tuple[str, float]] = ()
    unpaced: bool = False
    max_rate_hz: float = 0.0
    unlimited: bool = False
    yes: bool = False
    sequence: SequenceRule = SequenceRule.KEEP
    checksum: ChecksumRule = ChecksumRule.KEEP
    passes: int = 1
    step: bool = False

    def __post_init__(self) -> None:
        """Check once.

        Raises:
            ConfigError: options contradict each other, or a gate is not known.
        """
        if self.unlimited and self.max_rate_hz:
            raise ConfigError("--unlimited lifts the cap that --max-rate sets; name one of them")
        hears = not self.deaf or self.to is To.SBN
        if self.listen is not None and not hears:
            raise ConfigError("--listen and --no-listen exclude each other; name one of them")
        for item in self.wait_for:
            if item not in {"peer", "to-enabled", "nothing"} and not item.startswith("event:"):
                raise ConfigError(
                    f"--wait-for {item!r} is not known; there are peer, to-enabled, event:TEXT and nothing"
                )
            if item == "peer" and not self.has_session:
                raise ConfigError("--wait-for peer needs an SBN session: --to sbn, as stock or bridge")
            if item == "to-enabled" and self.to is not To.CI:
                raise ConfigError("--wait-for to-enabled needs --to ci, which telemetry is enabled through")
            if item != "nothing" and not hears:
                raise ConfigError(f"--wait-for {item} needs an ear: leave --no-listen out")

    @property
    def has_session(self) -> bool:
        """Whether an SBN session is held while sending."""
        return self.to is To.SBN and self.role is not Role.CAPTURED

    @property
    def here(self) -> str:
        """The address of this machine that the target can send to."""
        assert self.target is not None
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.connect((self.target.address, self.target.port))  # sends nothing
                return str(probe.getsockname()[0])
            except OSError:
                return _LOOPBACK

    def placed(self, mission: Mission) -> Orders:
        """Return the orders with what the mission knows, and the defaults, filled in."""
        ground, flight = next(iter(mission.ground), None), next(iter(mission.flight), None)
        to_port, ear = {
            To.CI: (ground.fsw_port, ground.bridge_port) if ground else (1234, 1235),
            To.SBN: (flight.peer_port, flight.udp_receive_port) if flight else (2234, 2236),
            To.GROUND: (ground.bridge_port if ground else 1235, None),
        }[self.to]
        target = self.target or Endpoint(_LOOPBACK, to_port)
        listen = self.listen
        if listen is None and ear is not None:
            listen = Endpoint(_LOOPBACK if is_loopback(target.address) else _ANY, ear)
        if self.deaf and self.to is not To.SBN:
            listen = None
        linger = _DEAF_NS if listen is None or self.deaf else _LISTEN_NS
        gates = self.wait_for or (("peer",) if self.has_session else ())
        return replace(
            self,
            target=target,
            listen=listen,
            linger_ns=linger if self.linger_ns is None else self.linger_ns,
            wait_for=() if "nothing" in gates else gates,
        )

    def identity(self, mission: Mission) -> Peer:
        """Return who to be on the SBN link."""
        flight = next(iter(mission.flight), None)
        return self.sender or (Peer(flight.spacecraft_id, flight.processor_id) if flight else _IDENTITY)

    def pacing(self, out: Outgoing, mission: Mission) -> Pacing:
        """Return how fast these datagrams are sent; streams are MsgIds.

        Raises:
            ConfigError: speeds and rates contradict each other.
            RouteError: a rate is named for nothing that is sent.
        """
        assert self.target is not None
        cap = self.max_rate_hz or (0.0 if is_loopback(self.target.address) else CAP_HZ)
        there = [item for item in np.unique(out.msg_id).tolist() if item != NO_MSG_ID]
        streams: dict[int, float] = {}
        total = 0.0
        for pattern, rate in self.rates:
            if pattern == "*":
                total = rate
                continue
            found = [item for item in there if fits(pattern, item, mission)]
            if not found:
                raise RouteError(f"--rate {pattern}={rate:g}: nothing that is sent fits {pattern!r}")
            streams |= dict.fromkeys(found, rate)
        if total and streams:
            raise ConfigError(
                "--rate HZ spaces all messages evenly; beside it no route has a rate of its own"
            )
        return Pacing(self.speed, total, streams, self.unpaced, 0.0 if self.unlimited else cap)
