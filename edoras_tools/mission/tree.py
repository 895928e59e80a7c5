"""YAML as ROS 2 reads it: a tree that keeps line numbers and quotes, the values of scalars, and mistakes.

ROS 2 does not use YAML's own schema: ``rcl_yaml_param_parser`` tries a list of words, then C's ``strtol``
with base 0, then ``strtod``, and takes everything else as a string. ``0x1827`` is an integer, ``010`` is 8,
``08`` and ``1e3`` are floats, ``yes`` is true, ``0o17`` and ``1_000`` are strings, and so is anything in
quotes.

Mistakes and warnings are collected while files are read, and reported together.
"""

from __future__ import annotations

import math
import re
import sys
from operator import itemgetter
from typing import TYPE_CHECKING, Any, TypeAlias

import msgspec

from edoras_tools.errors import ConfigError
from edoras_tools.words import did_you_mean

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator
    from pathlib import Path

BRIDGE_FILE_FORM = "a bridge's file is NODE: ros__parameters: ..."
"""Hint for a file of another kind."""

LARGEST_FILE = 1 << 19
"""Most bytes of a mission file, which has a few KiB; a capture given by mistake is not read whole."""
_DEEPEST = 50
_QUOTES = {"'", '"'}
_STRING_TAG = "tag:yaml.org,2002:str"


class ScalarNode(msgspec.Struct, frozen=True):
    """A plain value: as rcl reads it, as written, and its line, from 1; ``missing`` if it is empty."""

    value: bool | int | float | str
    text: str
    line: int
    missing: bool = False

    @property
    def described(self) -> str:
        """The value and its type for messages, as ``"0x827" is a string``."""
        text = printable(self.text)
        match self.value:
            case bool():
                return f"{text} is the boolean {str(self.value).lower()}"
            case int():
                return f"{text} is an integer"
            case float():
                return f"{text} is the float {self.value!r}"
        return f'"{text}" is a string'


class SequenceNode(msgspec.Struct, frozen=True):
    """A list."""

    items: tuple[Tree, ...]
    line: int


class MappingNode(msgspec.Struct, frozen=True):
    """Keys and values in the order of the file, repeated keys included."""

    entries: tuple[tuple[Tree, Tree], ...]
    line: int


class AliasNode(msgspec.Struct, frozen=True):
    """``*name``, which rcl refuses."""

    line: int


Tree: TypeAlias = ScalarNode | SequenceNode | MappingNode | AliasNode


def yaml_text(content: bytes, report: Mistakes, form: str) -> str | None:
    """Return the text of a YAML file; None, with a mistake in the report, if it is too large or not UTF-8.

    Args:
        content: bytes of the file, ``LARGEST_FILE`` + 1 at most.
        report: report of the file.
        form: hint of what to give instead.
    """
    if len(content) > LARGEST_FILE:
        report.mistake(0, "", f"larger than {LARGEST_FILE >> 10} KiB; {form}")
        return None
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        report.mistake(line, "", f"not UTF-8 at byte {error.start}; {form}")
        return None


def parse_yaml(text: str, report: Mistakes, form: str = BRIDGE_FILE_FORM) -> list[Tree]:
    """Return the documents of a YAML text; empty, with a mistake in the report, if it is not YAML.

    ``form`` is a hint of what the file should look like.
    """
    import yaml

    loader = getattr(yaml, "CLoader", yaml.Loader)  # libyaml, with which the bridges' rcl reads its files
    events: list[Any] = []
    depth = 0
    try:
        parsed: Iterator[Any] = yaml.parse(text, Loader=loader)
        for event in parsed:
            depth += _step(event)
            if depth > _DEEPEST:
                report.mistake(
                    event.start_mark.line + 1, "", f"nested more than {_DEEPEST} levels deep; {form}"
                )
                return []
            events.append(event)
    except yaml.reader.ReaderError as error:
        line = text.encode().count(b"\n", 0, error.position) + 1
        report.mistake(line, "", f"character {error.character:#x} is not allowed in YAML; remove it")
        return []
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        why = ", ".join(filter(None, (error.context, error.problem)))
        report.mistake(mark.line + 1 if mark else 1, "", f"not YAML: {printable(why, 200)}; {form}")
        return []
    return list(_documents(iter(events)))


