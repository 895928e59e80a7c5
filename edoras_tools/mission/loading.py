"""Reads mission files, from disk or from a recording's attachments, into one mission."""

from __future__ import annotations

import os
from operator import itemgetter
from pathlib import Path, PurePath
from types import MappingProxyType
from typing import TYPE_CHECKING

from edoras_tools.errors import ConfigError
from edoras_tools.mission.bridges import find_bridges, read_bridge
from edoras_tools.mission.model import Mission
from edoras_tools.mission.parameters import read_nodes
from edoras_tools.mission.report import Mistakes
from edoras_tools.mission.tree import LARGEST_FILE, yaml_text

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from edoras_tools.mission.bridges import CheckType, Claims
    from edoras_tools.mission.model import Bridge, FlightLink, GroundLink, Route


def load(
    paths: str | os.PathLike[str] | Iterable[str | os.PathLike[str]], *, check_type: CheckType | None = None
) -> Mission:
    """Read EDORAS bridge files, ground and flight alike, into one mission.

    Args:
        paths: one file or several; none give an empty mission.
        check_type: asked for every ROS type; returns None where it is known, else what is wrong, as
            ``unknown type a/msg/B; did you mean a/msg/C?``.

    Raises:
        ConfigError: all mistakes of all files at once.
    """
    paths = [paths] if isinstance(paths, (str, os.PathLike)) else paths
    contents = [(os.fspath(path), _read(path)) for path in paths]
    return _mission(contents, check_type)


def loads(files: Mapping[str, bytes], *, check_type: CheckType | None = None) -> Mission:
    """Read bridge files that are in memory, by name, as ``Mission.files`` and the attachments of a recording.

    Raises:
        ConfigError: all mistakes of all files at once.
    """
    return _mission(list(files.items()), check_type)


def _read(path: str | os.PathLike[str]) -> bytes | str:
    """Return a file's bytes, or why there are none."""
    try:
        with Path(path).open("rb") as file:
            return file.read(LARGEST_FILE + 1)
    except FileNotFoundError:
        return "no such file; give the YAML file of a bridge"
    except IsADirectoryError:
        return "a directory; give the YAML files in it one by one"
    except (OSError, ValueError) as error:
        why = (error.strerror if isinstance(error, OSError) else None) or str(error)
        return f"cannot be read ({why}); give a file that can"


def _mission(contents: list[tuple[str, bytes | str]], check_type: CheckType | None) -> Mission:
    reports = []
    files: dict[str, bytes] = {}
    claims: Claims = {}
    links: list[GroundLink | FlightLink] = []
    routes: list[Route] = []
    whole: list[Bridge] = []
    for name, content in contents:
        if content in files.values():
            continue  # the same file given twice
        report = Mistakes(name)
        reports.append(report)
        if isinstance(content, bytes):
            files[_free_name(PurePath(name).name, files)] = content
        text = _text(content, report)
        nodes = read_nodes(text, report) if text is not None else []
        bridges = find_bridges(nodes)
        if nodes and not bridges and not report.mistakes:
            what = "no node here is a bridge; it needs communication, command and telemetry"
            report.mistake(nodes[0].line, nodes[0].name, what)
        for node in bridges:
            bridge, found = read_bridge(node, report, claims, check_type)
            routes += found
            if bridge is not None:
                whole.append(bridge)
                if bridge.link not in links:
                    links.append(bridge.link)
    mistakes = _in_order(report.mistakes for report in reports)
    if mistakes:
        raise ConfigError(*mistakes)
    warnings = _in_order(report.warnings for report in reports)
    return Mission(tuple(routes), tuple(links), MappingProxyType(files), tuple(warnings), tuple(whole))


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
