"""Reads ``.msg`` text (ROS 2 interface definition, as rosidl does): one definition, or several joined.

Each mistake is a ``ConfigError`` of one line, ``FILE:LINE: what is wrong``.
"""

from __future__ import annotations

import re
import struct
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final, NamedTuple, NoReturn

from edoras_tools.errors import ConfigError
from edoras_tools.ros.types.schema import (
    PRIMITIVES,
    STRINGS,
    TYPE_NAME,
    Constant,
    Definition,
    MessageField,
    Shape,
    full_name,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

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
