"""The meaning of each finding, and its severity: the texts are in ``findings.json`` beside this file."""

from __future__ import annotations

import json
from enum import IntEnum
from pathlib import Path
from typing import Final, NamedTuple

from edoras_tools.model import Finding


class Level(IntEnum):
    """Severity of a finding for the sender of the datagram."""

    NOTE = 1
    """Usual for these senders; nothing is lost."""
    WARNING = 2
    """Unusual, or lost only at some receivers."""
    ERROR = 3
    """Refused, lost, corrupted or unreadable."""

    @property
    def label(self) -> str:
        """``note``, ``warning`` or ``error``."""
        return self.name.lower()

    @property
    def style(self) -> str:
        """The rich style of this severity, the same in every view."""
        return ("", "bright_blue", "yellow", "bold red")[self]

    @property
    def mark(self) -> str:
        """One character that shows the severity without colour."""
        return (" ", "·", "!", "✗")[self]


class Explanation(NamedTuple):
    """The explanation of a finding.

    Attributes:
        severity: severity.
        short: two or three words, for the packet list.
        meaning: one sentence: the fault, and the receiver's reaction.
    """

    severity: Level
    short: str
    meaning: str


_FILE: Final = Path(__file__).with_name("findings.json")
_BY_LABEL: Final = {item.label: item for item in Finding}
EXPLANATIONS: Final = {
    _BY_LABEL[label]: Explanation(Level[item["severity"].upper()], item["short"], item["meaning"])
    for label, item in json.loads(_FILE.read_bytes()).items()
}
"""Every finding; :func:`explain` looks one up."""

NOTABLE: Final = Finding(sum(item for item, entry in EXPLANATIONS.items() if entry.severity >= Level.WARNING))
"""Every finding that is more than a note."""


def explain(finding: Finding | str) -> Explanation:
    """Return the explanation of one finding.

    Args:
        finding: one bit, or its label as in JSON; an unknown label gives a warning with that explanation.
    """
    if isinstance(finding, str):
        if finding not in _BY_LABEL:
            return Explanation(Level.WARNING, finding, "This version does not know this finding.")
        finding = _BY_LABEL[finding]
    return EXPLANATIONS[finding]


def ranked(findings: Finding, *, at_least: Level = Level.NOTE) -> list[Finding]:
    """Return the bits that are set, the most severe first."""
    explained = [
        item for item in findings if item in EXPLANATIONS and EXPLANATIONS[item].severity >= at_least
    ]
    return sorted(explained, key=lambda item: -EXPLANATIONS[item].severity)


def worst(findings: Finding) -> Level | None:
    """Return the highest severity among the bits that are set, or None if no bit is set."""
    first = ranked(findings)[:1]
    return EXPLANATIONS[first[0]].severity if first else None
