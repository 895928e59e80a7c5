"""YAML as ROS 2 reads it: a tree that keeps line numbers and quotes, the values of scalars, and mistakes.

ROS 2 does not use YAML's own schema: ``rcl_yaml_param_parser`` tries a list of words, then C's ``strtol``
with base 0, then ``strtod``, and takes everything else as a string. ``0x1827`` is an integer, ``010`` is 8,
``08`` and ``1e3`` are floats, ``yes`` is true, ``0o17`` and ``1_000`` are strings, and so is anything in
quotes.

Mistakes and warnings are collected while files are read, and reported together.

Parameter files are read into dotted names, as ``rcl_yaml_param_parser`` flattens them. ``NODE:
ros__parameters: {a: {b: 1}}`` is the parameter ``a.b`` of ``NODE``. Node names may be nested (one level a
namespace), hold slashes, or be wildcards; several nodes and several documents may share a file. Figure 19 of
the EDORAS paper has no node name at the top: such a file is read too, with a warning; rcl refuses it.

``Fields`` is the typed access to one node's parameters: it returns a value of the right kind, or None and
reports a mistake.
"""

from __future__ import annotations

import ipaddress
import math
import re
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from operator import itemgetter
from typing import TYPE_CHECKING, Any, TypeAlias

import msgspec

from edoras_tools.errors import ConfigError
from edoras_tools.words import did_you_mean, either

if TYPE_CHECKING:
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


PARAMETERS_KEY = "ros__parameters"
_NODE_NAME = re.compile(r"(/(\*\*?|[A-Za-z_][A-Za-z0-9_]*))+")


class NodeParameters(msgspec.Struct, frozen=True):
    """The parameters of one node.

    Attributes:
        name: fully qualified name, as ``/conversion_node``; empty if the file gives none.
        line: line of its ``ros__parameters``.
        values: scalar or list of scalars by dotted name; None if the report already has a mistake of it.
        groups: dotted names that have names below them.
        lines: line of the key of each parameter or group, by dotted name.
        remap: replaces a fully qualified topic by the node's remapping arguments.
    """

    name: str
    line: int
    values: dict[str, ScalarNode | tuple[ScalarNode, ...] | None] = msgspec.field(default_factory=dict)
    groups: set[str] = msgspec.field(default_factory=set)
    lines: dict[str, int] = msgspec.field(default_factory=dict)
    remap: Callable[[str], str] = str

    def children(self, group: str) -> list[str]:
        """Return the last part of each parameter's name directly below a group."""
        return [last for above, _, last in (name.rpartition(".") for name in self.values) if above == group]

    def line_of(self, name: str) -> int:
        """Return the line of a parameter, or of the nearest group around it."""
        while name and name not in self.lines:
            name = name.rpartition(".")[0]
        return self.lines[name] if name else self.line


def read_nodes(text: str, report: Mistakes, *, merge: bool = True) -> list[NodeParameters]:
    """Return the nodes of a parameter file; unless ``merge`` is False, with parameters of matching wildcards.

    Mistakes go to ``report``; everything that can be read is returned.
    """
    documents = parse_yaml(text, report)
    if not documents:
        if not report.mistakes:
            report.mistake(1, "", f"the file is empty; {BRIDGE_FILE_FORM}")
        return []
    reader = _Reader(report)
    for document in documents:
        reader.names((), document)
    if not reader.nodes:
        report.mistake(1, "", f"there is no {PARAMETERS_KEY}; {BRIDGE_FILE_FORM}")
    else:
        for line, key in reader.strays:
            report.mistake(line, key, f"a value outside {PARAMETERS_KEY}; indent it below, or remove it")
    nodes = list(reader.nodes.values())
    return _with_wildcards(nodes) if merge else nodes


