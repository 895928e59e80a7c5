"""Reads mission files, from disk or from a recording's attachments, into one mission."""

from __future__ import annotations

import ipaddress
import os
import re
import shlex
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from operator import itemgetter
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any, Final

from msgspec.structs import replace

from edoras_tools import doors
from edoras_tools.cfs.profile import constant_names
from edoras_tools.errors import ConfigError
from edoras_tools.links.table import link_of_label, links
from edoras_tools.mission import bridges, tree
from edoras_tools.mission.model import FlightSoftware, FramedPort, Mission
from edoras_tools.wire.ccsds import VERSION_1, MsgIds
from edoras_tools.wire.cfe import HIGHEST_MSG_ID, MissionTime
from edoras_tools.wire.transfer_frames import FRAME_LAYOUTS, FrameFormat
from edoras_tools.words import either

if TYPE_CHECKING:
    from edoras_tools.mission.bridges import CheckType, Claims
    from edoras_tools.mission.model import Bridge, FlightLink, GroundLink, Route, StoredTopic, TransferLink

_PARAMETERS: Final = b"ros__parameters"
ROS_ARGS: Final = "ros_args"
"""Name of a mission's file that holds the words of ``--ros-args``, in shell syntax."""


def load(
    paths: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    *,
    check_type: CheckType | None = None,
    msg_ids: MsgIds = VERSION_1,
    ros_args: Sequence[str] = (),
) -> Mission:
    """Read EDORAS bridge files, ground and flight alike, into one mission.

    Args:
        paths: one file or several; without a file the mission is empty. A folder means all YAML files in it;
            files that are no parameter files of ROS 2, or have no bridge, are left out with a warning.
        check_type: called with every ROS type; returns None if it is known, else the mistake, as
            ``unknown type a/msg/B; did you mean a/msg/C?``.
        msg_ids: version of the MsgIds.
        ros_args: words after ``--ros-args`` when the bridges are started; they apply to every file.

    Raises:
        ConfigError: all mistakes of all files at once.
    """
    paths = [paths] if isinstance(paths, (str, os.PathLike)) else paths
    folders = [(path, _files(path)) for path in paths]
    contents = [
        item
        for path, files in folders
        for item in ([(os.fspath(path), read_file(path))] if files is None else files)
    ]
    of_folders = {name for _, files in folders for name, _ in files or ()}
    return _mission(contents, check_type, msg_ids, of_folders, ros_args)


def loads(
    files: Mapping[str, bytes], *, check_type: CheckType | None = None, msg_ids: MsgIds = VERSION_1
) -> Mission:
    """Read bridge files from memory, by name, as in ``Mission.files`` or the attachments of a recording.

    Raises:
        ConfigError: all mistakes of all files at once.
    """
    words = shlex.split(files.get(ROS_ARGS, b"").decode("utf-8", "replace"))
    contents: list[tuple[str, bytes | str]] = [item for item in files.items() if item[0] != ROS_ARGS]
    return _mission(contents, check_type, msg_ids, ros_args=words)


def _files(path: str | os.PathLike[str]) -> list[tuple[str, bytes | str]] | None:
    """Return name and content of the YAML files in a folder; None for a file."""
    try:
        if not Path(path).is_dir():
            return None
        files = sorted(item for item in Path(path).iterdir() if item.suffix in {".yaml", ".yml"})
    except OSError:
        return None
    return [(str(item), read_file(item)) for item in files] or [
        (os.fspath(path), "a folder without YAML files; give the files of bridges")
    ]


def read_file(path: str | os.PathLike[str]) -> bytes | str:
    """Return a file's bytes, or as text the reason why it cannot be read."""
    try:
        with Path(path).open("rb") as file:
            return file.read(tree.LARGEST_FILE + 1)
    except FileNotFoundError:
        return "no such file; give the YAML file of a bridge"
    except (OSError, ValueError) as error:
        why = (error.strerror if isinstance(error, OSError) else None) or str(error)
        return f"cannot be read ({why}); give a file that can"


def _mission(
    contents: list[tuple[str, bytes | str]],
    check_type: CheckType | None,
    msg_ids: MsgIds,
    of_folders: Container[str] = (),
    ros_args: Sequence[str] = (),
) -> Mission:
    loading = _Loading(check_type, msg_ids)
    if ros_args:
        by_name = {PurePath(name).name: content for name, content in contents}
        loading.arguments = doors.part("ros_args")(
            ros_args, lambda path: by_name.get(PurePath(path).name) or read_file(path)
        )
        loading.files |= {ROS_ARGS: shlex.join(ros_args).encode(), **loading.arguments.overrides}
    for name, content in contents:
        if content not in loading.files.values():  # the same file given twice
            loading.add(name, content, of_folder=name in of_folders)
    return loading.mission()


