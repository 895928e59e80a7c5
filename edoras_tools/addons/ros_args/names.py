"""Remapping of names, as rcl does it (``rcl/src/rcl/remap.c``, and its lexer for the rules).

1. A rule is ``[NODE:]MATCH:=REPLACEMENT``; of several that match, the first one holds, and no other after it.
2. ``NODE:`` compares with the name of the node as it is by then: ``__node:=`` is looked for with the name in
   the code, all others with the new one.
3. ``__ns:=`` before topics: relative names and ``~`` of both sides of a rule are those of the new node.
4. Tokens of a rule hold no ``__``, and no ``{node}``, though a topic may have both.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

import msgspec

from edoras_tools.errors import ConfigError
from edoras_tools.mission.bridges import full_topic

if TYPE_CHECKING:
    from collections.abc import Sequence

PART: Final = "(?:(?![A-Za-z0-9_]*__)[A-Za-z_][A-Za-z0-9_]*)"
_NAME: Final = rf"(?:~/|/)?{PART}(?:/{PART})*"
_RULE: Final = re.compile(
    rf"(?:(?P<of>{PART}):)?(?:"
    rf"__(?:node|name):=(?P<node>{PART})"
    rf"|__ns:=(?P<namespace>/|(?:/{PART})+)"
    rf"|(?P<scheme>rostopic://|rosservice://)?(?P<match>{_NAME}):=(?P<topic>{_NAME}))"
)


class Remap(msgspec.Struct, frozen=True):
    """One rule.

    Attributes:
        of: name of the node that it is for; empty for all.
        kind: ``node``, ``namespace``, ``topic``, or ``service``.
        match: name of a topic that is replaced; empty for the other kinds.
        replacement: what it becomes.
    """

    of: str
    kind: str
    match: str
    replacement: str

    @classmethod
    def of_text(cls, text: str) -> Remap:
        """Read a rule.

        Raises:
            ConfigError: rcl refuses it.
        """
        match = _RULE.fullmatch(text)
        if match is None:
            raise ConfigError(
                f"--ros-args: -r {text!r} is no rule; write FROM:=TO, NODE:FROM:=TO, __ns:=/NAME or "
                "__node:=NAME, of letters, digits and single _"
            )
        for kind in ("node", "namespace"):
            if match[kind]:
                return cls(match["of"] or "", kind, "", match[kind])
        kind = "service" if match["scheme"] == "rosservice://" else "topic"
        return cls(match["of"] or "", kind, match["match"], match["topic"])


def remapped_node(rules: Sequence[Remap], namespace: str, name: str) -> tuple[str, str]:
    """Return namespace and name of a node after its rules.

    Args:
        rules: in their order.
        namespace: ``/robot``; empty for the root.
        name: of the node; empty where it is not known.
    """
    name = _first(rules, "node", name) or name
    match = _first(rules, "namespace", name)
    return namespace if match is None else match.rstrip("/"), name


def remapped_topic(rules: Sequence[Remap], node: str, topic: str) -> str:
    """Return a topic after the rules of a node.

    Args:
        rules: in their order.
        node: fully qualified, after its own rules.
        topic: fully qualified.
    """
    name = node.rpartition("/")[2]
    for rule in rules:
        if rule.kind == "topic" and rule.of in {"", name} and full_topic(rule.match, node) == topic:
            return full_topic(rule.replacement, node) or topic
    return topic


def _first(rules: Sequence[Remap], kind: str, name: str) -> str | None:
    return next((rule.replacement for rule in rules if rule.kind == kind and rule.of in {"", name}), None)