class _Reader:
    """Walks the names of nodes, then the names of parameters."""

    def __init__(self, report: Mistakes) -> None:
        self.report = report
        self.nodes: dict[str, NodeParameters] = {}
        self.strays: list[tuple[int, str]] = []

    def names(self, path: tuple[str, ...], tree: Tree) -> None:
        if not isinstance(tree, MappingNode):
            self.strays.append((tree.line, "/".join(path)))
            return
        for key, line, child in self.entries(tree, "/".join(path)):
            # rcl compares only the beginning of the key.
            if key.startswith(PARAMETERS_KEY):
                self.parameters(self.node(path, line), "", child)
            else:
                self.names((*path, key), child)

    def node(self, path: tuple[str, ...], line: int) -> NodeParameters:
        name = "/" + "/".join(path).removeprefix("/") if path else ""
        if not path:
            self.report.warn(
                line, PARAMETERS_KEY, "no name of a node stands above; a bridge refuses this file"
            )
        elif not _NODE_NAME.fullmatch(name):
            allowed = "letters, digits and _ between slashes, or the wildcards * and **"
            self.report.mistake(line, "/".join(path), f"not the name of a node; allowed are {allowed}")
        return self.nodes.setdefault(name, NodeParameters(name, line))

    def parameters(self, node: NodeParameters, name: str, tree: Tree) -> None:
        match tree:
            case MappingNode():
                for key, line, child in self.entries(tree, name):
                    path = f"{name}.{key}" if name else key
                    node.lines.setdefault(path, line)
                    for above in (path[: dot.start()] for dot in re.finditer(r"\.", path)):
                        node.groups.add(above)
                        node.lines.setdefault(above, line)
                    if isinstance(child, MappingNode):
                        node.groups.add(path)
                    self.parameters(node, path, child)
            case _ if not name:
                self.report.mistake(
                    tree.line,
                    PARAMETERS_KEY,
                    "no parameters below it; communication, command and telemetry are needed",
                )
            case ScalarNode():
                node.values[name] = self.scalar(name, tree)
            case SequenceNode():
                items = [self.scalar(name, _word(item) or item) for item in tree.items]
                readable = tuple(item for item in items if item is not None)
                if len({type(item.value) for item in readable}) > 1:
                    self.report.mistake(
                        tree.line, name, "values of several kinds in one list; ROS 2 takes one kind"
                    )
                    readable = ()
                node.values[name] = readable if len(readable) == len(items) else None
            case AliasNode():
                node.values[name] = self.scalar(name, tree)

    def scalar(self, name: str, tree: Tree) -> ScalarNode | None:
        match tree:
            case ScalarNode(missing=False):
                return tree
            case ScalarNode():
                text = "no value; write one, or '' for an empty string"
            case AliasNode():
                text = "an alias (*); ROS 2 takes none: write the value out"
            case _:
                text = "a list or mapping inside a list; ROS 2 takes plain values there"
        self.report.mistake(tree.line, name, text)
        return None

    def entries(self, tree: MappingNode, above: str) -> list[tuple[str, int, Tree]]:
        """Return key, line and value of each usable entry: its key is plain text and not repeated."""
        first_lines: dict[str, int] = {}
        usable = []
        for key, child in tree.entries:
            if not isinstance(key, ScalarNode) or not key.text:
                self.report.mistake(key.line, above, "a key that is not a name; write NAME: VALUE")
            elif key.text in first_lines:
                text = f"written twice, on line {first_lines[key.text]} before; keep one"
                self.report.mistake(key.line, f"{above}.{key.text}" if above else key.text, text)
            else:
                first_lines[key.text] = key.line
                # The parser gives an empty value the position of the next token.
                if isinstance(child, ScalarNode) and child.missing:
                    child = ScalarNode("", "", key.line, missing=True)  # noqa: PLW2901
                usable.append((key.text, key.line, child))
        return usable


def _word(tree: Tree) -> ScalarNode | None:
    """Return the text ``NAME: TYPE`` of a mapping with one such entry: an envelope's word (our own key)."""
    match tree:
        case MappingNode(entries=((ScalarNode() as name, ScalarNode(missing=False) as kind),)):
            text = f"{name.text}: {kind.text}"
            return ScalarNode(text, text, name.line)
    return None


def _with_wildcards(nodes: list[NodeParameters]) -> list[NodeParameters]:
    """Give each named node the parameters of the wildcards that match it; as in rclcpp the last one wins."""
    targets = [node for node in nodes if "*" not in node.name]
    used: set[str] = set()
    result = []
    for node in targets:
        merged = NodeParameters(node.name, node.line)
        for other in nodes:
            if other is node or ("*" in other.name and name_matches(other.name, node.name)):
                used.add(other.name)
                merged.values.update(other.values)
                merged.groups.update(other.groups)
                merged.lines.update(other.lines)
        result.append(merged)
    return [*result, *(node for node in nodes if node.name not in used)]


def name_matches(pattern: str, name: str) -> bool:
    """Return whether a wildcard matches: ``*`` is one part of a name, ``**`` any number of parts."""
    parts = name.split("/")[1:]
    ends = {0}
    for part in pattern.split("/")[1:]:
        if part == "**":
            ends = set(range(min(ends, default=len(parts) + 1), len(parts) + 1))
        else:
            ends = {end + 1 for end in ends if end < len(parts) and part in {"*", parts[end]}}
    return len(parts) in ends


def suggestion(word: str, choices: Iterable[str]) -> str:
    """Return ``did you mean ...? `` with the nearest choice, or an empty text."""
    near = did_you_mean(word, choices, 1)
    return f"{near} " if near else ""


