"""The words after ``--ros-args``, and their effect on the nodes of mission files."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Final

from msgspec.structs import replace

from edoras_tools.addons.ros_args.names import PART, Remap, remapped_node, remapped_topic
from edoras_tools.errors import ConfigError
from edoras_tools.mission.bridges import find_bridges, node_of
from edoras_tools.mission.loading import read_file
from edoras_tools.mission.tree import Mistakes, NodeParameters, name_matches, read_nodes, yaml_text

if TYPE_CHECKING:
    from edoras_tools.pipelines.workbench import Settings

_PARAMETER: Final = re.compile(rf"(?:({PART}):)?({PART}(?:[./]{PART})*):=(.+)", re.DOTALL)
_REMAP: Final = ("-r", "--remap")
_SET: Final = ("-p", "--param")
_FILE: Final = "--params-file"
_UNUSED: Final = ("--log-level", "--log-config-file", "--log-file-name", "-e", "--enclave")
_OF_BRIDGES: Final = {"command", "telemetry"}
_SWITCH: Final = re.compile(r"--(?:en|dis)able-(?:rosout|stdout|external-lib)-logs")


class RosArguments:
    """The arguments that a node was started with.

    Args:
        words: words after ``--ros-args``.
        read: returns the bytes of a parameter file, or as text why they cannot be read.

    Attributes:
        files: files of ``--params-file``, in their order.
        overrides: content of those files without a bridge, by base name: parameters for bridges elsewhere.

    Raises:
        ConfigError: rcl would refuse a word, or a file cannot be read.
    """

    def __init__(self, words: Sequence[str], read: Callable[[str], bytes | str]) -> None:
        self.files: list[str] = []
        self.overrides: dict[str, bytes] = {}
        self._rules: list[Remap] = []
        self._parameters: list[NodeParameters] = []
        rest = iter(words)
        for word in rest:
            if _SWITCH.fullmatch(word):
                continue
            if word not in {*_REMAP, *_SET, *_UNUSED, _FILE}:
                raise ConfigError(
                    f"--ros-args: {word!r} is not known; there are -r, -p and --params-file, and -- ends them"
                )
            value = next(rest, None)
            if value is None:
                raise ConfigError(f"--ros-args: nothing follows {word}; write its value, or leave it out")
            if word in _REMAP:
                self._rules.append(Remap.of_text(value))
            elif word in _SET:
                self._parameters += _parameter(value)
            elif word == _FILE:
                self.files.append(value)
                self._parameters += self._of_file(value, read(value))

    def applied(self, nodes: list[NodeParameters], report: Mistakes) -> list[NodeParameters]:
        """Return the nodes of a file with these arguments applied.

        A file may have the bridges of several nodes. If rcl would give its parameters to some of them under
        their new names, only these are returned; if to none of them, all are, with a warning.
        """
        bridges = find_bridges(nodes)
        renamed = {id(node): self._renamed(node) for node in bridges}
        reached = [node for node in bridges if name_matches(node.name, renamed[id(node)])]
        for node in bridges:
            if node in reached or not node.name:
                continue
            name = renamed[id(node)]
            report.warn(
                node.line,
                node.name,
                "left out: with these --ros-args another node is started"
                if reached
                else f"a real node would be {name} and not read this; write {name} or /** in its place",
            )
        return [
            self._changed(node, renamed[id(node)]) if id(node) in renamed else node
            for node in nodes
            if not reached or id(node) not in renamed or node in reached
        ]

    def _renamed(self, node: NodeParameters) -> str:
        """Return the new name of a node; its last part is ``*`` if neither a file nor a rule names it."""
        namespace, name = remapped_node(self._rules, *node_of(node.name))
        return f"{namespace}/{name or '*'}"

    def _changed(self, node: NodeParameters, name: str) -> NodeParameters:
        values, groups, lines = dict(node.values), set(node.groups), dict(node.lines)
        for other in self._parameters:
            if name_matches(other.name, name):
                values |= other.values
                groups |= other.groups
                lines = dict.fromkeys(other.groups, 0) | lines | dict.fromkeys(other.values, 0)
        remap = partial(remapped_topic, self._rules, name)
        return replace(node, name=name, values=values, groups=groups, lines=lines, remap=remap)

    def _of_file(self, name: str, content: bytes | str) -> list[NodeParameters]:
        if isinstance(content, str):
            raise ConfigError(f"{name}: {content}")
        report = Mistakes(name)
        text = yaml_text(content, report, "give a file of parameters")
        nodes = read_nodes(text, report, merge=False) if text is not None else []
        if any(not node.lines.keys().isdisjoint(_OF_BRIDGES) for node in nodes):
            return []  # a mission file, which is read as such
        report.raise_all()
        self.overrides[PurePath(name).name] = content
        return nodes


def with_arguments(settings: Settings, words: Sequence[str]) -> Settings:
    """Return settings with the arguments of ``--ros-args``; parameter files are also mission files.

    Raises:
        ConfigError: rcl would refuse a word, or a file cannot be read.
    """
    files = map(Path, RosArguments(words, read_file).files)
    return replace(settings, configs=(*settings.configs, *files), ros_args=tuple(words))


def _parameter(text: str) -> list[NodeParameters]:
    """Return the node of ``[NODE:]NAME:=VALUE``, as a list; without NODE it is a wildcard for all."""
    match = _PARAMETER.fullmatch(text)
    if match is None:
        raise ConfigError(f"--ros-args: -p {text!r} is no parameter; write NAME:=VALUE or NODE:NAME:=VALUE")
    node, name, value = match.groups()
    report = Mistakes(f"--ros-args: -p {text}")
    nodes = read_nodes(f"{node or '/**'}:\n  ros__parameters:\n    {name}: {value}\n", report)
    report.raise_all()
    return nodes
