"""What is swept: a route, a range of rates or of sizes, and the packets that it takes."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.errors import ConfigError, RouteError
from edoras_tools.mission import Route
from edoras_tools.model import Link
from edoras_tools.pipelines.orders import CAP_HZ, To
from edoras_tools.pipelines.safety import check_allowed, is_loopback, names_of
from edoras_tools.pipelines.sweep_line import reset_filters
from edoras_tools.pipelines.topics import SET, Encoder
from edoras_tools.sessions import telemetry_output
from edoras_tools.sessions.bisection import Bisection
from edoras_tools.sessions.outgoing import Outgoing, Packet
from edoras_tools.sessions.profile import SECOND
from edoras_tools.sim import generator, messages
from edoras_tools.wire import cfe, sbn
from edoras_tools.wire.envelope import DEFAULT

if TYPE_CHECKING:
    from edoras_tools.mission import Mission
    from edoras_tools.pipelines.orders import Orders
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.sim import Scenario

_FILL: Final = 0xA5
_LARGEST: Final = {Link.CI: 65507, Link.TO: 65507, Link.SBN: sbn.LARGEST_PAYLOAD}
_PRECISION: Final = 0.02
_POSE_BYTES: Final = 100
"""The struct that a PoseStamped travels in."""
_ECHO_LIMIT: Final = 32


@dataclass(frozen=True, slots=True)
class Plan:
    """What to do.

    Attributes:
        route: what is swept.
        rates: first and last rate, Hz; the same where sizes are swept.
        sizes: first and last size of the space packet, bytes; the same where rates are swept, and 0 for the
            message's own.
        step_ns: how long a step is.
        orders: where to, as whom; placed.
        scenario: an emulated cFS with this demo, in simulated time; None for sockets.
        limit: how many messages may wait in the emulated cFS's pipe; None for the real one's.
        watch: publish nothing, look at what comes.
        watch_ns: so long.
    """

    route: Route
    rates: tuple[int, int]
    sizes: tuple[int, int]
    step_ns: int
    orders: Orders
    scenario: Scenario | None = None
    limit: int | None = None
    watch: bool = False
    watch_ns: int = 60 * SECOND

    @property
    def by_size(self) -> bool:
        """Whether sizes are swept."""
        return self.sizes[0] != self.sizes[1]

    @property
    def to_cfs(self) -> bool:
        """Whether messages are sent to cFS; else they come from there."""
        return self.route.link is Link.CI or (self.route.link is Link.SBN and self.route.to_cfs)

    @property
    def is_echoed(self) -> bool:
        """Whether Telemetry Output can be asked to send the messages back."""
        return self.by_size and self.route.link is Link.CI

    def search(self) -> Bisection:
        """Return the search."""
        return Bisection(*self.sizes) if self.by_size else Bisection(*self.rates, precision=_PRECISION)

    def check(self, bench: Workbench) -> None:
        """Refuse what cannot be.

        Raises:
            ConfigError: a range is wrong or too fast, or something would be sent that is not allowed.
            FieldError: the message does not fit its packet.
        """
        self.search()
        assert self.orders.target is not None
        natural, largest = natural_size(self.route, bench), _LARGEST[self.route.link]
        first, last = self.sizes
        if first and not natural <= first <= last <= largest:
            name = self.route.type or "a bare header"
            raise ConfigError(
                f"--size {first}..{last}: {name} takes {natural} bytes as a packet, and a datagram holds "
                f"{largest:,}; the size is from the one up to the other"
            )
        free = self.orders.unlimited or self.scenario or is_loopback(self.orders.target.address)
        if not free and self.rates[1] > CAP_HZ:
            raise ConfigError(
                f"{self.rates[1]:,} Hz is more than the {CAP_HZ:,.0f} Hz that other machines are sent at "
                "most; end the range sooner, or lift the cap with --unlimited"
            )
        packets = [Packet(item) for item in self.packets(bench)]
        check_allowed(Outgoing.packets(Link.CI, packets), self.orders.allow, bench.mission)

    def packets(self, bench: Workbench) -> list[bytes]:
        """Return one of each kind of packet that the sweep sends."""
        found = [reset_filters()]
        if self.to_cfs:
            found.append(message(self.route, bench, self.sizes[0]))
        elif not self.watch:
            found.append(generate(self.route, 0, 0))
        if self.is_echoed:
            found += echo(self.route.msg_id)
        return found

    def as_json(self, bench: Workbench) -> dict[str, Any]:
        """Return what ``--dry-run --json`` prints."""
        names = {f"0x{item[0] << 8 | item[1]:04x}": None for item in self.packets(bench)}
        return {
            "dry_run": True,
            "route": self.route.topic,
            "msg_id": f"0x{self.route.msg_id:04x}",
            "link": self.route.link.label,
            "target": f"emulated {self.scenario}" if self.scenario else str(self.orders.target),
            "listen": str(self.orders.listen),
            "rates_hz": list(self.rates),
            "sizes": [item or natural_size(self.route, bench) for item in self.sizes],
            "step_s": self.step_ns / SECOND,
            "sends": list(names),
        }


def route_of(name: str, link: Link | None, mission: Mission) -> Route:
    """Return the route that a name means on a link; a MsgId need not be configured.

    Raises:
        RouteError: none is called that, or several are.
    """
    try:
        number = int(name, 0)
    except ValueError:
        number = 0
    there = [
        item
        for item in mission.routes
        if (link is None or item.link is link)
        and (number == item.msg_id if number else name in names_of(item.msg_id, mission) and _is(name, item))
    ]
    if len(there) == 1:
        return there[0]
    if number and not there:
        if not 0 < number <= cfe.HIGHEST_MSG_ID:
            raise RouteError(f"{name} is no MsgId from 0x0001 to 0x{cfe.HIGHEST_MSG_ID:04x}")
        towards = cfe.is_command(number)
        link = link or (Link.CI if towards else Link.TO)
        return Route(f"0x{number:04x}", "", number, link, "command" if towards else "telemetry")
    found = mission.find(name)
    raise RouteError(
        f"{found.topic} goes over {found.link.label}, not {link.label if link else 'there'}; "
        "leave --to out, or name it by its MsgId"
    )


def _is(name: str, route: Route) -> bool:
    return name in {route.topic, route.topic.removeprefix("/"), route.key}


def receiver(link: Link) -> To:
    """Return whom the line leads to: Command Ingest also where telemetry is asked for."""
    return To.SBN if link is Link.SBN else To.CI


def natural_size(route: Route, bench: Workbench) -> int:
    """Return the bytes of a route's space packet with all values at their defaults."""
    header = cfe.COMMAND_HEADER_BYTES if cfe.is_command(route.msg_id) else cfe.TELEMETRY_HEADER_BYTES
    if not route.type:
        return header
    if route.type == messages.POSE_STAMPED and not cfe.is_command(route.msg_id):
        return header + _POSE_BYTES
    return header + DEFAULT.size + len(bench.types.encode(route.type, {}))


