"""Reads mission files, from disk or from a recording's attachments, into one mission."""

from __future__ import annotations

import os
from operator import itemgetter
from pathlib import Path, PurePath
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from edoras_tools.errors import ConfigError
from edoras_tools.mission.bridges import (
    find_bridges,
    is_transfer,
    read_bridge,
    read_pdu_msg_ids,
    read_stored,
    read_transfer,
)
from edoras_tools.mission.framing import FRAMES_GROUP, read_framed_ports
from edoras_tools.mission.model import Mission
from edoras_tools.mission.parameters import read_nodes
from edoras_tools.mission.report import Mistakes
from edoras_tools.mission.tree import LARGEST_FILE, yaml_text
from edoras_tools.wire.msg_id import VERSION_1

if TYPE_CHECKING:
    from collections.abc import Container, Iterable, Mapping

    from edoras_tools.mission.bridges import CheckType, Claims
    from edoras_tools.mission.model import (
        Bridge,
        FlightLink,
        FramedPort,
        GroundLink,
        Route,
        StoredTopic,
        TransferLink,
    )
    from edoras_tools.wire.msg_id import MsgIds

_PARAMETERS: Final = b"ros__parameters"


def load(
    paths: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    *,
    check_type: CheckType | None = None,
    msg_ids: MsgIds = VERSION_1,
) -> Mission:
    """Read EDORAS bridge files, ground and flight alike, into one mission.

    Args:
        paths: one file or several; none give an empty mission. A folder stands for all YAML files in
            it; those that are no parameter files of ROS 2, or have no bridge, are left out with a warning.
        check_type: asked for every ROS type; returns None where it is known, else what is wrong, as
            ``unknown type a/msg/B; did you mean a/msg/C?``.

    Raises:
        ConfigError: all mistakes of all files at once.
    """
    paths = [paths] if isinstance(paths, (str, os.PathLike)) else paths
    folders = [(path, _files(path)) for path in paths]
    contents = [
        item
        for path, files in folders
        for item in ([(os.fspath(path), _read(path))] if files is None else files)
    ]
    of_folders = {name for _, files in folders for name, _ in files or ()}
    return _mission(contents, check_type, msg_ids, of_folders)


def loads(
    files: Mapping[str, bytes], *, check_type: CheckType | None = None, msg_ids: MsgIds = VERSION_1
) -> Mission:
    """Read bridge files that are in memory, by name, as ``Mission.files`` and the attachments of a recording.

    Raises:
        ConfigError: all mistakes of all files at once.
    """
    return _mission(list(files.items()), check_type, msg_ids)


def _files(path: str | os.PathLike[str]) -> list[tuple[str, bytes | str]] | None:
    """Return the YAML files of a folder; None for a file."""
    try:
        if not Path(path).is_dir():
            return None
        files = sorted(item for item in Path(path).iterdir() if item.suffix in {".yaml", ".yml"})
    except OSError:
        return None
    return [(str(item), _read(item)) for item in files] or [
        (os.fspath(path), "a folder without YAML files; give the files of bridges")
    ]


def _read(path: str | os.PathLike[str]) -> bytes | str:
    """Return a file's bytes, or why there are none."""
    try:
        with Path(path).open("rb") as file:
            return file.read(LARGEST_FILE + 1)
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
) -> Mission:
    reports = []
    files: dict[str, bytes] = {}
    claims: Claims = {}
    links: list[GroundLink | FlightLink | TransferLink] = []
    routes: list[Route] = []
    whole: list[Bridge] = []
    framed: list[FramedPort] = []
    pdus: list[int] = []
    stored: list[StoredTopic] = []
    taken: dict[int, str] = {}
    for name, content in contents:
        if content in files.values():
            continue  # the same file given twice
        report = Mistakes(name)
        reports.append(report)
        if name in of_folders and isinstance(content, bytes) and _PARAMETERS not in content:
            report.warn(0, "", "left out: not a parameter file of ROS 2")
            continue
        if isinstance(content, bytes):
            files[_free_name(PurePath(name).name, files)] = content
        text = _text(content, report)
        nodes = read_nodes(text, report) if text is not None else []
        bridges, transfers = find_bridges(nodes), [node for node in nodes if is_transfer(node)]
        pdus += [item for node in transfers for item in read_pdu_msg_ids(node, report)]
        stored += [item for node in transfers for item in read_stored(node, check_type)]
        links += [link for node in transfers if (link := read_transfer(node, report)) is not None]
        framing = [node for node in nodes if FRAMES_GROUP in node.groups]
        framed += [port for node in framing for port in read_framed_ports(node, report, taken)]
        if nodes and not (bridges or transfers or framing or report.mistakes):
            what = "no node here is a bridge; it needs communication, command and telemetry"
            (report.warn if name in of_folders else report.mistake)(nodes[0].line, nodes[0].name, what)
        for node in bridges:
            bridge, found = read_bridge(node, report, claims, check_type, msg_ids)
            routes += found
            if bridge is not None:
                whole.append(bridge)
                if bridge.link not in links:
                    links.append(bridge.link)
    mistakes = _in_order(report.mistakes for report in reports)
    if mistakes:
        raise ConfigError(*mistakes)
    warnings = _in_order(report.warnings for report in reports)
    return Mission(
        tuple(routes),
        tuple(links),
        MappingProxyType(files),
        tuple(warnings),
        tuple(whole),
        msg_ids,
        tuple(framed),
        tuple(dict.fromkeys(pdus)),
        tuple(dict.fromkeys(stored)),
    )


def _in_order(found: Iterable[list[tuple[int, str]]]) -> list[str]:
    """Return the messages of each file, sorted by line, each once: a wildcard may apply to several nodes."""
    return list(dict.fromkeys(text for lines in found for _, text in sorted(lines, key=itemgetter(0))))


def _text(content: bytes | str, report: Mistakes) -> str | None:
    if isinstance(content, str):
        report.mistake(0, "", content)
        return None
    return yaml_text(content, report, "give the YAML file of a bridge")


def _free_name(name: str, taken: Mapping[str, bytes]) -> str:
    """Return the name, numbered where two files of different folders share it."""
    path, number, free = PurePath(name or "mission.yaml"), 2, name or "mission.yaml"
    while free in taken:
        free, number = f"{path.stem}_{number}{path.suffix}", number + 1
    return free
