"""ROS message definitions: values, their ``ros2msg`` text, and the reader of such text.

``.msg`` text is read as rosidl does (ROS 2 interface definition): one definition, or several joined. Each
mistake is a ``ConfigError`` of one line, ``FILE:LINE: what is wrong``.
"""

from __future__ import annotations

import math
import re
import struct
from enum import Enum
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final, NamedTuple, NoReturn

import msgspec

from edoras_tools.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

PRIMITIVES: Final = {
    "bool": "?",
    "byte": "B",
    "char": "B",
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
"""``struct`` codes of the fixed-size ROS types; ROS 2's ``byte`` and ``char`` are both unsigned."""
STRINGS: Final = frozenset({"string", "wstring"})
PLACEHOLDER: Final = "structure_needs_at_least_one_member"
"""Name of the one byte that an empty message has on the wire; definitions and values do not have it."""
SEPARATOR: Final = "=" * 80
"""The line between the definitions of a complete ``ros2msg`` text."""

TYPE_NAME: Final = re.compile(r"[A-Za-z]\w*/(msg|srv|action)/[A-Za-z]\w*", re.ASCII)


class Shape(Enum):
    """The number of values in a field: one, fixed, or counted."""

    SCALAR = "scalar"
    ARRAY = "array"
    SEQUENCE = "sequence"


class MessageField(msgspec.Struct, frozen=True):
    """One field of a message.

    Attributes:
        name: name as written.
        type: a name of ``PRIMITIVES`` or ``STRINGS``, or the full name of a message type.
        string_bound: most characters of a string; 0 for no limit.
        shape: one value, a fixed number of values, or a counted sequence.
        size: elements of an array, or most elements of a sequence, 0 for no limit.
        default: value if none is given; None for zero.
    """

    name: str
    type: str
    string_bound: int = 0
    shape: Shape = Shape.SCALAR
    size: int = 0
    default: Any = None

    @property
    def type_text(self) -> str:
        """The type as a ``.msg`` file spells it."""
        bound = f"<={self.string_bound}" if self.string_bound else ""
        limit = "<=" if self.size and self.shape is Shape.SEQUENCE else ""
        count = "" if self.shape is Shape.SCALAR else f"[{limit}{self.size or ''}]"
        return short_name(self.type) + bound + count


class Constant(msgspec.Struct, frozen=True):
    """A named value of a message definition; it is not sent."""

    name: str
    type: str
    value: Any


class Definition(msgspec.Struct, frozen=True):
    """One message definition.

    Attributes:
        name: full type name, as ``geometry_msgs/msg/Twist``.
        fields: fields in wire order; none for an empty message.
        constants: constants in the order of the file.
    """

    name: str
    fields: tuple[MessageField, ...]
    constants: tuple[Constant, ...] = ()

    @property
    def text(self) -> str:
        """The definition as ``ros2msg`` text, without the types that it uses."""
        lines = [f"{item.type} {item.name}={_literal(item.value)}" for item in self.constants]
        for item in self.fields:
            default = "" if item.default is None else _literal(item.default)
            lines.append(f"{item.type_text} {item.name}" + (f" {default}" if default else ""))
        return "".join(line + "\n" for line in lines)


def full_name(name: str) -> str:
    """Return ``pkg/msg/Name`` for ``pkg/Name``; any other name unchanged."""
    package, slash, rest = name.partition("/")
    return f"{package}/msg/{rest}" if slash and "/" not in rest else name


def short_name(name: str) -> str:
    """Return ``pkg/Name`` for ``pkg/msg/Name``, as definitions refer to it; any other name unchanged."""
    return name.replace("/msg/", "/")


def with_used(name: str, find: Callable[[str], Definition]) -> tuple[Definition, ...]:
    """Return a type's definition, then the definitions of all types that it uses, each once."""
    by_name: dict[str, Definition] = {}

    def collect(name: str) -> None:
        if name not in by_name:
            by_name[name] = find(name)
            for item in by_name[name].fields:
                if "/" in item.type:
                    collect(item.type)

    collect(name)
    return tuple(by_name.values())


def complete_text(definitions: Iterable[Definition]) -> str:
    """Return a definition and those that it uses as one ``ros2msg`` text, in the form of an MCAP schema.

    Args:
        definitions: the message itself, then every type that it uses, each once.
    """
    head, *rest = definitions
    return head.text + "".join(f"{SEPARATOR}\nMSG: {short_name(item.name)}\n{item.text}" for item in rest)


def _literal(value: Any) -> str:
    """Return a constant or default as ``.msg`` text; empty if the format cannot express it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        quote = "'" if '"' in value and "'" not in value else '"'
        return quote + value.replace("\\", "\\\\").replace(quote, "\\" + quote) + quote
    if isinstance(value, list):
        items = [_literal(item) for item in value]
        return f"[{', '.join(items)}]" if items and all(items) else ""
    return repr(value) if isinstance(value, int) or math.isfinite(value) else ""


_CODE: Final = re.compile(r"""(?:[^#"']|"(?:\\.|[^"\\])*"|'(?:\\.|[^'\\])*'|["'])*?(?=#|$)""")
"""A line up to its comment; a ``#`` inside quotes does not start one."""
_TYPE: Final = re.compile(
    r"(?P<base>[A-Za-z][\w/]*)(?:<=(?P<bound>\d+))?(?P<array>\[(?P<limit><=)?(?P<size>\d*)\])?", re.ASCII
)
_NAME: Final = re.compile(r"[A-Za-z]\w*", re.ASCII)
_CONSTANT: Final = re.compile(r"([A-Za-z]\w*)\s*=\s*(.*)", re.ASCII)
_STRING: Final = re.compile(r""""((?:\\.|[^"\\])*)"|'((?:\\.|[^'\\])*)'""")
_ITEM: Final = re.compile(r"""\s*("(?:\\.|[^"\\])*"|'(?:\\.|[^'\\])*'|[^,"']+?)\s*(?:,|$)""")
_SECTION: Final = re.compile(r"={3,}\s*\nMSG:[ \t]*(\S+)[ \t]*\n?")
_TRUTH: Final = {"true": True, "1": True, "false": False, "0": False}
_MOST: Final = 2**32 - 1


class Section(NamedTuple):
    """One definition of a joined text: full type name, text, and line number where the text starts."""

    name: str
    text: str
    line: int


def sections(name: str, text: str) -> Iterator[Section]:
    """Yield the definitions of a complete ``ros2msg`` text, split at its ``===`` lines, the message first."""
    text = text.replace("\r\n", "\n")
    start, line = 0, 1
    for match in _SECTION.finditer(text):
        yield Section(full_name(name), text[start : match.start()], line)
        line += text.count("\n", start, match.end())
        start, name = match.end(), match[1]
    yield Section(full_name(name), text[start:], line)


@lru_cache(2048)  # several stores read the same definitions of a distribution
def parse_definition(name: str, text: str, file: str, first_line: int = 1) -> Definition:
    """Read one message definition.

    Args:
        name: full type name.
        text: the ``.msg`` text.
        file: name of the file in error messages.
        first_line: number of the text's first line in ``file``.

    Raises:
        ConfigError: every mistake of the text, a line each.
    """
    fields: dict[str, MessageField] = {}
    constants: dict[str, Constant] = {}
    mistakes = []
    for number, raw in enumerate(text.splitlines(), first_line):
        match = _CODE.match(raw)
        code = (match[0] if match else raw).strip()
        if not code:
            continue
        try:
            item = _line(name, code)
            members: dict[str, Any] = fields if isinstance(item, MessageField) else constants
            if item.name in members:
                _refuse(f"{item.name}: the name is taken already")
            members[item.name] = item
        except ValueError as error:
            mistakes.append(f"{file}:{number}: {error}")
    if mistakes:
        raise ConfigError(*mistakes)
    return Definition(name, tuple(fields.values()), tuple(constants.values()))


def _refuse(why: str) -> NoReturn:
    raise ValueError(why)


def _line(owner: str, code: str) -> MessageField | Constant:
    type_text, _, rest = code.partition(" ") if "\t" not in code else code.replace("\t", " ").partition(" ")
    rest = rest.strip()
    match = _TYPE.fullmatch(type_text)
    if match is None or not rest:
        _refuse(f"{code!r} is not a field; write TYPE NAME, TYPE NAME DEFAULT or TYPE NAME=VALUE")
    base, bound = match["base"], int(match["bound"] or 0)
    if constant := _CONSTANT.fullmatch(rest):
        if match["array"] or match["bound"] or base not in PRIMITIVES.keys() | STRINGS:
            _refuse(f"{constant[1]}: a constant is of a primitive type, not {type_text}")
        return Constant(constant[1], base, _value(base, constant[2], constant[1]))

    field_name, _, default = rest.partition(" ")
    if not _NAME.fullmatch(field_name):
        _refuse(f"{field_name!r} is not a field name; letters, digits and _ only")
    if base not in PRIMITIVES and base not in STRINGS:
        base = full_name(base) if "/" in base else f"{owner.rpartition('/')[0]}/{base}"
        if not TYPE_NAME.fullmatch(base):
            _refuse(f"{field_name}: {match['base']!r} is not a type name; write PACKAGE/NAME")
    if match["bound"] is not None and (base not in STRINGS or bound == 0):
        _refuse(f"{field_name}: only a string takes a bound, of at least 1, not {type_text}")
    shape, size = _shape(match, field_name)
    default = default.strip()
    value = None
    if default:
        if base not in PRIMITIVES and base not in STRINGS:
            _refuse(f"{field_name}: a field of a message type takes no default")
        value = (
            _value(base, default, field_name) if shape is Shape.SCALAR else _values(base, default, field_name)
        )
        if shape is Shape.ARRAY and len(value) != size:
            _refuse(f"{field_name}: the default holds {len(value)} values, {size} are declared")
    return MessageField(field_name, base, bound, shape, size, value)


def _shape(match: re.Match[str], name: str) -> tuple[Shape, int]:
    if not match["array"]:
        return Shape.SCALAR, 0
    if not match["size"] and not match["limit"]:
        return Shape.SEQUENCE, 0
    size = int(match["size"] or 0)
    if not 0 < size <= _MOST:
        _refuse(f"{name}: an array holds 1 to {_MOST} elements, not {match['array']}")
    return (Shape.SEQUENCE if match["limit"] else Shape.ARRAY), size


def _values(base: str, text: str, name: str) -> list[Any]:
    if not (text.startswith("[") and text.endswith("]")):
        _refuse(f"{name}: the default of an array is [a, b, c], not {text}")
    inner, position, values = text[1:-1].strip(), 0, []
    while position < len(inner):
        match = _ITEM.match(inner, position)
        if match is None:
            _refuse(f"{name}: {text} is not a list of {base}")
        values.append(_value(base, match[1], name))
        position = match.end()
    return values


def _value(base: str, text: str, name: str) -> Any:
    """Read a constant or a default, checked against its type."""
    if base in STRINGS:
        match = _STRING.fullmatch(text)
        if match is None:
            return text
        return re.sub(r"\\(.)", r"\1", match[1] if match[1] is not None else match[2])
    try:
        if base == "bool":
            return _TRUTH[text.lower()]
        value = float(text) if base.startswith("float") else _integer(text)
        struct.pack("<" + PRIMITIVES[base], value)
    except (KeyError, ValueError, OverflowError, struct.error):
        _refuse(f"{name}: {text!r} is not a valid {base}")
    return value


def _integer(text: str) -> int:
    digits = text.lstrip("+-")
    return int(text, 0 if digits[:2].lower() in {"0x", "0b", "0o"} else 10)
