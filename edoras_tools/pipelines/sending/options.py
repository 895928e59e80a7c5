"""Options that replay and inject share: target, identity, pace and receiving; and checks of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.cfs.names import message_name
from edoras_tools.errors import ConfigError, RouteError
from edoras_tools.io.net.sockets import LOOPBACK, is_loopback, own_address, parse_endpoint
from edoras_tools.links.protocol import LinkSending
from edoras_tools.links.table import carrying, links
from edoras_tools.model import NO_MSG_ID, OTHER, Endpoint, Link, Peer
from edoras_tools.older import StrEnum
from edoras_tools.sessions.outgoing import ChecksumRule, Outgoing, SequenceRule
from edoras_tools.sessions.pacing import Pacing
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire.arrays import numbered
from edoras_tools.wire.cfe import STANDARD, Headers

if TYPE_CHECKING:
    from pathlib import Path

    from edoras_tools.links.doors import Site
    from edoras_tools.mission import Mission


def names_of(msg_id: int, mission: Mission) -> list[str]:
    """Return all names of a MsgId: hex, cFE's, topics with and without the leading slash, keys."""
    names = [f"0x{msg_id:04x}", f"0x{msg_id:x}", message_name(mission.msg_ids.standard(msg_id)) or "-"]
    for route in mission.routes:
        if route.msg_id == msg_id:
            names += [route.topic, route.topic.removeprefix("/"), route.key]
    return names


def fits(pattern: str, msg_id: int, mission: Mission) -> bool:
    """Return whether a shell pattern matches a MsgId (e.g. ``0x18*``), its topic or its key."""
    pattern = pattern.lower() if pattern[:2].lower() == "0x" else pattern
    return any(fnmatchcase(name, pattern) for name in names_of(msg_id, mission))


def called(msg_id: int, mission: Mission) -> str:
    """Return a MsgId with its topic, for the user."""
    if msg_id == NO_MSG_ID:
        return "datagrams without a MsgId"
    topic = next((route.topic for route in mission.routes if route.msg_id == msg_id), "")
    return f"0x{msg_id:04x}{f' ({topic})' if topic else ''}"


def check_allowed(out: Outgoing, allow: Sequence[str], mission: Mission) -> None:
    """Refuse datagrams that are not on the allow-list; an empty list allows all.

    Raises:
        ConfigError: a datagram is not on the list.
    """
    refused = [
        item
        for item in (np.unique(out.msg_id).tolist() if allow else ())
        if item == NO_MSG_ID or not any(fits(pattern, item, mission) for pattern in allow)
    ]
    if refused:
        raise ConfigError(
            f"not on the allow-list ({', '.join(allow)}): "
            f"{', '.join(called(item, mission) for item in refused)}; nothing was sent; "
            "leave it out with --route, or allow it with --allow"
        )


def check_target(target: Endpoint, *, confirmed: bool, confirm: Callable[[str], bool] | None = None) -> None:
    """Refuse another machine unless the user confirms it.

    Args:
        target: target of the datagrams.
        confirmed: the user has already confirmed another machine.
        confirm: asks a question and returns the answer; None if the user cannot be asked.

    Raises:
        ConfigError: the user does not confirm it.
    """
    if confirmed or is_loopback(target.address):
        return
    if confirm is None or not confirm(f"Send to {target}, another machine?"):
        raise ConfigError(
            f"{target} is not on this machine's loopback; nothing was sent; confirm the target with --yes"
        )


CAP_HZ: Final = 1000.0
"""Maximum datagrams per second to another machine, unless the user sets a limit."""
_LISTEN_NS: Final = 2 * SECOND
_FOLLOW_NS: Final = 30 * SECOND
"""Time to follow CI's count: a full socket drains for about 12 s, 11 datagrams each half second."""
_REFUSAL_NS: Final = 100 * MILLISECOND
"""Time to wait for refusals if no answers are received; this machine's own come during sending."""
_OWN_REFUSAL_NS: Final = 10 * MILLISECOND
_IDENTITY: Final = Peer(0x42, 3)