def message(route: Route, bench: Workbench, size: int) -> bytes:
    """Return a route's packet towards cFS, filled up to a size; 0 for its own."""
    if route in bench.mission.routes:
        packet = Encoder.of(route, bench).packet(bench.types.encode(route.type, {}), 0).packet
    elif cfe.is_command(route.msg_id):
        packet = cfe.emit_command(route.msg_id, SET, sequence_flags=0, with_checksum=False)
    else:
        packet = cfe.emit_telemetry(route.msg_id, sequence_flags=0)
    if size <= len(packet):
        return packet
    return packet[:4] + (size - 7).to_bytes(2, "big") + packet[6:].ljust(size - 6, bytes([_FILL]))


def generate(route: Route, rate_hz: int, size: int) -> bytes:
    """Return the command that has the generator publish a route at a rate; 0 stops it."""
    length = max(0, size - cfe.TELEMETRY_HEADER_BYTES)
    is_pose = route.type == messages.POSE_STAMPED and length >= _POSE_BYTES
    payload = generator.set_command(
        route.msg_id, rate_hz, length=length, kind=generator.POSE_STAMPED if is_pose else 0
    )
    return cfe.emit_command(generator.COMMAND_MSG_ID, generator.SET, payload)


def echo(msg_id: int) -> tuple[bytes, bytes]:
    """Return the commands that have Telemetry Output send a MsgId to the ground too, and no longer."""
    add = struct.pack("<IBBBx", msg_id, 0, 0, _ECHO_LIMIT)
    return (
        cfe.emit_command(telemetry_output.COMMAND_MSG_ID, telemetry_output.ADD_PACKET, add),
        cfe.emit_command(
            telemetry_output.COMMAND_MSG_ID, telemetry_output.REMOVE_PACKET, struct.pack("<I", msg_id)
        ),
    )