class _Loading:
    """The content of a mission's files, collected while they are read; ``mission`` reports all mistakes.

    Attributes:
        files: bytes of each file, by name.
        arguments: arguments that its bridges are started with; None if there are none.
    """

    def __init__(self, check_type: CheckType | None, msg_ids: MsgIds) -> None:
        self.files: dict[str, bytes] = {}
        self.arguments: Any = None
        self._check_type, self._msg_ids = check_type, msg_ids
        self._reports: list[tree.Mistakes] = []
        self._claims: Claims = {}
        self._ports: dict[int, str] = {}
        self._links: list[GroundLink | FlightLink | TransferLink] = []
        self._routes: list[Route] = []
        self._bridges: list[Bridge] = []
        self._framed: list[FramedPort] = []
        self._pdus: list[int] = []
        self._topics: list[StoredTopic] = []
        self._software: FlightSoftware | None = None
        self._spacecraft: dict[str, str] = {}

    def add(self, name: str, content: bytes | str, *, of_folder: bool) -> None:
        """Read one file.

        Args:
            name: name of the file.
            content: its bytes; a text is the reason why there are none.
            of_folder: whether the file was found in a folder: then a file without a bridge only gets a
                warning.
        """
        report = tree.Mistakes(name)
        self._reports.append(report)
        if of_folder and isinstance(content, bytes) and _PARAMETERS not in content:
            report.warn(0, "", "left out: not a parameter file of ROS 2")
            return
        if isinstance(content, bytes):
            self.files[_free_name(PurePath(name).name, self.files)] = content
        nodes = self._nodes(_text(content, report), report)
        bridge_nodes = bridges.find_bridges(nodes)
        others = self._add_others(nodes, report)
        if nodes and not (bridge_nodes or others or report.mistakes):
            problem = "no node here is a bridge; it needs communication, command and telemetry"
            (report.warn if of_folder else report.mistake)(nodes[0].line, nodes[0].name, problem)
        for node in bridge_nodes:
            bridge, routes = bridges.read_bridge(node, report, self._claims, self._check_type, self._msg_ids)
            self._routes += routes
            if bridge is not None:
                self._bridges.append(bridge)
                if bridge.link not in self._links:
                    self._links.append(bridge.link)

    def _add_others(self, nodes: Sequence[tree.NodeParameters], report: tree.Mistakes) -> bool:
        """Read the nodes that are no bridges; return whether there are any."""
        for node in nodes:
            if bridges.is_transfer(node):
                self._add_transfer(node, report)
            if FRAMES_GROUP in node.groups:
                self._framed += read_framed_ports(node, report, self._ports)
            if SPACECRAFT_GROUP in node.groups:
                read_spacecraft(node, report, self._spacecraft)
            if CFS_GROUP in node.groups:
                if self._software is not None:
                    report.mistake(node.line_of(CFS_GROUP), CFS_GROUP, "another one; a mission has one cFS")
                self._software = read_flight_software(node, report, self._msg_ids)
        groups = {FRAMES_GROUP, SPACECRAFT_GROUP, CFS_GROUP}
        return any(bridges.is_transfer(node) or not groups.isdisjoint(node.groups) for node in nodes)

    def mission(self) -> Mission:
        """Return the mission of all files.

        Raises:
            ConfigError: all mistakes of all files.
        """
        if mistakes := _in_order(report.mistakes for report in self._reports):
            raise ConfigError(*mistakes)
        mission = Mission(
            tuple(self._routes),
            tuple(self._links),
            dict(self.files),
            tuple(_in_order(report.warnings for report in self._reports)),
            tuple(self._bridges),
            self._msg_ids,
            tuple(self._framed),
            tuple(dict.fromkeys(self._pdus)),
            tuple(dict.fromkeys(self._topics)),
            software=self._software or FlightSoftware(),
        )
        spacecraft = tuple((name, address) for address, name in self._spacecraft.items())
        return replace(mission, spacecraft=spacecraft).of(1)

    def _nodes(self, text: str | None, report: tree.Mistakes) -> list[tree.NodeParameters]:
        nodes = [] if text is None else tree.read_nodes(text, report)
        return self.arguments.applied(nodes, report) if self.arguments else nodes

    def _add_transfer(self, node: tree.NodeParameters, report: tree.Mistakes) -> None:
        self._pdus += bridges.read_pdu_msg_ids(node, report)
        self._topics += bridges.read_stored(node, self._check_type)
        link = bridges.read_transfer(node, report)
        if link is not None:
            self._links.append(link)