class Receiver(StrEnum):
    """The receiver of the datagrams."""

    CI = "ci"
    SBN = "sbn"
    GROUND = "ground"

    @property
    def sending(self) -> LinkSending | None:
        """None: cFS's own links are sent as captured, with the changes that options request."""
        return None

    @property
    def link(self) -> Link:
        """The link to this receiver."""
        return carrying("flight" if self is Receiver.SBN else "ground", to_cfs=self is not Receiver.GROUND)


class LinkReceiver(NamedTuple):
    """The receiver of a link's messages, sent by the link's method ``send``, or of bare payloads.

    Attributes:
        value: name as given.
        sending: method of sending.
    """

    value: str
    sending: LinkSending

    def __str__(self) -> str:
        return self.value

    @property
    def link(self) -> Link:
        """The link to this receiver."""
        return self.sending.link

    @property
    def carried(self) -> Receiver:
        """Receiver whose packets this link carries; for links that carry packets."""
        return Receiver.CI if self.value.endswith(":up") else Receiver.GROUND


def receiver(text: str, site: Site) -> tuple[Receiver | LinkReceiver, Endpoint | None]:
    """Read ``--to``; return the receiver, and its address if given.

    Args:
        text: ``ci``, ``sbn`` or ``ground``; the label of another link, with ``:up`` towards the flight
            software; or ``udp:HOST:PORT``.
        site: site of the mission.

    Raises:
        ConfigError: there is no such link, or its messages cannot be sent.
    """
    text = text.lower()
    if text in {*Receiver}:
        return Receiver(text), None
    label, _, rest = text.partition(":")
    if label == "udp" and rest:
        return LinkReceiver(text, LinkSending(OTHER)), parse_endpoint(rest)
    senders = {item.label: item for item in links() if item.sends}
    if label not in senders or rest not in {"", "up", "down"}:
        raise ConfigError(
            f"--to: {text!r} is not one of {', '.join([*Receiver, *senders])}, udp:HOST:PORT; LINK:up is "
            "towards the flight software"
        )
    sending = senders[label].send(site, up=rest == "up")
    if sending is None:
        raise ConfigError(f"--to {text}: nothing is sent on {label} towards the flight software")
    return LinkReceiver(text, sending), None


def sending_options() -> dict[Link, str]:
    """Return, for each link that has one, the option that sends its messages."""
    own: dict[Link, str] = {item: f"--to {item.label}" for item in links() if item.sends}
    return own | {item.link: f"--to {item}" for item in Receiver} | {OTHER: "--to udp:HOST:PORT"}


class Role(StrEnum):
    """Behaviour as an SBN peer: like stock SBN, like the public bridge, or only as captured."""

    STOCK = "stock"
    BRIDGE = "bridge"
    CAPTURED = "captured"


