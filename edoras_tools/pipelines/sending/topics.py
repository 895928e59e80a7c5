"""Turns ROS messages into the packets that the bridges would have sent, by the mission's routes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec

from edoras_tools.cfs import edoras_app
from edoras_tools.errors import CaptureError, ConfigError, RouteError
from edoras_tools.pipelines.sending.options import LinkReceiver, Receiver, SendOptions, fits
from edoras_tools.pipelines.sending.run import Loaded
from edoras_tools.sessions.outgoing import Outgoing, Packet
from edoras_tools.wire import cfe
from edoras_tools.wire.envelope import DEFAULT, EnvelopeFormat

if TYPE_CHECKING:
    from collections.abc import Mapping

    from edoras_tools.io.formats.rosbag2.reader import Rosbag
    from edoras_tools.mission import Mission, Route
    from edoras_tools.model import Peer
    from edoras_tools.pipelines.sending.replay import ReplaySelection
    from edoras_tools.pipelines.workbench import Workbench


class Encoder(msgspec.Struct, frozen=True):
    """Makes the packets of one route, as its bridge or application does.

    Attributes:
        route: the route.
        index: its index in the mission.
        envelope: format of the two lengths before the CDR.
        function_code: function code of commands.
        headers: headers of the cFE that receives or sends the packets.
        time: format of mission time in these headers.
    """

    route: Route
    index: int
    envelope: EnvelopeFormat
    function_code: int = edoras_app.SET
    headers: cfe.Headers = cfe.STANDARD
    time: cfe.MissionTime = cfe.MissionTime()

    @classmethod
    def of(cls, route: Route, bench: Workbench, function_code: int = edoras_app.SET) -> Encoder:
        """Return the encoder of a route of the bench's mission."""
        index = bench.mission.routes.index(route)
        context = bench.columns.context
        headers = context.options.headers or cfe.STANDARD
        return cls(route, index, context.envelopes[index] or DEFAULT, function_code, headers, context.time)

    def packet(self, cdr: bytes, time_ns: int) -> Packet:
        """Return a space packet; sequence word and checksum are 0, as the bridges send them."""
        body = self.envelope.emit(cdr)
        msg_id, headers = self.route.msg_id, self.headers
        if headers.msg_ids.is_command(msg_id):
            data = cfe.emit_command(
                msg_id, self.function_code, body, sequence_flags=0, with_checksum=False, headers=headers
            )
            head = headers.command_bytes
        else:
            time = self.time
            data = cfe.emit_telemetry(
                msg_id, body, **time.words(time_ns), sequence_flags=0, headers=headers, time=time
            )
            head = headers.telemetry_bytes
        return Packet(data, time_ns, self.index, head + self.envelope.size)


def routes_towards(to: Receiver | LinkReceiver, mission: Mission) -> list[Route]:
    """Return the routes whose messages go to a receiver."""
    return [
        route
        for route in mission.routes
        if route.link is to.link and (to is not Receiver.SBN or route.to_cfs)
    ]


def sender_of(options: SendOptions, mission: Mission) -> Peer | None:
    """Return the identity that sends on the SBN link; None on other links."""
    return options.identity(mission) if options.to is Receiver.SBN else None


def load_topics(
    bag: Rosbag, bench: Workbench, options: SendOptions, choice: ReplaySelection, rename: Mapping[str, str]
) -> Loaded:
    """Read ROS messages recorded by any tool, and make packets of them.

    Args:
        bag: the recording.
        bench: workbench whose mission assigns MsgIds to topics.
        options: receiver.
        choice: part of the recording.
        rename: topic of the recording to topic of the mission.

    Raises:
        CaptureError: the recording is damaged, or contains no matching message.
        ConfigError: a topic has another type than its route.
        RouteError: no configured topic goes to the receiver.
    """
    mission = bench.mission
    routes = {route.topic: route for route in routes_towards(options.to, mission)}
    if not routes:
        raise RouteError(f"--from-topics: no configured topic goes to {options.to}; name its mission with -c")
    if choice.selection.where:
        raise ConfigError("--where reads datagrams and has no effect with --from-topics: leave one out")
    selection = choice.selection.over(bench)
    topics = bag.topics()
    encoders: dict[str, Encoder] = {}
    for topic, name in topics.items():
        topic_ = "/" + rename.get(topic, topic).removeprefix("/")
        route = routes.get(topic_)
        if route is None or not selection.about(route.link.label, route.msg_id, mission):
            continue
        if choice.routes and not any(fits(pattern, route.msg_id, mission) for pattern in choice.routes):
            continue
        if name != route.type:
            raise ConfigError(
                f"{bag.path}: {topic} is {name}, but {topic_} of the mission needs {route.type}"
            )
        encoders[topic] = Encoder.of(route, bench)
    if not encoders:
        raise CaptureError(
            f"{bag.path}: none of its topics ({', '.join(sorted(topics)) or 'none'}) goes to {options.to}; "
            f"configured are {', '.join(routes)}; --remap A:=B renames a topic"
        )
    packets, short = [], 0
    first_ns, period = -1, choice.period
    for message in bag.messages(encoders):
        if first_ns < 0:
            first_ns, period = message.time_ns, choice.period.since(message.time_ns)
        if not period.holds(message.time_ns - first_ns):
            continue
        short += len(message.cdr) < 4
        packets.append(encoders[message.topic].packet(message.cdr, message.time_ns))
        if choice.count and len(packets) >= choice.count:
            break
    if not packets:
        raise CaptureError(f"{bag.path}: contains no message on {', '.join(encoders)} in the selected time")
    notes = (f"{short:,} messages are too short for CDR, and are sent as they are",) if short else ()
    out = Outgoing.packets(
        options.to.link,
        packets,
        sender=sender_of(options, mission),
        headers=bench.columns.context.options.headers,
    )
    return Loaded(out, notes=notes)