def _in_order(messages: Iterable[list[tuple[int, str]]]) -> list[str]:
    """Return the messages of each file by line, each once: a wildcard may apply to several nodes."""
    return list(dict.fromkeys(text for lines in messages for _, text in sorted(lines, key=itemgetter(0))))


def _text(content: bytes | str, report: tree.Mistakes) -> str | None:
    if isinstance(content, str):
        report.mistake(0, "", content)
        return None
    return tree.yaml_text(content, report, "give the YAML file of a bridge")


def _free_name(name: str, used: Mapping[str, bytes]) -> str:
    """Return a file's name, with a number if a file of another folder has the same name."""
    path, number, free = PurePath(name or "mission.yaml"), 2, name or "mission.yaml"
    while free in used:
        free, number = f"{path.stem}_{number}{path.suffix}", number + 1
    return free


FRAMES_GROUP: Final = "frames"
_LARGEST: Final = {"tm": 2048, "aos": 65507}
"""Most bytes of a frame; 131.0-B limits those of TM, a datagram limits those of AOS."""
_USUAL_LINK: Final = {"tm": "to", "aos": "to", "tc": "ci"}
_KEYS: Final = ("port", "kind", "link", "fecf", "transport")
_OWN_KEYS: Final = {
    "tm": ("length", "ocf"),
    "aos": ("length", "ocf", "insert_zone", "header_error_control"),
    "tc": ("segment_header",),
}


def read_framed_ports(
    node: tree.NodeParameters, report: tree.Mistakes, owners: dict[int, str]
) -> Iterator[FramedPort]:
    """Yield the ports of one node's ``frames`` that have no mistake; mistakes go to ``report``.

    Args:
        node: parameters of the node.
        report: report of its file.
        owners: name of each port, over all files; this call adds to it.
    """
    fields = tree.Fields(node, report)
    names = sorted(
        (name.partition(".")[2] for name in node.groups if name.startswith(f"{FRAMES_GROUP}.")),
        key=lambda name: node.lines[f"{FRAMES_GROUP}.{name}"],
    )
    for name in node.children(FRAMES_GROUP):
        fields.mistake(f"{FRAMES_GROUP}.{name}", "a value; write NAME: {port: 5111, kind: tm, length: 1115}")
    for name in names:
        entry = _framed_port(fields, name)
        if entry is None:
            continue
        if entry.port in owners:
            text = f"{entry.port} is the port of {owners[entry.port]} already; a port has one kind of frames"
            fields.mistake(f"{FRAMES_GROUP}.{name}.port", text)
            continue
        owners[entry.port] = name
        yield entry


def _framed_port(fields: tree.Fields, name: str) -> FramedPort | None:
    group = f"{FRAMES_GROUP}.{name}"
    before = len(fields.report.mistakes)
    port = fields.integer(f"{group}.port", 1, 0xFFFF)
    kind: Any = fields.word(f"{group}.kind", tuple(FRAME_LAYOUTS))
    if kind is None:
        if not fields.has(f"{group}.kind"):
            fields.mistake(group, f"kind is missing; {either(tuple(FRAME_LAYOUTS))} is needed")
        return None
    of_packets = [item.label for item in links() if item.packets or item.dictionary]
    link = fields.word(f"{group}.link", of_packets) or _USUAL_LINK[kind]
    own = _OWN_KEYS[kind]
    transport = fields.word(f"{group}.transport", ("udp", "tcp"))
    values: dict[str, Any] = {"kind": kind, "stream": transport == "tcp"}
    for key in ("fecf", *own):
        if key == "length":
            values[key] = fields.integer(f"{group}.{key}", 1, _LARGEST[kind])
        elif fields.has(f"{group}.{key}"):
            whole = key == "insert_zone"
            place = f"{group}.{key}"
            values[key] = fields.integer(place, 0, _LARGEST[kind]) if whole else fields.flag(place)
    bridges.warn_of_unknown(fields, group, (*_KEYS, *own))
    if len(fields.report.mistakes) > before or port is None:
        return None
    form = FrameFormat(**values)
    if form.length and form.length < form.smallest:
        fields.mistake(
            f"{group}.length", f"{form.length} has no room for data; at least {form.smallest} is needed"
        )
        return None
    return FramedPort(name, port, form, link_of_label(link), fields.report.file, fields.node.lines[group])


