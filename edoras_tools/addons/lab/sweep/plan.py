"""The range of a sweep: a route, rates or sizes, and the packets that are sent for it."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any, Final

import msgspec

from edoras_tools.addons.lab.emulator import Scenario, messages
from edoras_tools.addons.lab.emulator.apps import generator
from edoras_tools.addons.lab.sweep.observer import reset_filters
from edoras_tools.cfs import edoras_app, telemetry_output
from edoras_tools.errors import ConfigError, RouteError
from edoras_tools.io.net.sockets import is_loopback
from edoras_tools.links.table import carrying
from edoras_tools.mission import Mission, Route
from edoras_tools.pipelines.sending.options import CAP_HZ, Receiver, SendOptions, check_allowed
from edoras_tools.pipelines.sending.replay import Encoder
from edoras_tools.sessions.outgoing import Outgoing, Packet
from edoras_tools.units import SECOND
from edoras_tools.wire import ccsds, cfe
from edoras_tools.wire.envelope import DEFAULT

if TYPE_CHECKING:
    from edoras_tools.model import Link
    from edoras_tools.pipelines.workbench import Workbench


_GROWTH: Final = 2


class Bisection(msgspec.Struct):
    """A search for the highest whole number that is good.

    >>> search = Bisection(1, 100)
    >>> while (value := search.next) is not None:
    ...     search.tell(value, good=value < 9)
    >>> search.good, search.bad
    (8, 9)

    Attributes:
        first: first value.
        last: last value, if no value is bad.
        precision: largest distance between good and bad at the end, as a share of the good one; at least 1.
        good: highest good value so far; None if there is none.
        bad: lowest bad value so far; None if there is none.
    """

    first: int
    last: int
    precision: float = 0.0
    good: int | None = None
    bad: int | None = None

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ConfigError: the first value is below 1, or above the last.
        """
        if not 1 <= self.first <= self.last:
            raise ConfigError(f"{self.first}..{self.last} is not a rising range from 1 or more")

    @property
    def next(self) -> int | None:
        """The next value to try; None when the result is precise enough."""
        if self.good is None:
            return self.first if self.bad is None else None
        if self.bad is None:
            return min(self.good * _GROWTH, self.last) if self.good < self.last else None
        apart = self.bad - self.good
        return self.good + apart // 2 if apart > max(1, int(self.good * self.precision)) else None

    def tell(self, value: int, *, good: bool) -> None:
        """Record whether ``value`` was good."""
        if good:
            self.good = value
        else:
            self.bad = value


_FILL: Final = 0xA5
_PRECISION: Final = 0.02
_POSE_BYTES: Final = 100
"""Bytes of the struct that contains a PoseStamped."""
_ECHO_LIMIT: Final = 32


class SweepPlan(msgspec.Struct, frozen=True):
    """The sweep to run.

    Attributes:
        route: the route that is swept.
        rates: first and last rate in Hz; equal if sizes are swept.
        sizes: first and last size of the space packet in bytes; equal if rates are swept, and 0 for the
            message's own size.
        step_ns: duration of a step.
        options: settings of sending, with defaults filled in.
        scenario: an emulated cFS with this demo, in simulated time; None for sockets.
        limit: limit of a MsgId in the emulated cFS's pipe; None: the real limit.
        watch: whether to publish nothing, and only measure what arrives.
        watch_ns: duration of that, ns.
        generator: MsgId of the commands of the app that publishes telemetry.
    """

    route: Route
    rates: tuple[int, int]
    sizes: tuple[int, int]
    step_ns: int
    options: SendOptions
    scenario: Scenario | None = None
    limit: int | None = None
    watch: bool = False
    watch_ns: int = 60 * SECOND
    generator: int = generator.COMMAND_MSG_ID

    @property
    def headers(self) -> cfe.Headers:
        """Headers of the cFE."""
        return self.options.headers

    @property
    def by_size(self) -> bool:
        """Whether sizes are swept."""
        return self.sizes[0] != self.sizes[1]

    @property
    def to_cfs(self) -> bool:
        """Whether messages are sent to cFS; if not, they come from cFS."""
        return self.route.link.only_to_cfs or (self.route.link.peers and self.route.to_cfs)

    @property
    def is_echoed(self) -> bool:
        """Whether Telemetry Output can send the messages back."""
        return self.by_size and self.route.link.only_to_cfs

    def search(self) -> Bisection:
        """Return the search for the limit."""
        return Bisection(*self.sizes) if self.by_size else Bisection(*self.rates, precision=_PRECISION)

    def check(self, bench: Workbench) -> None:
        """Check the plan.

        Raises:
            ConfigError: a range is wrong or too fast, or a packet would be sent that is not allowed.
            FieldError: the message does not fit its packet.
        """
        self.search()
        assert self.options.target is not None
        natural, largest = natural_size(self.route, bench), self.route.link.largest
        first, last = self.sizes
        if first and not natural <= first <= last <= largest:
            name = self.route.type or "a bare header"
            raise ConfigError(
                f"--size {first}..{last}: a packet with {name} has {natural} bytes, and a datagram holds "
                f"{largest:,}; the size must be in between"
            )
        free = self.options.unlimited or self.scenario or is_loopback(self.options.target.address)
        if not free and self.rates[1] > CAP_HZ:
            raise ConfigError(
                f"{self.rates[1]:,} Hz exceeds the limit of {CAP_HZ:,.0f} Hz to other machines; end the "
                "range earlier, or remove the limit with --max-rate 0"
            )
        packets = [Packet(item) for item in self.packets(bench)]
        check_allowed(
            Outgoing.packets(carrying("ground", to_cfs=True), packets, headers=self.headers),
            self.options.allow,
            bench.mission,
        )

    def packets(self, bench: Workbench) -> list[bytes]:
        """Return one of each kind of packet that the sweep sends."""
        packets = [reset_filters(self.headers)]
        if self.to_cfs:
            packets.append(message(self.route, bench, self.sizes[0]))
        elif not self.watch:
            packets.append(generator_command(self, 0, 0))
        if self.is_echoed:
            packets += echo(self.route.msg_id, self.headers)
        return packets

    def as_json(self, bench: Workbench) -> dict[str, Any]:
        """Return the output of ``--dry-run --json``."""
        names = {f"0x{self.headers.msg_ids.of(item):04x}": None for item in self.packets(bench)}
        return {
            "dry_run": True,
            "route": self.route.topic,
            "msg_id": f"0x{self.route.msg_id:04x}",
            "link": self.route.link.label,
            "target": f"emulated {self.scenario}" if self.scenario else str(self.options.target),
            "listen": str(self.options.listen),
            "rates_hz": list(self.rates),
            "sizes": [item or natural_size(self.route, bench) for item in self.sizes],
            "step_s": self.step_ns / SECOND,
            "sends": list(names),
        }


