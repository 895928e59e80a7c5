"""RIHS01, the hash by which ROS 2 tells apart definitions of one type name (REP-2016).

It is the SHA-256 of a JSON text that describes a message and all types that it uses: names and types of the
fields, without comments, constants and defaults. Distributions before Iron do not have it.
"""

from __future__ import annotations

import hashlib
import json
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.ros.library import PLACEHOLDER, MessageField, Shape, full_name

if TYPE_CHECKING:
    from edoras_tools.ros.store import TypeStore

HASH_VERSION: Final = "RIHS01_"
"""The start of every hash of this version of the standard; 64 hexadecimal digits follow."""

_NESTED: Final = 1
_TYPES: Final = {
    "int8": 2,
    "uint8": 3,
    "int16": 4,
    "uint16": 5,
    "int32": 6,
    "uint32": 7,
    "int64": 8,
    "uint64": 9,
    "float32": 10,
    "float64": 11,
    "char": 3,  # rosidl makes IDL's uint8 of a .msg file's char
    "bool": 15,
    "byte": 16,
    "string": 17,
    "wstring": 18,
}
"""Numbers of single values in ``type_description_interfaces/msg/FieldType``."""
_BOUNDED_STRING: Final = 4
"""Number that is added to the type's number for a string with a bound."""
_ARRAY: Final = 48
_BOUNDED_SEQUENCE: Final = 96
_SEQUENCE: Final = 144
"""Numbers that are added to the element type's number for an array or a sequence."""


def type_hash(types: TypeStore, type_name: str) -> str:
    """Return the hash of a message type, ``RIHS01_`` and 64 digits.

    It is computed from the definition in the store: a type that a distribution changed has another hash.

    Raises:
        RouteError: the type, or one that it uses, is not known.
        ConfigError: a definition holds mistakes.
    """
    name = full_name(type_name)
    used: set[str] = set()
    pending = [name]
    while pending:
        nested = {field.type for field in types.fields(pending.pop()) if "/" in field.type}
        pending += nested - used
        used |= nested
    text = json.dumps(
        {
            "type_description": _description(types, name),
            "referenced_type_descriptions": [_description(types, item) for item in sorted(used)],
        }
    )
    return HASH_VERSION + hashlib.sha256(text.encode()).hexdigest()


def _description(types: TypeStore, name: str) -> dict[str, Any]:
    fields = types.fields(name) or (MessageField(PLACEHOLDER, "uint8"),)
    return {"type_name": name, "fields": [_field(field) for field in fields]}


def _field(field: MessageField) -> dict[str, Any]:
    nested = "/" in field.type
    number = _NESTED if nested else _TYPES[field.type]
    if field.string_bound:
        number += _BOUNDED_STRING
    if field.shape is Shape.ARRAY:
        number += _ARRAY
    elif field.shape is Shape.SEQUENCE:
        number += _BOUNDED_SEQUENCE if field.size else _SEQUENCE
    kind = {
        "type_id": number,
        "capacity": field.size,
        "string_capacity": field.string_bound,
        "nested_type_name": field.type if nested else "",
    }
    return {"name": field.name, "type": kind}