class Fields(msgspec.Struct, frozen=True):
    """The parameters of one node and the report of its file."""

    node: NodeParameters
    report: Mistakes

    def mistake(self, name: str, text: str) -> None:
        """Report a mistake at the line of the parameter, or of the nearest group around it."""
        self.report.mistake(self.node.line_of(name), name, text)

    def warn(self, name: str, text: str) -> None:
        """Report a warning at the line of the parameter."""
        self.report.warn(self.node.line_of(name), name, text)

    def has(self, name: str) -> bool:
        """Return whether the file has the parameter, valid or not."""
        return name in self.node.values or name in self.node.groups

    def text(self, name: str, allowed: str) -> str | None:
        """Return a string. The bridges throw for any other type."""
        scalar = self._scalar(name, allowed)
        if scalar is None:
            return None
        if isinstance(scalar.value, str):
            return scalar.value
        self.mistake(
            name, f'{scalar.described}; a string is needed: write "{printable(scalar.text)}" in quotes'
        )
        return None

    def integer(
        self, name: str, lowest: int = -(2**63), highest: int = 2**63 - 1, allowed: str = ""
    ) -> int | None:
        """Return an integer within limits. The bridges throw for a string, a float or a boolean."""
        allowed = allowed or f"an integer from {lowest} to {highest} is needed"
        scalar = self._scalar(name, allowed)
        if scalar is None:
            return None
        value = scalar.value
        if isinstance(value, bool) or not isinstance(value, int):
            unquoted = read_scalar(scalar.text.strip())
            if isinstance(value, str) and isinstance(unquoted, int) and not isinstance(unquoted, bool):
                allowed = f"write {printable(scalar.text.strip())} without quotes"
            self.mistake(name, f"{scalar.described}; {allowed}")
            return None
        if not lowest <= value <= highest:
            self.mistake(name, f"{printable(scalar.text)} is out of range; {allowed}")
            return None
        return value

    def flag(self, name: str) -> bool | None:
        """Return a boolean; None if it is absent or wrong."""
        value = self._value(name, "true or false is needed", lambda item: isinstance(item, bool))
        return None if value is None else bool(value)

    def rate(self, name: str) -> float | None:
        """Return a rate in Hz, an integer or a float above 0; None if it is absent or wrong."""
        if not self.has(name):
            return None
        allowed = "a rate in messages a second is needed, as 30 or 0.5"
        value = self._value(name, allowed, lambda item: type(item) in {int, float} and 0 < item < math.inf)
        return None if value is None else float(value)

    def _value(self, name: str, allowed: str, fits: Callable[[Any], bool]) -> Any:
        scalar = self._scalar(name, allowed)
        if scalar is None or fits(scalar.value):
            return scalar and scalar.value
        self.mistake(name, f"{scalar.described}; {allowed}")
        return None

    def word(self, name: str, choices: Sequence[str]) -> str | None:
        """Return one of the given words; None if it is absent or wrong."""
        if not self.has(name):
            return None
        allowed = f"{either(choices)} is needed"
        text = self.text(name, allowed)
        if text is None or text in choices:
            return text
        self.mistake(name, f'"{printable(text)}" is not known; {suggestion(text, choices)}{allowed}')
        return None

    def count(self, name: str, highest: int) -> int | None:
        """Return an integer from 1 to ``highest``; None if it is absent or wrong."""
        return self.integer(name, 1, highest) if self.has(name) else None

    def address(self, name: str) -> str | None:
        """Return a dotted IPv4 address. The bridges pass it to ``inet_addr``, which resolves no names."""
        text = self.text(name, allowed="an IPv4 address is needed, as 127.0.0.1")
        if text is None:
            return None
        try:
            return str(ipaddress.IPv4Address(text))
        except ValueError:
            reason = "is not an IPv4 address; the bridges resolve no host names: write it as 127.0.0.1"
            self.mistake(name, f'"{printable(text)}" {reason}')
            return None

    def msg_ids(self, name: str) -> tuple[int, ...]:
        """Return a list of MsgIds; empty if it is absent or wrong."""
        allowed = "a list of MsgIds from 0x1 to 0x1FFF is needed, as [0x18C8, 0x8C2]"
        value = self.node.values.get(name)
        if isinstance(value, tuple) and all(
            type(item.value) is int and 0 < item.value <= 0x1FFF for item in value
        ):
            return tuple(int(item.value) for item in value)
        if self.has(name):
            self.mistake(name, allowed)
        return ()

    def keys(self, name: str) -> list[ScalarNode]:
        """Return a list of strings, each with its line; empty if it is absent or wrong."""
        allowed = "a list of keys is needed, as ['cmd_twist']"
        value = self.node.values.get(name)
        if isinstance(value, ScalarNode):
            self.mistake(name, f"{value.described}; {allowed}")
        elif value is None:
            self._absent(name, allowed)
        elif not value:
            self.warn(name, "an empty list, which ROS 2 refuses; [''] is an empty list to a bridge")
        elif not isinstance(value[0].value, str):
            self.mistake(name, f"{value[0].described}; {allowed}")
        else:
            return list(value)
        return []

    def _scalar(self, name: str, allowed: str) -> ScalarNode | None:
        value = self.node.values.get(name)
        if isinstance(value, ScalarNode):
            return value
        if value is None:
            self._absent(name, allowed)
        else:
            self.mistake(name, f"a list; {allowed}")
        return None

    def _absent(self, name: str, allowed: str) -> None:
        """Report a parameter without a value, unless the reader of the file has reported it."""
        if name in self.node.groups:
            self.mistake(name, f"a mapping; {allowed}")
        elif name not in self.node.values:
            self.mistake(name, f"missing; {allowed}")
