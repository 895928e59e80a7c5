"""Every constant of the flight side in one frozen value: rates, depths, limits, ports, time-outs.

The defaults come from the sources and from measurements on a running cFS (draco-rc4, CI_LAB, TO_LAB, SBN over
UDP). Times are integer nanoseconds.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
from msgspec.structs import replace

from edoras_tools.cfs import sbn, telemetry_output
from edoras_tools.errors import ConfigError
from edoras_tools.model import Peer
from edoras_tools.units import MICROSECOND, MILLISECOND, SECOND
from edoras_tools.wire.cfe import STANDARD, Headers, MissionTime

if TYPE_CHECKING:
    from typing_extensions import Self

FLIGHT_BRIDGE: Final = Peer(0x42, 3)
"""Identity of the demos' flight bridge."""
TO_TABLE: Final = {
    **dict.fromkeys((0x0800, 0x0801, 0x0803, 0x0804, 0x0805, 0x0806, 0x080A, 0x080B, 0x080C, 0x0810), 4),
    **dict.fromkeys((0x0827, 0x0880, 0x0881, 0x0884, 0x08FA), 4),
    0x0808: 32,
}
"""Telemetry Output's table: message limit of each MsgId. An application's own MIDs are added."""


class SbnPeerConfig(msgspec.Struct, frozen=True):
    """A peer in SBN's configuration table.

    Attributes:
        peer: spacecraft and processor.
        port: UDP port at which it listens.
        address: IPv4 address as text.
    """

    peer: Peer
    port: int
    address: str = "127.0.0.1"


class Ports(NamedTuple):
    """The UDP ports of one cFS and of its two bridges.

    Attributes:
        ci: port of Command Ingest.
        to: port of the ground bridge, to which Telemetry Output sends.
        sbn: port of the Software Bus Network.
        peer: port of the flight bridge.
    """

    ci: int
    to: int
    sbn: int
    peer: int


GENERATOR_MSG_ID: Final = 0x18F0
"""Usual MsgId of the commands of the telemetry generator."""