SPACECRAFT_GROUP: Final = "spacecraft"
"""Group that maps the name of each spacecraft to its IP address."""
_CRAFT_NAME: Final = re.compile("[A-Za-z][A-Za-z0-9_]*")


def read_spacecraft(node: tree.NodeParameters, report: tree.Mistakes, owners: dict[str, str]) -> None:
    """Read the spacecraft of a node; mistakes go to ``report``.

    Args:
        node: parameters of the node.
        report: report of its file.
        owners: name of each address, over all files; this call adds to it.
    """
    fields = tree.Fields(node, report)
    for name in node.children(SPACECRAFT_GROUP):
        place, needed = f"{SPACECRAFT_GROUP}.{name}", "an IP address is needed, as 10.0.0.2"
        if not _CRAFT_NAME.fullmatch(name) or name in owners.values():
            fields.mistake(place, "a name of its own is needed, of letters, digits and _, as rover_a")
        text = fields.text(place, needed) or ""
        try:
            address = str(ipaddress.ip_address(text))
        except ValueError:
            if text:
                fields.mistake(place, f'"{tree.printable(text)}" is none; {needed}')
            continue
        if owners.setdefault(address, name) != name:
            fields.mistake(place, f"{address} is the address of {owners[address]} already")


CFS_GROUP: Final = "cfs"
"""Group of the keys that describe the flight software."""
_CFS_LIMITS: Final = "to_limits"
_CFS_PORTS: Final = "ports"
_CFS_TIME: Final = "time"
_CFS_HEADERS: Final = {"extended_header": None, "telemetry_header": (12, 16), "msg_id_version": (1, 2)}
"""Keys of the packet format, as in ``decode.Options``: None for a flag, else the allowed numbers."""


def read_flight_software(node: tree.NodeParameters, report: tree.Mistakes, msg_ids: MsgIds) -> FlightSoftware:
    """Read the ``cfs`` group of a node; mistakes go to ``report``.

    Args:
        node: parameters of the node.
        report: report of its file.
        msg_ids: version of the MsgIds in the file.
    """
    fields, whole = tree.Fields(node, report), constant_names()
    names = (*whole, _CFS_LIMITS, _CFS_PORTS, _CFS_TIME, *_CFS_HEADERS)
    constants: dict[str, int] = {}
    headers: dict[str, Any] = {}
    for name in node.children(CFS_GROUP):
        place = f"{CFS_GROUP}.{name}"
        if name == _CFS_PORTS:
            headers[name] = " ".join(str(item.value) for item in fields.keys(place))
        elif name == _CFS_TIME:
            text = fields.text(place, "write little, 1/1000 s, since 2000-01-01, or some of these") or ""
            try:
                headers[name] = str(MissionTime.of_text(text))
            except ConfigError as error:
                fields.mistake(place, str(error))
        elif name in _CFS_HEADERS:
            allowed = _CFS_HEADERS[name]
            headers[name] = fields.integer(place) if allowed else fields.flag(place)
            if allowed and headers[name] not in allowed:
                fields.mistake(place, f"{either(list(map(str, allowed)))} is needed")
        elif name in whole:
            constants[name] = fields.integer(place, 0) or 0
        else:
            fields.mistake(
                place, f"not known; {tree.suggestion(name, names)}edoras help decoding lists constants"
            )
    limits: dict[int, int] = {}
    for name in node.children(f"{CFS_GROUP}.{_CFS_LIMITS}"):
        place, msg_id = f"{CFS_GROUP}.{_CFS_LIMITS}.{name}", tree.read_scalar(name)
        limit = fields.integer(place, 0, 0xFF)
        if type(msg_id) is not int or not 0 < msg_id <= HIGHEST_MSG_ID:
            fields.mistake(place, "not a MsgId; write 0x0827: 4")
        elif limit is not None:
            limits[msg_ids.standard(msg_id)] = limit
    software = FlightSoftware(constants, limits, headers)
    try:
        _ = software.profile
    except ConfigError as error:
        fields.mistake(CFS_GROUP, str(error))
    return software
