"""What is sent again from a recording: datagrams as they were captured, or ROS messages as packets.

Datagrams are those of one link and direction. Messages become the packets that the bridges would have sent,
by the mission's routes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Final

import msgspec
import numpy as np

from edoras_tools.cfs import edoras_app
from edoras_tools.errors import CaptureError, ConfigError, RouteError, WireError
from edoras_tools.links import BRIDGE_PORT
from edoras_tools.links.table import link
from edoras_tools.model import NO_MSG_ID, Columns, Finding, Link, PacketBatch, Peer
from edoras_tools.pipelines.reading import reading
from edoras_tools.pipelines.selection import Period, Selection
from edoras_tools.pipelines.sending.options import (
    LinkReceiver,
    Receiver,
    SendOptions,
    called,
    fits,
    sending_options,
)
from edoras_tools.pipelines.sending.run import Loaded
from edoras_tools.sessions.outgoing import Changes, Outgoing, Packet, join_datagrams
from edoras_tools.wire import cfe, sbn
from edoras_tools.wire.envelope import DEFAULT, EnvelopeFormat
from edoras_tools.words import listed

if TYPE_CHECKING:
    from edoras_tools.io import Source
    from edoras_tools.io.formats.rosbag2.reader import Rosbag
    from edoras_tools.mission import Mission, Route
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.ros import TypeStore
    from edoras_tools.wire.arrays import Integers, Mask
    from edoras_tools.wire.ccsds import MsgIds

_WHAT: Final = {
    Receiver.CI: "commands to Command Ingest",
    Receiver.SBN: "SBN datagrams towards cFS",
    Receiver.GROUND: "telemetry from Telemetry Output",
}
_BUILDS: Final = {
    "16": cfe.STANDARD,
    "12": cfe.SHORT,
    "extended": cfe.WITH_EXTENDED,
    "extended-v2": cfe.WITH_EXTENDED_2,
}
_SBN_PORT: Final = 2234
_MOST_BYTES: Final = 4 << 30
_STAMP: Final = "header.stamp.sec"


class ReplaySelection(msgspec.Struct, frozen=True):
    """The part of a recording that is sent.

    Attributes:
        selection: selection by link, MsgId, topic and values.
        routes: patterns of MsgIds, topics and keys; empty: all.
        period: period of the recording.
        count: number of datagrams to send of the rest, from its start; 0 for all.
    """

    selection: Selection = msgspec.field(default_factory=Selection)
    routes: Sequence[str] = ()
    period: Period = msgspec.field(default_factory=Period)
    count: int = 0


def load_datagrams(source: Source, bench: Workbench, options: SendOptions, choice: ReplaySelection) -> Loaded:
    """Read the datagrams to send; the source is closed.

    All are kept in memory, without columns, before the first one leaves: then reading delays no datagram.

    Raises:
        CaptureError: the source is damaged, or has no datagram that matches.
        RouteError: a topic is not configured.
    """
    parts: list[Outgoing] = []
    subscriptions: set[int] = set()
    links = np.zeros(256, np.int64)
    remaining, size, seen_towards, harm = choice.count, 0, 0, np.zeros(2, np.int64)
    sending = options.to.sending
    with reading(source, bench) as loop:
        selection = choice.selection.over(bench)
        for whole in loop:
            batch, columns = whole.batch, whole.columns
            links += np.bincount(columns.link, minlength=256)
            period = choice.period.since(whole.begin_ns)
            towards = _towards(batch, columns, options, bench.mission)
            seen_towards += int(np.count_nonzero(towards))
            if options.to is Receiver.SBN and options.has_session:
                subscriptions |= _subscriptions(batch, columns, towards)
                towards &= columns.sbn_msg_type == sbn.MsgType.APP
            elapsed = batch.time_ns - whole.begin_ns
            towards &= period.holds(elapsed)
            towards &= _routes(columns, choice.routes, bench.mission)
            rows = np.flatnonzero(towards)
            mask, columns = selection.apply(batch.take(rows), columns.take(rows))
            if choice.count:
                mask, columns = mask.take(slice(0, remaining)), columns.take(slice(0, remaining))
                remaining -= len(mask)
            if len(mask):
                packets = bool(sending and sending.packets)
                if sending:
                    sending.keep(mask)
                parts.append(Outgoing.of(options.to.link, mask, columns, packets=packets))
                harm += _harm(mask)
                size += len(parts[-1].data)
            if size > _MOST_BYTES:
                raise CaptureError(
                    f"{source.info.name}: more than 4 GiB to send; select less with --start, --end"
                )
            if (choice.count and not remaining) or (
                period.end_ns and len(elapsed) and int(elapsed[-1]) > period.end_ns + 10**9
            ):
                break
    others = _others(options.to.link, links, sending_options())
    if not parts:
        raise CaptureError(f"{source.info.name}: {_nothing(options.to, others, seen_towards)}")
    notes = list(_changed(int(harm[0]), int(harm[1]), options))
    out = join_datagrams(parts)
    if sending and sending.renews:
        out = Outgoing.bare(out.link, *sending.renew([out[row] for row in range(len(out))], out.time_ns))
    notes += sending.refusals if sending else ()
    if any(link.bridge != options.to.link.bridge or not link.bridge for link in others):
        notes.append(f"left out: {listed([*others.values()])}")
    return Loaded(out, tuple(sorted(subscriptions)), tuple(notes))


def _harm(batch: PacketBatch) -> Integers:
    """Return the number of datagrams that the capture cut, and the number that came over TCP."""
    cut = np.count_nonzero(batch.capture_findings & np.uint32(Finding.CAPTURE_CUT))
    return np.array([cut, 0 if batch.streams is None else np.count_nonzero(batch.streams)])


def _changed(cut: int, over_tcp: int, options: SendOptions) -> Iterator[str]:
    """Yield notes on datagrams that do not leave as they came."""
    if cut:
        yield f"{cut:,} datagrams were cut by the capture, and are sent cut"
    if over_tcp and not options.over_tcp:
        yield f"{over_tcp:,} of them came over TCP, and are sent as datagrams; --tcp sends them over TCP"


def _towards(batch: PacketBatch, columns: Columns, options: SendOptions, mission: Mission) -> Mask:
    if options.to.sending:
        return options.to.sending.outgoing_rows(batch, columns)
    towards: Mask = columns.link == options.to.link
    if options.to is Receiver.SBN:
        ports = [link.peer_port for link in mission.flight] or [_SBN_PORT]
        on_port = np.isin(batch.destination_port, ports)
        if batch.streams is not None:  # cFS connects to peers with a higher ProcessorID, which listen
            theirs = [link.udp_receive_port for link in mission.flight] or [BRIDGE_PORT]
            on_port |= batch.streams & np.isin(batch.source_port, theirs)
        towards = towards & on_port
    return towards


def _subscriptions(batch: PacketBatch, columns: Columns, towards: Mask) -> set[int]:
    """Return the MsgIds that the captured peer subscribed to."""
    msg_ids: set[int] = set()
    for row in np.flatnonzero(towards & (columns.sbn_msg_type == sbn.MsgType.SUB)).tolist():
        start = int(batch.offset[row]) + sbn.HEADER.size
        payload = batch.data[start : int(batch.offset[row] + batch.length[row])].tobytes()
        try:
            ident, entries = sbn.parse_subscriptions(payload)
        except WireError:
            continue
        if ident == sbn.IDENT:
            msg_ids |= {item.msg_id for item in entries}
    return msg_ids


def _routes(columns: Columns, patterns: Sequence[str], mission: Mission) -> Mask:
    if not patterns:
        return np.ones(len(columns), bool)
    msg_ids = np.unique(columns.msg_id).tolist()
    fitting = [
        item
        for item in msg_ids
        if item != NO_MSG_ID and any(fits(pattern, item, mission) for pattern in patterns)
    ]
    return np.isin(columns.msg_id, fitting)


def _others(own: Link, links: Integers, options: Mapping[Link, str]) -> dict[Link, str]:
    """Return the other links in a file, in words, with the option that sends each."""
    return {
        link(code): f"{int(links[code]):,} of {link(code).name if code else 'no link'} "
        f"({options.get(link(code), 'nothing sends it')})"
        for code in np.flatnonzero(links).tolist()
        if code != own
    }


def _nothing(to: Receiver | LinkReceiver, others: Mapping[Link, str], number: int) -> str:
    noun = f"messages for {to}" if isinstance(to, LinkReceiver) else _WHAT[to]
    if number:
        return f"none of its {number:,} {noun} was selected; remove some of the selection options"
    hint = f"it has {listed([*others.values()])}" if others else "it has no traffic at all"
    return f"contains no {noun}; {hint}; other ports: --set port"


def headers_named(name: str) -> cfe.Headers:
    """Return the headers of a build by the name that ``replay --write-headers`` gives it.

    Raises:
        ConfigError: there is no such build.
    """
    if name not in _BUILDS:
        raise ConfigError(f"--write-headers: {name!r} is not known; there are {listed([*_BUILDS])}")
    return _BUILDS[name]


def changes_for(
    options: SendOptions,
    remap: Mapping[int, int],
    mission: Mission,
    types: TypeStore,
    *,
    restamp: bool,
    headers: cfe.Headers | None = None,
) -> Changes:
    """Return the changes that datagrams get.

    Args:
        options: sequence, checksum and sender.
        remap: one MsgId to another.
        mission: its routes show which messages have a stamp.
        types: message types.
        restamp: whether header stamps become the time of sending.
        headers: headers that all packets get; None keeps the captured ones.
    """
    stamped = None
    if restamp:
        stamped = np.array([_is_stamped(types, route.type) for route in mission.routes], bool)
        if not stamped.any():
            raise ConfigError("--restamp: no configured topic has a type that starts with a std_msgs/Header")
    return Changes(remap, options.sequence, options.checksum, stamped, options.sender, headers)


def _is_stamped(types: TypeStore, name: str) -> bool:
    """Return whether a type begins with a header, so that its stamp has the same offset in every message."""
    if not types.has(name):
        return False
    return any(span[0] == _STAMP and span[2] == 4 for span in types.spans(name, types.encode(name, {})))


def remapped(
    pairs: Sequence[tuple[str, str]],
    mission: Mission,
    *,
    extended: bool = False,
    target: MsgIds | None = None,
) -> dict[int, int]:
    """Return pairs of MsgIds for pairs of MsgIds, topics or keys.

    Args:
        pairs: old and new.
        mission: knows topics and keys.
        extended: whether all packets have extended headers, which are as long in commands as in telemetry.
        target: version of the new MsgIds; None for that of the mission.

    Raises:
        ConfigError: a command would become telemetry or the reverse; these headers have different lengths.
        RouteError: a topic is not configured.
    """
    pairs_of: dict[int, int] = {}
    other = mission.numbered(target or mission.msg_ids)
    for old, new in pairs:
        before, after = _msg_id(old, mission), _msg_id(new, other)
        differs = mission.msg_ids.is_command(before) != other.msg_ids.is_command(after)
        if differs and not extended:
            raise ConfigError(
                f"--remap {old}:={new}: of {called(before, mission)} and {called(after, other)} one is a "
                "command, one telemetry; their headers differ"
            )
        pairs_of[before] = after
    return pairs_of


def _msg_id(name: str, mission: Mission) -> int:
    if name[:2].lower() == "0x" or name.isdigit():
        try:
            value = int(name, 0)
        except ValueError:
            value = -1
        if not 0 < value <= cfe.HIGHEST_MSG_ID:
            raise ConfigError(f"--remap: {name} is not a MsgId from 0x0001 to 0x{cfe.HIGHEST_MSG_ID:04x}")
        return value
    return mission.find(name).msg_id


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