class SimProfile(msgspec.Struct, frozen=True):
    """The constants of a cFS instance.

    Attributes:
        spacecraft_id: spacecraft of this instance.
        processor_id: processor of this instance.
        address: IPv4 address of every socket.
        ci_port: UDP port of Command Ingest.
        ci_buffer: bytes of a datagram that Command Ingest keeps.
        ci_wake_ns: Command Ingest's time-out on its pipe; every wake-up also reads the socket.
        ci_datagrams_per_wake: most datagrams that it reads at once.
        ci_read_ns: processor time for reading one datagram and putting it on the bus.
        socket_queue: datagrams that the operating system keeps for an unread socket: Linux allows 212,992
            bytes and charges 1,024 for a short one.
        to_port: UDP port at which the ground receives.
        to_source_port: UDP port that telemetry comes from; 0 lets the operating system choose.
        to_wake_ns: Telemetry Output's delay between two rounds.
        to_pipe_depth: depth of its telemetry pipe.
        to_limits: its table: message limit of each MsgId; the application's MsgIds are added.
        to_default_limit: limit of a MsgId without one in the table or the add-packet command.
        msg_max: the host's ``fs.mqueue.msg_max``, which limits the depth of every pipe; 0 for no limit.
        app_pipe_depth: depth of an application's pipe.
        app_msg_limit: most messages of one MsgId that may wait in it.
        robot_port: UDP port at which its robot listens, 8585 in flight; 0: nothing is sent to a robot.
        sbn_port: UDP port of the Software Bus Network.
        sbn_peers: peers that it may connect to.
        sbn_table: peers in an image of SBN's table, including this cFS; empty without an image.
        sbn_heartbeat_s: whole seconds without sending, after which it sends a heartbeat.
        sbn_timeout_s: whole seconds of silence, after which a peer is disconnected.
        sbn_announce_s: whole seconds between announcements to a peer that is not connected.
        sbn_wake_ns: period at which it serves peer pipes and checks time-outs.
        sbn_pipe_depth: depth of a peer's pipe.
        sbn_msg_limit: most messages of one MsgId that may wait in it.
        sbn_says_start: whether it reports its modules and configuration at the start: more events than
            Telemetry Output can take, so that a few are lost and counted at each boot, as in flight.
        sbn_tcp: 1: SBN uses its TCP module.
        sbn_polls: whether it receives in the main loop too, each ``sbn_wake_ns``, instead of in its own task.
        bus_max_bytes: longest message that the software bus accepts.
        bus_loss_events: number of reports of a loss event before its filter stops it.
        bus_no_subscribers_events: number of reports of "No subscribers" before its filter stops it.
        event_burst: events that an application may send at once before it is squelched.
        event_rate: events per second that it may send in the long run.
        housekeeping_ns: period of the housekeeping requests.
        wakeup_ns: period of the wake-up at which the two-robot application sends its commands.
        generator_msg_id: MsgId of the telemetry generator's commands; 0 without a generator.
        big_endian: 1: counters and events are big-endian.
        headers: headers of packets on the links. MsgIds of this profile are those of version 1 even if these
            headers have version 2; ``wire.ccsds`` converts them.
        time: format of mission time in telemetry; its epoch, if set, is the clock's from the start.
        boot_ns: time from the start of the processor until all applications run.
        app_start_ns: time from the start of an application until it runs.
        app_kill_ns: longest time that an application may take to end on request.
        boot_met_s: mission elapsed time at the start, s.
        epoch_offset_s: correction from mission elapsed time to mission time, s.
        cores: number of processors that the tasks share.
        latency_ns: shortest and longest time from "may run" to "runs" of a task.
        work_ns: processor time for one message.
        housekeeping_work_ns: processor time for a core application's housekeeping packet.
        obey_work_ns: processor time for a command that is decoded, printed, and sent to a robot.
        work_jitter: largest relative deviation of a piece of work from ``work_ns``, 0 to 1.
        seed: seed of the latencies; each seed gives another run.
        stated: names of constants, and MsgIds of limits, that a user stated; the others are assumed.
    """

    spacecraft_id: int = 0x42
    processor_id: int = 1
    address: str = "127.0.0.1"

    generator_msg_id: int = GENERATOR_MSG_ID
    big_endian: int = 0
    headers: Headers = STANDARD
    time: MissionTime = MissionTime()

    ci_port: int = 1234
    ci_buffer: int = 768
    ci_wake_ns: int = 500 * MILLISECOND
    ci_datagrams_per_wake: int = 11
    ci_read_ns: int = 3 * MICROSECOND
    socket_queue: int = 208

    to_port: int = 1235
    to_source_port: int = 0
    to_wake_ns: int = 500 * MILLISECOND
    to_pipe_depth: int = 50
    to_limits: Mapping[int, int] = msgspec.field(default_factory=lambda: dict(TO_TABLE))
    to_default_limit: int = telemetry_output.USUAL_LIMIT

    msg_max: int = 0
    app_pipe_depth: int = 32
    app_msg_limit: int = 4
    robot_port: int = 0

    sbn_port: int = 2234
    sbn_peers: tuple[SbnPeerConfig, ...] = (
        SbnPeerConfig(Peer(0x42, 2), 2235),
        SbnPeerConfig(FLIGHT_BRIDGE, 2236),
    )
    sbn_table: tuple[SbnPeerConfig, ...] = ()
    sbn_heartbeat_s: int = sbn.HEARTBEAT_S
    sbn_timeout_s: int = sbn.TIMEOUT_S
    sbn_announce_s: int = sbn.ANNOUNCE_S
    sbn_wake_ns: int = sbn.WAKE_NS
    sbn_pipe_depth: int = sbn.PIPE_DEPTH
    sbn_msg_limit: int = sbn.PEER_MSG_LIMIT
    sbn_tcp: int = 0
    sbn_says_start: bool = False
    sbn_polls: bool = False

    bus_max_bytes: int = 32768
    bus_loss_events: int = 16
    bus_no_subscribers_events: int = 4
    event_burst: int = 32
    event_rate: int = 15

    housekeeping_ns: int = SECOND
    wakeup_ns: int = 100 * MILLISECOND
    boot_ns: int = 1600 * MILLISECOND
    app_start_ns: int = 50 * MILLISECOND
    app_kill_ns: int = 5900 * MILLISECOND
    boot_met_s: int = 1000
    epoch_offset_s: int = 1_000_000

    cores: int = 2
    latency_ns: tuple[int, int] = (40 * MICROSECOND, 160 * MICROSECOND)
    work_ns: int = 8 * MICROSECOND
    housekeeping_work_ns: int = 90 * MICROSECOND
    obey_work_ns: int = 90 * MICROSECOND
    work_jitter: float = 0.5
    seed: int = 1
    stated: frozenset[str | int] = frozenset()

    def __post_init__(self) -> None:
        periods = ("ci_wake_ns", "to_wake_ns", "sbn_wake_ns", "housekeeping_ns", "wakeup_ns", "cores")
        for name in (*periods, "ci_datagrams_per_wake", "event_burst", "ci_buffer", "socket_queue"):
            if getattr(self, name) < 1:
                raise ConfigError(f"sim profile: {name}: {getattr(self, name)} is not allowed; 1 or more")
        for name in ("ci_port", "to_port", "to_source_port", "sbn_port"):
            if not 0 <= getattr(self, name) <= 0xFFFF:
                raise ConfigError(f"sim profile: {name}: {getattr(self, name)} is not a UDP port; 0 to 65535")
        if not 0 <= self.latency_ns[0] <= self.latency_ns[1]:
            raise ConfigError(
                f"sim profile: latency_ns: {self.latency_ns} is not allowed; (shortest, longest)"
            )

    def stating(self, constants: Mapping[str, Any], limits: Mapping[int, int] | None = None) -> Self:
        """Return the profile with constants that a user states, by name, and limits at Telemetry Output."""
        limits = limits or {}
        whole = replace(self, **constants)
        names = {*self.stated, *constants, *constants.get("to_limits", ()), *limits}
        return replace(whole, to_limits={**whole.to_limits, **limits}, stated=frozenset(names))

    def on(self, ports: Ports) -> Self:
        """Return the profile on other ports, with the flight bridge as its only SBN peer."""
        bridge = SbnPeerConfig(FLIGHT_BRIDGE, ports.peer, self.address)
        return replace(self, ci_port=ports.ci, to_port=ports.to, sbn_port=ports.sbn, sbn_peers=(bridge,))

    @property
    def peer(self) -> Peer:
        """Identity of this instance for its SBN peers."""
        return Peer(self.spacecraft_id, self.processor_id)


def constant_names() -> tuple[str, ...]:
    """Return the names of the constants that are integers, which users can state."""
    values = zip(SimProfile.__struct_fields__, SimProfile.__struct_defaults__, strict=True)
    return tuple(name for name, value in values if type(value) is int)
