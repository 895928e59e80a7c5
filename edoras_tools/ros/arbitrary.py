"""Makes messages with a value in every field; the same seed gives the same messages."""

from __future__ import annotations

import string
import struct
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.ros.types.schema import PRIMITIVES, STRINGS, MessageField, Shape

if TYPE_CHECKING:
    from random import Random

    from edoras_tools.ros.store import TypeStore

_MOST_ITEMS: Final = 4
_MOST_CHARACTERS: Final = 12
_LETTERS: Final = string.ascii_letters + string.digits + "_"
_REACH: Final = 1000.0
"""Largest absolute floating-point value: all are finite, and of a size that is usual for robots."""


def arbitrary(types: TypeStore, type_name: str, dice: Random) -> dict[str, Any]:
    """Return random values for every field of a type, in the form that ``TypeStore.encode`` takes."""
    return {field.name: _values(types, field, dice) for field in types.fields(type_name)}


def _values(types: TypeStore, field: MessageField, dice: Random) -> Any:
    if field.shape is Shape.SCALAR:
        return _value(types, field, dice)
    most = min(field.size or _MOST_ITEMS, _MOST_ITEMS)
    count = field.size if field.shape is Shape.ARRAY else dice.randint(1, most)
    return [_value(types, field, dice) for _ in range(count)]


def _value(types: TypeStore, field: MessageField, dice: Random) -> Any:
    if field.type in STRINGS:
        most = min(field.string_bound or _MOST_CHARACTERS, _MOST_CHARACTERS)
        return "".join(dice.choices(_LETTERS, k=dice.randint(1, most)))
    if field.type == "bool":
        return dice.random() < 0.5
    if field.type.startswith("float"):
        value = dice.uniform(-_REACH, _REACH)
        return struct.unpack("f", struct.pack("f", value))[0] if field.type == "float32" else value
    if field.type in PRIMITIVES:
        bits = 8 * struct.calcsize("=" + PRIMITIVES[field.type])
        signed = field.type.startswith("int")
        return dice.getrandbits(bits) - (1 << (bits - 1) if signed else 0)
    return arbitrary(types, field.type, dice)
