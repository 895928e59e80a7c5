"""A ROS message definition, and its ``ros2msg`` text."""

from __future__ import annotations

import math
import re
from enum import Enum
from typing import TYPE_CHECKING, Any, Final

import msgspec

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

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
