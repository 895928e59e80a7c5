"""Makes a link and its routes from one node's parameters, with the checks that the bridges make.

edoras-tools adds keys to a bridge's file, rates and quality of service: below the key of one topic, or below
``edoras`` for all topics. The public bridges ignore these keys: they declare every parameter of the file and
look up only their own by name.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, Final, Literal

from msgspec.structs import replace

from edoras_tools.errors import ConfigError
from edoras_tools.links.table import carrying
from edoras_tools.mission import model
from edoras_tools.mission.tree import Fields, Mistakes, NodeParameters, ScalarNode, printable, suggestion
from edoras_tools.wire import cfe
from edoras_tools.wire.ccsds import VERSION_1, MsgIds
from edoras_tools.wire.envelope import EnvelopeFormat

if TYPE_CHECKING:
    CheckType = Callable[[str], str | None]

    from edoras_tools.model import Link

    Claims = dict[tuple[Link, int], tuple[NodeParameters, model.Route]]


HANDLING_GROUP: Final = "edoras"
"""Group of the keys for all topics of a bridge, and for the bridge itself."""
TOPIC_KEYS: Final = ("max_rate", "keep", "to_limit")
BRIDGE_KEYS: Final = ("max_rate", "keep", "max_rate_total", "max_size")
_QOS: Final = ("reliability", "durability", "depth")
_MOST: Final = 1 << 20
_TO_MOST: Final = 0xFF
"""Highest limit of Telemetry Output, which stores it in eight bits."""


def read_handling(fields: Fields, group: str, defaults: model.Handling) -> model.Handling:
    """Read the handling of topics from a group; mistakes go to the report.

    Args:
        fields: parameters of the node.
        group: key of a topic, or ``HANDLING_GROUP``.
        defaults: handling for keys that the group does not have.
    """
    keep: Any = fields.word(f"{group}.keep", ("latest", "first"))
    reliability = fields.word(f"{group}.qos.reliability", ("reliable", "best_effort"))
    durability = fields.word(f"{group}.qos.durability", ("volatile", "transient_local"))
    warn_of_unknown(fields, f"{group}.qos", _QOS)
    return model.Handling(
        max_rate=fields.rate(f"{group}.max_rate") or defaults.max_rate,
        keep=keep or defaults.keep,
        reliable=reliability == "reliable" if reliability else defaults.reliable,
        transient_local=durability == "transient_local" if durability else defaults.transient_local,
        depth=fields.count(f"{group}.qos.depth", _MOST) or defaults.depth,
        to_limit=fields.count(f"{group}.to_limit", _TO_MOST) if group != HANDLING_GROUP else None,
    )


def warn_of_unknown(fields: Fields, group: str, keys: Sequence[str]) -> None:
    """Warn of unknown keys in a group."""
    for name in fields.node.children(group):
        if name not in keys:
            words = ", ".join(keys)
            fields.warn(f"{group}.{name}", f"ignored; {suggestion(name, keys)}read are {words}")


# Kind of each parameter: an address (None), or the limits of an integer.
_ADDRESS: Final = None
_PORT: Final = (1, 0xFFFF)
_ID: Final = (0, 0xFFFFFFFF)
_LARGEST: Final = 65507
_PDU_MSG_IDS: Final = "cfdp.msg_ids"
_GROUND: Final[dict[str, tuple[int, int] | None]] = {
    "bridge_port": _PORT,
    "fsw_port": _PORT,
    "fsw_ip": _ADDRESS,
    "telemetry_ip": _ADDRESS,
    "bridge_ip": _ADDRESS,
}
_OPTIONAL: Final = {"bridge_ip"}
_FLIGHT: Final[dict[str, tuple[int, int] | None]] = {
    "peer_ip": _ADDRESS,
    "peer_port": _PORT,
    "peer_processor_id": _ID,
    "peer_spacecraft_id": _ID,
    "udp_receive_port": _PORT,
    "udp_receive_ip": _ADDRESS,
    "processor_id": _ID,
    "spacecraft_id": _ID,
}
_ROUTE_KEYS: Final = ("type", "topic", "mid", "envelope", *TOPIC_KEYS)
_DIRECTIONS: Final[tuple[Literal["command", "telemetry"], ...]] = ("command", "telemetry")

_SECONDARY_HEADER_BIT = 0x0800

_TYPE = re.compile(r"[a-z][a-z0-9_]*/msg/[A-Z][A-Za-z0-9]*")
_OTHER_SPELLING = re.compile(r"([a-z][a-z0-9_]*)(?:/|::|\.)(?:msg(?:/|::|\.))?([A-Z][A-Za-z0-9]*)")
_TOPIC = re.compile(r"(?:/[A-Za-z_][A-Za-z0-9_]*)+")
_LONGEST_TOPIC: Final = 247
"""Most characters of a topic, as rmw limits it."""


def node_of(name: str) -> tuple[str, str]:
    """Return namespace and name of a node, each empty for a wildcard, as without ``__ns`` or ``__node``."""
    namespace, _, last = name.rpartition("/")
    return "" if "*" in namespace else namespace, "" if "*" in last else last


def full_topic(text: str, node: str) -> str:
    """Return a node's topic, fully qualified as rcl expands it; empty if the result is no valid topic.

    Args:
        text: topic as in the code or a file: ``cmd_vel``, ``/cmd_vel``, ``~/cmd_vel``, ``{node}/cmd_vel``.
        node: fully qualified name of the node; a wildcard if it is not known.
    """
    namespace, name = node_of(node)
    if not name and (text.startswith("~") or "{node}" in text):
        return ""
    for word, value in (("{node}", name), ("{ns}", namespace or "/"), ("{namespace}", namespace or "/")):
        text = text.replace(word, value)
    if text == "~" or text.startswith("~/"):
        text = f"{namespace}/{name}{text[1:]}"
    topic = text if text.startswith("/") else f"{namespace}/{text}"
    return topic if _TOPIC.fullmatch(topic) and len(topic) <= _LONGEST_TOPIC else ""


def find_bridges(nodes: list[NodeParameters]) -> list[NodeParameters]:
    """Return the nodes that are bridges; a file may hold other nodes too, even with ``communication``."""

    def having(*names: str) -> list[NodeParameters]:
        return [node for node in nodes if not {*names}.isdisjoint(node.lines)]

    return having(*_DIRECTIONS) or [node for node in having("communication") if not is_transfer(node)]


def is_transfer(node: NodeParameters) -> bool:
    """Return whether a node is EDORAS's ``data_transfer``, whose file has ``communication`` too."""
    return not {"cfdp", "write_data", "read_data", "store_data"}.isdisjoint(node.lines)