def read_document(path: Path, report: Mistakes, form: str, *, one: str, instead: str) -> Tree | None:
    """Return the only document of a YAML file; None if it has none. Mistakes go to the report.

    Args:
        path: path of the file.
        report: report of the file.
        form: clause that says what such a file contains.
        one: clause that says that it is one document.
        instead: file or value to name instead, if it cannot be read.
    """
    try:
        with path.open("rb") as file:
            content = file.read(LARGEST_FILE + 1)
    except OSError as error:
        report.mistake(0, "", f"cannot be read ({error.strerror or error}); name {instead}")
        return None
    text = yaml_text(content, report, form)
    documents = parse_yaml(text, report, form) if text is not None else []
    if not documents and not report.mistakes:
        report.mistake(1, "", f"the file is empty; {form}")
    for document in documents[1:]:
        report.mistake(document.line, "", f"a second document; {one}")
    return documents[0] if documents else None


def named_entries(
    tree: Tree, place: str, report: Mistakes, needed: str, allowed: Collection[str] = ()
) -> Iterator[tuple[str, int, Tree]]:
    """Yield key, line and value of each entry of a mapping; unknown and repeated keys are mistakes.

    Args:
        tree: the mapping.
        place: key of the mapping; empty for a whole file.
        report: report of the file.
        needed: text of the mistake if it is no mapping.
        allowed: allowed keys; empty: any.
    """
    if not isinstance(tree, MappingNode):
        report.mistake(tree.line, place, needed)
        return
    first_lines: set[str] = set()
    for key, value in tree.entries:
        name = key.text if isinstance(key, ScalarNode) else ""
        where = f"{place}.{name}" if place else name
        if allowed and name not in allowed:
            near = did_you_mean(name, allowed, 1)
            text = f"no such key; {near and near + ' '}there are {', '.join(allowed)}"
            report.mistake(key.line, where, text)
            continue
        if name in first_lines:
            report.mistake(key.line, where, "given twice; once is enough")
        first_lines.add(name)
        yield name, key.line, value


def _step(event: Any) -> int:
    """Return the change of nesting depth after this event: 1, 0 or -1."""
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
            return AliasNode(line)
        case "ScalarEvent":
            quoted = event.style in _QUOTES
            value = read_scalar(event.value, quoted=quoted or event.tag == _STRING_TAG)
            return ScalarNode(value, event.value, line, missing=not quoted and not event.value)
        case "SequenceStartEvent":
            return SequenceNode(
                tuple(_tree(item, events) for item in _until("SequenceEndEvent", events)), line
            )
    return MappingNode(
        tuple((_tree(key, events), _tree(next(events), events)) for key in _until("MappingEndEvent", events)),
        line,
    )


def _until(end: str, events: Iterator[Any]) -> Iterator[Any]:
    """Yield the events up to the end of a collection; the caller consumes all events of each element."""
    for event in events:
        if type(event).__name__ == end:
            return
        yield event


_WORDS = {
    word: value
    for value, words in ((True, "y yes true on"), (False, "n no false off"))
    for lower in words.split()
    for word in (lower, lower.capitalize(), lower.upper())
}
_SPECIALS = {
    f"{sign}.{word}": float(sign + word) for word in ("inf", "Inf", "INF") for sign in ("", "+", "-")
}
_SPECIALS |= dict.fromkeys((".nan", ".NaN", ".NAN"), math.nan)
# The whole text must match, after the white space that strtol and strtod skip. ASCII digits only, as in C.
_INTEGER = r"[ \t-\r]*([+-]?)(?:0[xX]([0-9a-fA-F]+)|(0[0-7]*)|([1-9][0-9]*))"
_DECIMAL = r"[ \t-\r]*[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"
_HEXADECIMAL = r"[ \t-\r]*[+-]?0[xX](?:[0-9a-fA-F]+\.?[0-9a-fA-F]*|\.[0-9a-fA-F]+)(?:[pP][+-]?[0-9]+)?"
_NOT_FINITE = r"[ \t-\r]*([+-]?)(?i:(inf|infinity)|nan(?:\([0-9a-z_]*\))?)"


