"""YAML text to a tree that keeps what ROS 2's rules need: lines, and whether quotes stood there."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

from edoras_tools.mission.report import printable
from edoras_tools.mission.scalars import read_scalar

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.mission.report import Report

FORM = "a bridge's file is NODE: ros__parameters: ..."
"""What a file that is nothing of the kind is told."""

_DEEPEST = 50
_QUOTES = {"'", '"'}
_STRING_TAG = "tag:yaml.org,2002:str"
_INNER_TABS = re.compile(r"(?<=\S)[ \t]*\t[ \t]*")


@dataclass(frozen=True, slots=True)
class Scalar:
    """A plain value: what rcl takes it for, as written, and the line, from 1. An empty one is missing."""

    value: bool | int | float | str
    text: str
    line: int
    missing: bool = False

    @property
    def described(self) -> str:
        """What it is, for people, as ``"0x827" is a string``."""
        text = printable(self.text)
        match self.value:
            case bool():
                return f"{text} is the boolean {str(self.value).lower()}"
            case int():
                return f"{text} is an integer"
            case float():
                return f"{text} is the float {self.value!r}"
        return f'"{text}" is a string'


@dataclass(frozen=True, slots=True)
class Sequence:
    """A list."""

    items: tuple[Tree, ...]
    line: int


@dataclass(frozen=True, slots=True)
class Mapping:
    """Keys and values in the order of the file, repeated keys included."""

    entries: tuple[tuple[Tree, Tree], ...]
    line: int


@dataclass(frozen=True, slots=True)
class Alias:
    """``*name``, which rcl refuses."""

    line: int


Tree: TypeAlias = Scalar | Sequence | Mapping | Alias


def parse(text: str, report: Report, form: str = FORM) -> list[Tree]:
    """Return the documents of a YAML text; empty, with a mistake in the report, where it is not YAML.

    ``form`` is what the file should look like, for people.
    """
    from ruamel.yaml import YAML
    from ruamel.yaml.error import MarkedYAMLError
    from ruamel.yaml.reader import ReaderError

    # ruamel refuses a tab between tokens; libyaml, and so the bridges, take it for a space.
    spaced = _INNER_TABS.sub(lambda match: " " * len(match[0]), text)
    events: list[Any] = []
    depth = 0
    try:
        for event in YAML(pure=True).parse(spaced):
            depth += _step(event)
            if depth > _DEEPEST:  # at once: ruamel takes minutes over thousands of brackets
                report.mistake(
                    event.start_mark.line + 1, "", f"nested more than {_DEEPEST} levels deep; {form}"
                )
                return []
            events.append(event)
    except ReaderError as error:
        line = spaced.count("\n", 0, error.position) + 1
        report.mistake(line, "", f"character {error.character:#x} is not allowed in YAML; remove it")
        return []
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        why = ", ".join(filter(None, (error.context, error.problem)))
        report.mistake(mark.line + 1 if mark else 1, "", f"not YAML: {printable(why, 200)}; {form}")
        return []
    except Exception as error:  # noqa: BLE001  ruamel lets errors of its own out of broken directives and escapes
        report.mistake(1, "", f"not YAML: {printable(str(error), 200) or type(error).__name__}; {form}")
        return []
    return list(_documents(iter(events)))


def _step(event: Any) -> int:
    """Return how much deeper the events after this one are."""
    name = type(event).__name__
    if name in {"MappingStartEvent", "SequenceStartEvent"}:
        return 1
    return -1 if name in {"MappingEndEvent", "SequenceEndEvent"} else 0


def _documents(events: Iterator[Any]) -> Iterator[Tree]:
    for event in events:
        if type(event).__name__ in {"MappingStartEvent", "SequenceStartEvent", "ScalarEvent", "AliasEvent"}:
            yield _tree(event, events)


def _tree(event: Any, events: Iterator[Any]) -> Tree:
    line = event.start_mark.line + 1
    match type(event).__name__:
        case "AliasEvent":
            return Alias(line)
        case "ScalarEvent":
            quoted = event.style in _QUOTES
            value = read_scalar(event.value, quoted=quoted or event.tag == _STRING_TAG)
            return Scalar(value, event.value, line, missing=not quoted and not event.value)
        case "SequenceStartEvent":
            return Sequence(tuple(_tree(item, events) for item in _until("SequenceEndEvent", events)), line)
    return Mapping(
        tuple((_tree(key, events), _tree(next(events), events)) for key in _until("MappingEndEvent", events)),
        line,
    )


def _until(end: str, events: Iterator[Any]) -> Iterator[Any]:
    """Yield events up to the one that ends a collection; who takes one reads all that belongs to it."""
    for event in events:
        if type(event).__name__ == end:
            return
        yield event