def read_transfer(node: NodeParameters, report: Mistakes) -> model.TransferLink | None:
    """Return the CFDP entities of a ``data_transfer`` node; None if it has none, or a mistake."""
    fields = Fields(node, report)
    if "cfdp" not in node.groups or (fields.has(_PDU_MSG_IDS) and not fields.has("cfdp.port")):
        return None
    port, peer = (fields.integer(name, *_PORT) for name in ("cfdp.port", "cfdp.port_peer"))
    return model.TransferLink(port, peer, report.file, node.lines["cfdp"]) if port and peer else None


def read_stored(node: NodeParameters, check_type: CheckType | None) -> Iterator[model.StoredTopic]:
    """Yield the topics of a ``data_transfer`` node, first those that it writes.

    Entries without topic, file or known type are left out: ``data_transfer`` checks its own file.
    """
    for group in ("write_data", "read_data"):
        listed = node.values.get(group)
        for key in listed if isinstance(listed, tuple) else ():
            values = (node.values.get(f"{key.value}.{name}") for name in ("topic", "type", "store_filename"))
            topic, kind, file = (str(item.value) if isinstance(item, ScalarNode) else "" for item in values)
            name = file.rpartition("/")[2]
            well_formed = _TYPE.fullmatch(kind) and (check_type is None or check_type(kind) is None)
            if name and well_formed and (topic := full_topic(topic, node.name)):
                yield model.StoredTopic(topic, kind, name)


def read_pdu_msg_ids(node: NodeParameters, report: Mistakes) -> tuple[int, ...]:
    """Return the MsgIds of packets that hold one CFDP PDU each; the key is our own."""
    return Fields(node, report).msg_ids(_PDU_MSG_IDS)


def read_bridge(
    node: NodeParameters,
    report: Mistakes,
    claims: Claims,
    check_type: CheckType | None,
    msg_ids: MsgIds = VERSION_1,
) -> tuple[model.Bridge | None, list[model.Route]]:
    """Return the valid part of a bridge, and its routes that no other bridge has; mistakes go to ``report``.

    Args:
        node: parameters of the bridge.
        report: report of its file.
        claims: owner of each MsgId on each link, over all bridges; this call adds to it.
        check_type: returns what is wrong with a ROS type, None if nothing is.
        msg_ids: version of the MsgIds.
    """
    fields = Fields(node, report)
    flight, link = _communication(fields)
    reader = _Routes(fields, flight, claims, check_type, msg_ids)
    for direction in _DIRECTIONS:
        for item in fields.keys(direction):
            # The bridge ignores a key without a mapping; [''] is ROS 2's spelling of an empty list.
            if item.value:
                reader.listed(str(item.value), item.line, direction)
    reader.warn_of_unlisted()
    total = fields.rate(f"{HANDLING_GROUP}.max_rate_total")
    size = fields.count(f"{HANDLING_GROUP}.max_size", _LARGEST)
    warn_of_unknown(fields, HANDLING_GROUP, BRIDGE_KEYS)
    if link is None:
        return None, reader.routes
    return model.Bridge(node.name, link, tuple(reader.whole), total, size), reader.routes


