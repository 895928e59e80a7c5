"""A conversation as a sequence diagram in text form: Mermaid or PlantUML."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from typing import Final

import msgspec

from edoras_tools import words
from edoras_tools.render.severity import Level, explain
from edoras_tools.render.terminal.text import clean

_MERMAID: Final = re.compile("[#;<>]")
_PLANTUML: Final = re.compile(r"""//|__|\*\*|--|""|[~<]""")
"""Characters with a meaning in the diagram's syntax."""


class SequenceMessage(msgspec.Struct, frozen=True):
    """Similar packets from one party to another, without a pause.

    Attributes:
        source: name of the sender.
        destination: name of the receiver.
        label: kind of the packets.
        count: number of packets.
        first_ns: time of the first, ns after the capture's first datagram.
        last_ns: time of the last, ns after the capture's first datagram.
        findings: labels of all findings among them.
    """

    source: str
    destination: str
    label: str
    count: int
    first_ns: int
    last_ns: int
    findings: Sequence[str] = ()

    @property
    def period_ns(self) -> float:
        """Mean time between two of them; 0 for a single one."""
        return (self.last_ns - self.first_ns) / (self.count - 1) if self.count > 1 else 0.0

    @property
    def text(self) -> str:
        """The label of the arrow: ``SUB x36 every 2.0 s, 0.5 to 70.5 s``."""
        begin, end = self.first_ns / 1e9, self.last_ns / 1e9
        when = f"{begin:.3f} s" if self.count == 1 else f"{begin:.3f} to {end:.3f} s"
        often = f" x{self.count:,}" if self.count > 1 else ""
        period = f" every {words.milliseconds(self.period_ns / 1e6)}" if self.period_ns >= 1e6 else ""
        text = f"{self.label}{often}{period}, {when}"
        notable = [label for label in self.findings if explain(label).severity >= Level.WARNING]
        return f"{text} ! {', '.join(notable)}" if notable else text


def mermaid(messages: Sequence[SequenceMessage]) -> Iterator[str]:
    """Yield the lines of a Mermaid sequence diagram."""
    yield "sequenceDiagram"
    parties = _parties(messages)
    for name, key in parties.items():
        yield f"    participant {key} as {mermaid_text(name)}"
    for item in messages:
        arrow = f"{parties[item.source]}->>{parties[item.destination]}"
        yield f"    {arrow}: {mermaid_text(item.text)}"


def plantuml(messages: Sequence[SequenceMessage]) -> Iterator[str]:
    """Yield the lines of a PlantUML sequence diagram."""
    yield "@startuml"
    parties = _parties(messages)
    for name, key in parties.items():
        yield f'participant "{clean(name)}" as {key}'
    for item in messages:
        arrow = f"{parties[item.source]} -> {parties[item.destination]}"
        yield f"{arrow}: {_PLANTUML.sub(lambda match: f'~{match[0]}', clean(item.text))}"
    yield "@enduml"


DIAGRAMS: Final[dict[str, Callable[[Sequence[SequenceMessage]], Iterator[str]]]] = {
    "mermaid": mermaid,
    "plantuml": plantuml,
}


def _parties(messages: Sequence[SequenceMessage]) -> dict[str, str]:
    """Return the parties in the order they appear, with a short key for each."""
    names = dict.fromkeys(name for item in messages for name in (item.source, item.destination))
    return {name: f"P{number}" for number, name in enumerate(names, 1)}


def mermaid_text(text: str) -> str:
    """Return a text, escaped so that Mermaid reads none of it as syntax."""
    return _MERMAID.sub(lambda match: f"#{ord(match[0])};", clean(text))
