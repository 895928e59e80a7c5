"""Remapping of names, as rcl does it (``rcl/src/rcl/remap.c``, and its lexer for the rules).

Rules that this file keeps:

1. A rule is ``[NODE:]MATCH:=REPLACEMENT``; only the first one that matches is applied.
2. ``NODE:`` is compared with the current name of the node: for ``__node:=`` that is the name in the code, for
   all other rules the new name.
3. ``__ns:=`` comes before topics: relative names and ``~`` on both sides of a rule belong to the new node.
4. The parts of a rule contain no ``__`` and no ``{node}``, though a topic may have both.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Final

import msgspec

from edoras_tools.errors import ConfigError
from edoras_tools.mission.bridges import full_topic

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
        of: name of the node that the rule applies to; empty for all.
        kind: ``node``, ``namespace``, ``topic``, or ``service``.
        match: name of the topic or service that is replaced; empty for the other kinds.
        replacement: new name.
    """

    of: str
    kind: str
    match: str
    replacement: str

    @classmethod
    def of_text(cls, text: str) -> Remap:
        """Read a rule.

        Raises:
            ConfigError: rcl refuses the rule.
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
        rules: rules in their order.
        namespace: ``/robot``; empty for the root.
        name: name of the node; empty if it is not known.
    """
    name = _first(rules, "node", name) or name
    match = _first(rules, "namespace", name)
    return namespace if match is None else match.rstrip("/"), name


def remapped_topic(rules: Sequence[Remap], node: str, topic: str) -> str:
    """Return the name of a topic after the rules of a node.

    Args:
        rules: rules in their order.
        node: fully qualified name, after the node's own rules.
        topic: fully qualified name.
    """
    name = node.rpartition("/")[2]
    for rule in rules:
        if rule.kind == "topic" and rule.of in {"", name} and full_topic(rule.match, node) == topic:
            return full_topic(rule.replacement, node) or topic
    return topic


def _first(rules: Sequence[Remap], kind: str, name: str) -> str | None:
    return next((rule.replacement for rule in rules if rule.kind == kind and rule.of in {"", name}), None)