def _communication(fields: Fields) -> tuple[bool, model.GroundLink | model.FlightLink | None]:
    """Return whether the node is a flight bridge, and its link; None if a parameter of the link is wrong."""
    group, node = "communication", fields.node
    present = node.children(group)
    flight_keys, ground_keys = len(_FLIGHT.keys() & present), len(_GROUND.keys() & present)
    if flight_keys == ground_keys:
        text = "neither a ground nor a flight bridge's" if group in node.groups else "missing"
        allowed = f"a ground bridge needs {_words(_GROUND)}; a flight bridge {_words(_FLIGHT)}"
        fields.mistake(group, f"{text}; {allowed}")
        return False, None
    flight = flight_keys > ground_keys
    keys = _FLIGHT if flight else _GROUND
    values: dict[str, Any] = {}
    for key, limits in keys.items():
        name = f"{group}.{key}"
        if key not in _OPTIONAL or fields.has(name):
            values[key] = fields.integer(name, *limits) if limits else fields.address(name)
    for key in present:
        if key not in keys:
            kind = "flight" if flight else "ground"
            text = f"ignored; {suggestion(key, keys)}a {kind} bridge reads {_words(keys)}"
            fields.warn(f"{group}.{key}", text)
    if None in values.values():
        return flight, None
    place: dict[str, Any] = {"file": fields.report.file, "line": node.lines[group]}
    return flight, model.FlightLink(**values, **place) if flight else model.GroundLink(**values, **place)