def read_scalar(text: str, *, quoted: bool = False) -> bool | int | float | str:
    """Return the value that rcl gives to a scalar.

    Args:
        text: the scalar, escapes resolved, quotes removed.
        quoted: it stood in single or double quotes, or under the tag ``!!str``: then it is a string.

    Returns:
        A bool, an int of 64 bits, a float, or the text itself. An integer too large for 64 bits is a float,
        and a float that a double cannot hold is a string, because C's conversions report a range error.
    """
    if quoted:
        return text
    if text in _WORDS:
        return _WORDS[text]
    integer = _integer(text)
    if integer is not None:
        return integer
    number = _float(text)
    return text if number is None else number


def _integer(text: str) -> int | None:
    match = re.fullmatch(_INTEGER, text)
    if match is None:
        return None
    sign, hexadecimal, octal, decimal = match.groups()
    digits, base = (hexadecimal, 16) if hexadecimal else (octal, 8) if octal else (decimal, 10)
    digits = digits.lstrip("0") or "0"
    if len(digits) > 64:
        return None  # out of range in any base, and int() refuses thousands of digits
    value = int(sign + digits, base)
    return value if -(2**63) <= value < 2**63 else None


def _float(text: str) -> float | None:
    if text in _SPECIALS:
        return _SPECIALS[text]
    if match := re.fullmatch(_NOT_FINITE, text):
        sign = -1.0 if match[1] == "-" else 1.0
        return math.copysign(math.inf if match[2] else math.nan, sign)
    if re.fullmatch(_HEXADECIMAL, text):
        mantissa = re.split("[pP]", text.lstrip(" \t\n\v\f\r"))[0].lstrip("+-")[2:]
        try:
            value = float.fromhex(text)
        except OverflowError:
            return None
    elif re.fullmatch(_DECIMAL, text):
        mantissa = re.split("[eE]", text)[0]
        value = float(text)
    else:
        return None
    if math.isinf(value):
        return None
    # A subnormal result, or a zero made of other digits, is glibc's ERANGE too.
    underflow = abs(value) < sys.float_info.min and re.search("[1-9a-fA-F]", mantissa) is not None
    return None if underflow else value


def printable(text: str, limit: int = 60) -> str:
    """Return text that fits in one line: control characters escaped, cut at ``limit`` characters."""
    text = "".join(item if item.isprintable() else item.encode("unicode_escape").decode() for item in text)
    return text if len(text) <= limit else text[: limit - 3] + "..."


class Mistakes(msgspec.Struct, eq=False):
    """The mistakes and warnings of one file.

    Attributes:
        file: name of the file, for messages.
        mistakes: line number and ``FILE:LINE: KEY: what is wrong; what is allowed``, in the order found.
        warnings: in the same form, parameters that work but are probably mistakes.
    """

    file: str
    mistakes: list[tuple[int, str]] = msgspec.field(default_factory=list)
    warnings: list[tuple[int, str]] = msgspec.field(default_factory=list)

    def mistake(self, line: int, key: str, message: str) -> None:
        """Add a mistake. ``line`` counts from 1; 0 is the whole file."""
        self.mistakes.append((line, self._text(line, key, message)))

    def warn(self, line: int, key: str, message: str) -> None:
        """Add a warning: something that works but is probably a mistake."""
        self.warnings.append((line, self._text(line, key, message)))

    def raise_all(self) -> None:
        """Raise the mistakes, in the order of their lines.

        Raises:
            ConfigError: if there is one.
        """
        if self.mistakes:
            raise ConfigError(*(text for _, text in sorted(self.mistakes, key=itemgetter(0))))

    def _text(self, line: int, key: str, message: str) -> str:
        place = printable(self.file, 200) + (f":{line}" if line else "")
        return f"{place}: {printable(key)}: {message}" if key else f"{place}: {message}"