class SendOptions(msgspec.Struct, frozen=True):
    """Options for sending.

    Attributes:
        to: receiver.
        target: address; None: this machine, at the port that the mission names.
        sender: SBN identity; None: as captured, and for the session the mission's identity or 66:3.
        role: SBN behaviour.
        listen: address that receives answers; None: this machine's address towards the target, and the port
            that the mission names.
        events: address that receives cFS's events with SBN, if the port is free; set by ``placed``.
        no_listen: receive nothing except answers of an SBN link.
        wait_for: conditions before the first datagram: ``peer``, ``to-enabled``, ``event:TEXT``; ``nothing``.
        timeout_ns: time to wait for them, ns.
        linger_ns: time to listen after the last datagram, ns; None: two seconds if answers can be received,
            and longer while CI has not read everything.
        follow_ns: longest time to listen while CI has not read everything, ns; set by ``placed``.
        expect: expected results, as ``responses.AwaitedResults.of`` reads them.
        expect_runs: captures of good runs; the answers must be like theirs.
        rooms: name of a field to its tolerance; with an empty name, the tolerance of ranges in percent.
        expect_ns: time to wait for results after the last datagram, ns.
        max_loss: largest accepted share of lost datagrams; None: 0.
        allow: patterns of MsgIds or names that may be sent, e.g. ``0x18*``; empty: everything.
        speed: multiple of the recorded speed.
        rates: messages per second: (pattern, Hz); the pattern ``*`` sends all messages at even intervals.
        unpaced: send as fast as possible.
        max_rate_hz: maximum rate; 0: ``CAP_HZ`` to other machines.
        unlimited: no maximum.
        confirmed: whether the user has confirmed that the target is another machine.
        sequence: handling of sequence words.
        checksum: handling of checksums.
        passes: number of passes; 0 for no end.
        step: start in single steps.
        headers: headers of the receiving cFE, for packets that are made.
        tcp: with SBN, use one TCP connection to the target, which listens.
    """

    to: Receiver | LinkReceiver = Receiver.CI
    target: Endpoint | None = None
    sender: Peer | None = None
    role: Role = Role.STOCK
    listen: Endpoint | None = None
    events: Endpoint | None = None
    no_listen: bool = False
    wait_for: Sequence[str] = ()
    timeout_ns: int = 10 * SECOND
    linger_ns: int | None = None
    follow_ns: int = 0
    expect: Sequence[str] = ()
    expect_runs: Sequence[Path] = ()
    rooms: Sequence[tuple[str, float]] = ()
    expect_ns: int = 10 * SECOND
    max_loss: float | None = None
    allow: Sequence[str] = ()
    speed: float = 1.0
    rates: Sequence[tuple[str, float]] = ()
    unpaced: bool = False
    max_rate_hz: float = 0.0
    unlimited: bool = False
    confirmed: bool = False
    sequence: SequenceRule = SequenceRule.KEEP
    checksum: ChecksumRule = ChecksumRule.KEEP
    passes: int = 1
    step: bool = False
    headers: Headers = STANDARD
    tcp: bool = False

    def _check(self) -> None:
        """Check the combination, once the receiver is known.

        Raises:
            ConfigError: options contradict each other, or a condition is not known.
        """
        if self.unlimited and self.max_rate_hz:
            raise ConfigError("--unlimited removes the limit that --max-rate sets; name one of them")
        if self.to.sending:
            self._check_link()
        if self.tcp and (self.to is not Receiver.SBN or self.role is Role.BRIDGE):
            raise ConfigError(
                "--tcp sends SBN as cFS's TCP module does: it needs --to sbn, and no --role bridge"
            )
        if self.tcp and self.listen is not None:
            raise ConfigError("--listen is for datagrams: with --tcp answers come on the same connection")
        listens = not self.no_listen or self.to is Receiver.SBN
        if self.listen is not None and not listens:
            raise ConfigError("--listen and --no-listen exclude each other; name one of them")
        if any((self.expect, self.expect_runs, self.max_loss is not None)) and not listens:
            raise ConfigError("--expect and --max-loss need answers: leave --no-listen out")
        for item in self.wait_for:
            if item not in {"peer", "to-enabled", "nothing"} and not item.startswith("event:"):
                raise ConfigError(
                    f"--wait-for {item!r} is not known; there are peer, to-enabled, event:TEXT and nothing"
                )
            if item == "peer" and not self.has_session:
                raise ConfigError("--wait-for peer needs an SBN session: --to sbn, as stock or bridge")
            if item == "to-enabled" and self.to is not Receiver.CI:
                raise ConfigError("--wait-for to-enabled needs --to ci: telemetry is enabled through CI")
            if item != "nothing" and not listens:
                raise ConfigError(f"--wait-for {item} needs answers: leave --no-listen out")

    def _check_link(self) -> None:
        """Refuse options of cFS's own links if the receiver is another link.

        Raises:
            ConfigError: there are some.
        """
        own = {
            "--listen": self.listen if self.over_tcp else None,
            "--expect": (*self.expect, *self.expect_runs),
            "--max-loss": self.max_loss is not None,
            "--as": self.sender,
            "--tcp": self.tcp,
            "--sequence": self.sequence is not SequenceRule.KEEP,
            "--checksum": self.checksum is not ChecksumRule.KEEP,
        }
        if wrong := [name for name, value in own.items() if value]:
            raise ConfigError(f"{wrong[0]} is for {', '.join(Receiver)}; not for --to {self.to}")

    @property
    def over_tcp(self) -> bool:
        """Whether messages go over one TCP connection, or over the link's own transport: not as datagrams."""
        return self.tcp or bool((to := self.to.sending) and (to.framing or to.own_transport))

    @property
    def follows_ci(self) -> bool:
        """Whether CI's own count can show how many of the sent datagrams it has read."""
        return self.to is Receiver.CI and self.listen is not None

    @property
    def has_session(self) -> bool:
        """Whether a session is held during sending: of SBN, or of the receiving link."""
        if self.to.sending:
            return self.to.sending.session is not None
        return self.to is Receiver.SBN and self.role is not Role.CAPTURED

    def _ports(self, mission: Mission) -> tuple[int, int | None, int]:
        """Return the usual ports: of the target, of answers, and of cFS's telemetry."""
        ground, flight = next(iter(mission.ground), None), next(iter(mission.flight), None)
        telemetry = ground.bridge_port if ground else 1235
        if self.to.sending:
            return self.to.sending.port, None, telemetry
        to_port, listen_port = {
            Receiver.CI: (ground.fsw_port if ground else 1234, telemetry),
            Receiver.SBN: (flight.peer_port, flight.udp_receive_port) if flight else (2234, 2236),
            Receiver.GROUND: (telemetry, None),
        }[Receiver(self.to.value)]
        return to_port, listen_port, telemetry

    def placed(self, mission: Mission) -> SendOptions:
        """Return these options with the values of the mission and the defaults filled in.

        Raises:
            ConfigError: options contradict each other, or a condition is not known.
        """
        self._check()
        if self.rooms and not self.expect_runs:
            raise ConfigError("--tolerance is how far values may differ from --expect FILE: name that file")
        to_port, listen_port, events_port = self._ports(mission)
        if not (self.target or to_port):
            raise ConfigError(f"--to {self.to}: name where it goes, with --target HOST:PORT")
        target = self.target or Endpoint(LOOPBACK, to_port)
        listen, near = self.listen, is_loopback(target.address)
        if listen is None and listen_port is not None:
            listen = Endpoint(LOOPBACK if near else own_address(target), listen_port)
        if self.no_listen and self.to is not Receiver.SBN:
            listen = None
        events = None
        if self.to is Receiver.SBN and not self.no_listen and listen is not None:
            events = Endpoint(listen.address, events_port)
        linger = _LISTEN_NS
        if (listen is None or self.no_listen) and not self.has_session:
            linger = _OWN_REFUSAL_NS if near else _REFUSAL_NS
        wait_for = self.wait_for or (("peer",) if self.has_session else ())
        return replace(
            self,
            target=target,
            listen=None if self.tcp else listen,
            events=events,
            linger_ns=linger if self.linger_ns is None else self.linger_ns,
            follow_ns=_FOLLOW_NS if self.linger_ns is None else 0,
            wait_for=("nothing",) if "nothing" in wait_for else wait_for,
        )

    def identity(self, mission: Mission) -> Peer:
        """Return the identity to use on the SBN link."""
        flight = next(iter(mission.flight), None)
        return self.sender or (Peer(flight.spacecraft_id, flight.processor_id) if flight else _IDENTITY)

    def pacing(self, out: Outgoing, mission: Mission) -> Pacing:
        """Return the pacing of these datagrams; streams are MsgIds.

        Raises:
            ConfigError: speeds and rates contradict each other.
            RouteError: no datagram matches the pattern of a rate.
        """
        assert self.target is not None
        cap = self.max_rate_hz or (0.0 if is_loopback(self.target.address) else CAP_HZ)
        msg_ids = sorted(set(out.msg_id[numbered(out.msg_id)[0]].tolist()) - {NO_MSG_ID})
        streams: dict[int, float] = {}
        total = 0.0
        for pattern, rate in self.rates:
            if pattern == "*":
                total = rate
                continue
            fitting = [item for item in msg_ids if fits(pattern, item, mission)]
            if not fitting:
                raise RouteError(f"--rate {pattern}={rate:g}: no datagram to send matches {pattern!r}")
            streams |= dict.fromkeys(fitting, rate)
        if total and streams:
            raise ConfigError(
                "--rate HZ sets the interval of all messages; it cannot be combined with the rate of a route"
            )
        return Pacing(self.speed, total, streams, self.unpaced, 0.0 if self.unlimited else cap)