class _Routes:
    """Collects the routes of one bridge, key by key."""

    def __init__(
        self, fields: Fields, flight: bool, claims: Claims, check_type: CheckType | None, msg_ids: MsgIds
    ) -> None:
        self.fields = fields
        self.flight = flight
        self.claims = claims
        self.check_type = check_type
        self.msg_ids = msg_ids
        self.routes: list[model.Route] = []
        self.whole: list[model.Route] = []
        self.defaults = read_handling(fields, HANDLING_GROUP, model.Handling())
        self.keys: dict[str, int] = {}
        self.topics: dict[str, tuple[str, int]] = {}

    def listed(self, key: str, line: int, direction: Literal["command", "telemetry"]) -> None:
        """Add the route of a key that ``command`` or ``telemetry`` lists on ``line``."""
        fields, node = self.fields, self.fields.node
        if key in self.keys:
            fields.report.mistake(
                line, direction, f"{printable(key)} is listed on line {self.keys[key]} already; list it once"
            )
            return
        self.keys[key] = line
        if key not in node.groups:
            if key not in node.values:
                near = suggestion(key, _mappings(node))
                advice = f"{near}write {printable(key)}: {{type: ..., topic: ..., mid: ...}}"
                fields.report.mistake(line, direction, f"{printable(key)} has no mapping; {advice}")
            elif node.values[key] is not None:
                fields.mistake(key, "no mapping; type, topic and mid are needed below it")
            return
        type_name, topic, msg_id = self._type(key), self._topic(key), self._msg_id(key)
        envelope = self._envelope(key)
        # The rate of a bridge protects its cFS, so it does not limit messages from cFS.
        defaults = self.defaults if direction == "command" else replace(self.defaults, max_rate=None)
        handling = read_handling(fields, key, defaults)
        warn_of_unknown(fields, key, _ROUTE_KEYS)
        if msg_id is None:
            return
        link = carrying("flight" if self.flight else "ground", to_cfs=direction == "command")
        route = model.Route(
            topic or "",
            type_name or "",
            msg_id,
            link,
            direction,
            key,
            fields.report.file,
            node.lines[key],
            envelope,
            handling,
        )
        first = self._claim(route)
        if not topic or not type_name:
            return
        self.whole.append(route)
        if first:
            self._warn_of_msg_id(route)
            self.routes.append(route)

    def _type(self, key: str) -> str | None:
        name, form = f"{key}.type", "package/msg/Name"
        text = self.fields.text(name, f"a ROS type is needed, as {form}")
        if text is None:
            return None
        if not _TYPE.fullmatch(text):
            other = _OTHER_SPELLING.fullmatch(text)
            allowed = f"write {other[1]}/msg/{other[2]}" if other else f"the bridge needs {form}"
            self.fields.mistake(name, f'"{printable(text)}" is not of the form {form}; {allowed}')
            return None
        wrong = self.check_type(text) if self.check_type else None
        if wrong is not None:
            self.fields.mistake(name, wrong)
            return None
        return text

    def _topic(self, key: str) -> str | None:
        name = f"{key}.topic"
        text = self.fields.text(name, "a topic is needed, as /robot_1/cmd_vel")
        if text is None:
            return None
        node = self.fields.node
        topic = full_topic(text, node.name)
        if not topic:
            allowed = (
                "letters, digits and _ between single slashes are allowed, no part starting with a digit"
            )
            if text.startswith("~") and full_topic(text, "/node"):
                allowed = f"~ needs the node's name in place of {node.name or 'none'}, or -r __node:=NAME"
            self.fields.mistake(name, f'"{printable(text)}" is not a topic; {allowed}')
            return None
        topic = node.remap(topic)
        if topic in self.topics:
            other, line = self.topics[topic]
            clash = f"{topic} is the topic of {printable(other)} on line {line} already"
            self.fields.mistake(name, f"{clash}; a bridge takes a topic once")
            return None
        self.topics[topic] = (key, self.fields.node.line_of(name))
        return topic

    def _msg_id(self, key: str) -> int | None:
        name = f"{key}.mid"
        allowed = f"a MsgId from 0x1 to 0x{cfe.HIGHEST_MSG_ID:X} is needed"
        msg_id = self.fields.integer(name, allowed=allowed)
        if msg_id is None or 1 <= msg_id <= cfe.HIGHEST_MSG_ID:
            return msg_id
        reason = "is refused by cFE" if 0 <= msg_id <= 0xFFFF else "does not fit 16 bits"
        self.fields.mistake(name, f"{msg_id:#x} {reason}; {allowed}")
        return None

    def _envelope(self, key: str) -> str | None:
        name = f"{key}.envelope"
        if not self.fields.has(name):
            return None
        value = self.fields.node.values.get(name)
        if isinstance(value, tuple):
            text: str | None = ", ".join(str(item.value) for item in value)
        else:
            text = self.fields.text(name, "auto, 8/8, 4/4, 2/2 or 1/1 is needed, or a list of words")
        if text is None or text == "auto":
            return text
        try:
            return str(EnvelopeFormat.of_name(text))
        except ConfigError as error:
            allowed = "auto, 8/8, 4/4, 2/2 and 1/1 are allowed, the first numbers with le or be behind"
            plain = f'"{printable(text)}" is not an envelope; {allowed}'
            self.fields.mistake(name, str(error) if isinstance(value, tuple) else plain)
            return None

    def _claim(self, route: model.Route) -> bool:
        """Claim the MsgId; return False if another topic has it, or another bridge has the same route."""
        node, other = self.claims.setdefault((route.link, route.msg_id), (self.fields.node, route))
        if other is route:
            return True
        same = (other.topic, other.type) == (route.topic, route.type) and node is not self.fields.node
        if not same:
            place = f"{printable(other.file, 200)}:{other.line}: {printable(other.key)}"
            clash = f"0x{route.msg_id:04X} carries {other.topic or 'another topic'} already ({place})"
            self.fields.mistake(
                f"{route.key}.mid", f"{clash}; one topic a MsgId on the {route.link.label} link"
            )
        return False

    def _warn_of_msg_id(self, route: model.Route) -> None:
        name, msg_ids = f"{route.key}.mid", self.msg_ids
        command = msg_ids.is_command(route.msg_id)
        if msg_ids is VERSION_1 and not route.msg_id & _SECONDARY_HEADER_BIT:
            text = f"0x{route.msg_id:04X} lacks 0x0800, the secondary header bit that cFE messages have"
            self.fields.warn(name, f"{text}; is it hexadecimal, written without 0x?")
        elif not self.flight and command != route.to_cfs:
            kind, usual = ("a command", "lacks") if command else ("a telemetry", "has")
            text = f"0x{route.msg_id:04X} is {kind} MsgId under {route.direction}"
            usual = f"{usual} the bit 0x{msg_ids.command_bit:04X} as a rule"
            self.fields.warn(name, f"{text}; a ground bridge's {route.direction} {usual}")

    def warn_of_unlisted(self) -> None:
        """Warn of mappings that are in neither list."""
        for key in _mappings(self.fields.node):
            if key not in self.keys:
                self.fields.warn(key, "ignored; a bridge reads what command or telemetry lists")


def _mappings(node: NodeParameters) -> list[str]:
    """Return the groups that look like a route."""
    return [
        key for key in node.lines if key in node.groups and {"type", "topic", "mid"} & {*node.children(key)}
    ]


def _words(names: Iterable[str]) -> str:
    return ", ".join(f"{name} (optional)" if name in _OPTIONAL else name for name in names)