def route_of(name: str, link: Link | None, mission: Mission) -> Route:
    """Return the route of that name on a link; a MsgId need not be configured.

    Raises:
        RouteError: no route has that name, or several have.
    """
    try:
        number = int(name, 0)
    except ValueError:
        number = 0
    routes = [
        item
        for item in mission.routes
        if (link is None or item.link is link)
        and (
            number == item.msg_id if number else name in {item.topic, item.topic.removeprefix("/"), item.key}
        )
    ]
    if len(routes) == 1:
        return routes[0]
    if number and not routes:
        if not 0 < number <= cfe.HIGHEST_MSG_ID:
            raise RouteError(f"{name} is not a MsgId from 0x0001 to 0x{cfe.HIGHEST_MSG_ID:04x}")
        towards = mission.msg_ids.is_command(number)
        link = link or carrying("ground", to_cfs=towards)
        return Route(f"0x{number:04x}", "", number, link, "command" if towards else "telemetry")
    route = mission.find(name)
    raise RouteError(
        f"{route.topic} uses {route.link.label}, not {link.label if link else 'this link'}; "
        "leave --to out, or name the route by its MsgId"
    )


def command_receiver(link: Link) -> Receiver:
    """Return the receiver of the commands: for telemetry it is also Command Ingest."""
    return Receiver.SBN if link.peers else Receiver.CI


def natural_size(route: Route, bench: Workbench) -> int:
    """Return the size in bytes of a route's space packet with default values."""
    headers = bench.columns.context.options.headers or cfe.STANDARD
    header = headers.size(route.msg_id)
    if not route.type:
        return header
    if route.type == messages.POSE_STAMPED and not headers.msg_ids.is_command(route.msg_id):
        return header + _POSE_BYTES
    return header + DEFAULT.size + len(bench.types.encode(route.type, {}))


def message(route: Route, bench: Workbench, size: int) -> bytes:
    """Return a route's packet towards cFS, padded to a size; 0 for its own size."""
    if route in bench.mission.routes:
        packet = Encoder.of(route, bench).packet(bench.types.encode(route.type, {}), 0).packet
    else:
        headers = bench.columns.context.options.headers or cfe.STANDARD
        packet = (
            cfe.emit_command(
                route.msg_id, edoras_app.SET, sequence_flags=0, with_checksum=False, headers=headers
            )
            if headers.msg_ids.is_command(route.msg_id)
            else cfe.emit_telemetry(route.msg_id, sequence_flags=0, headers=headers)
        )
    if size <= len(packet):
        return packet
    return with_length(packet, size).ljust(size, bytes([_FILL]))


def generator_command(plan: SweepPlan, rate_hz: int, size: int) -> bytes:
    """Return the command that makes the generator publish the route of a plan at a rate; 0 stops it."""
    route = plan.route
    length = max(0, size - plan.headers.telemetry_bytes)
    is_pose = route.type == messages.POSE_STAMPED and length >= _POSE_BYTES
    payload = generator.set_command(
        route.msg_id, rate_hz, length=length, kind=generator.POSE_STAMPED_KIND if is_pose else 0
    )
    return cfe.emit_command(plan.generator, generator.SET, payload, headers=plan.headers)


def echo(msg_id: int, headers: cfe.Headers = cfe.STANDARD) -> tuple[bytes, bytes]:
    """Return the commands that make Telemetry Output also send a MsgId to the ground, and stop it again."""
    add = struct.pack("<IBBBx", msg_id, 0, 0, _ECHO_LIMIT)
    command = headers.msg_ids.of_known(telemetry_output.COMMAND_MSG_ID)
    return (
        cfe.emit_command(command, telemetry_output.ADD_PACKET, add, headers=headers),
        cfe.emit_command(command, telemetry_output.REMOVE_PACKET, struct.pack("<I", msg_id), headers=headers),
    )


def with_length(packet: bytes, size: int) -> bytes:
    """Return the packet with a length field for ``size`` bytes in all; nothing is added or cut."""
    return packet[:4] + (size - ccsds.LENGTH_BIAS).to_bytes(2, "big") + packet[6:]
