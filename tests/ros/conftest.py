from __future__ import annotations

import struct
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import strategies as st
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.base import normalize_fieldname

from edoras_tools.ros import TypeStore
from edoras_tools.ros.library import PLACEHOLDER, PRIMITIVES, Shape

CUSTOM = {
    "odd_msgs/msg/Inner": "uint8 a\nfloat64 b\nuint8 c\n",
    "odd_msgs/msg/Gaps": "bool flag\nInner one\nInner[3] three\nInner[] many\nint16 tail\n",
    "odd_msgs/msg/Bounds": "string<=4 word\nint32[<=3] few\nstring<=2[<=2] words\n"
    "float32[2] pair\nstring[2] two\n",
    "odd_msgs/msg/Wide": "uint8 before\nwstring text\nwstring[] more\nwstring<=3 short\nfloat64 after\n",
    "odd_msgs/msg/Empties": "uint8 a\nstd_msgs/Empty one\nstd_msgs/Empty[] many\nuint16 b\n",
    "odd_msgs/msg/Deep": "Gaps[] gaps\nBounds[2] bounds\nint64 last\n",
    "odd_msgs/msg/Defaults": (
        "int32 a 5\nstring s 'it\\'s'\nfloat64[] f [1.5, -2]\nbool[2] b [true, false]\n"
        "geometry_msgs/Quaternion q\n"
        'uint8 LOW=1\nstring NAME="x # y"\nbool YES=true\nfloat32 HALF=0.5\n'
    ),
}


@pytest.fixture(scope="session")
def store():
    return TypeStore(definitions=CUSTOM)


@pytest.fixture(scope="session")
def rosbags_store():
    return get_typestore(Stores.ROS2_JAZZY)


def _numbers(code):
    size = struct.calcsize(code)
    if code == "?":
        return st.booleans()
    if code in "fd":
        return st.floats(width=size * 8)
    low, high = (
        (0, 2 ** (8 * size) - 1) if code.isupper() else (-(2 ** (8 * size - 1)), 2 ** (8 * size - 1) - 1)
    )
    return st.integers(low, high)


def _one(store, field):
    if field.type in PRIMITIVES:
        return _numbers(PRIMITIVES[field.type])
    if field.type in {"string", "wstring"}:
        return st.text(max_size=min(field.string_bound or 9, 9)).filter(
            lambda text: not field.string_bound or max(len(text.encode()), len(text)) <= field.string_bound
        )
    return messages(store, field.type)


def _field(store, field):
    one = _one(store, field)
    if field.shape is Shape.SCALAR:
        return one
    if field.shape is Shape.SEQUENCE:
        return st.lists(one, max_size=min(field.size or 3, 3))
    code = PRIMITIVES.get(field.type)
    if code in {None, "?"}:
        return st.lists(one, min_size=field.size, max_size=field.size)
    layout = struct.Struct(f"<{field.size}{code}")  # any bits, NaN of all kinds among them
    return st.binary(min_size=layout.size, max_size=layout.size).map(lambda raw: list(layout.unpack(raw)))


def messages(store, name):
    """Values of a type, as TypeStore.decode gives them."""
    definition = store._definition(name)
    return st.fixed_dictionaries({field.name: _field(store, field) for field in definition.fields})


def exact(value):
    """The value with floats as bits, so that NaN equals itself and -0.0 does not equal 0.0."""
    if isinstance(value, dict):
        return {key: exact(item) for key, item in value.items()}
    if isinstance(value, (list, bytes)):
        return [exact(item) for item in value]
    return struct.pack("<d", value) if isinstance(value, float) else (type(value), value)


def _dtype(base):
    return {"bool": np.bool_, "char": np.uint8, "byte": np.int8}.get(base) or np.dtype(base).type


def to_rosbags(types, name, values):
    """A rosbags message from plain values. rosbags takes byte as signed."""

    def leaf(base, value):
        return value - 256 if base == "byte" and value > 127 else value

    def convert(kind, arguments, value):
        if kind == Nodetype.NAME:
            return to_rosbags(types, arguments, value)
        if kind == Nodetype.BASE:
            return leaf(arguments[0], value)
        (inner, inner_arguments), _ = arguments
        items = [convert(inner, inner_arguments, item) for item in value]
        numeric = inner == Nodetype.BASE and inner_arguments[0] != "string"
        return np.array(items, _dtype(inner_arguments[0])) if numeric else items

    fields = types.fielddefs[name][1]
    return types.types[name](
        **{
            normalize_fieldname(item): 0 if item == PLACEHOLDER else convert(*description, values[item])
            for item, description in fields
        }
    )


def from_rosbags(types, name, message):
    """Plain values from a rosbags message."""

    def convert(kind, arguments, value):
        if kind == Nodetype.NAME:
            return from_rosbags(types, arguments, value)
        if kind == Nodetype.BASE:
            return value % 256 if arguments[0] == "byte" else value
        (inner, inner_arguments), _ = arguments
        items = value.tolist() if isinstance(value, np.ndarray) else value
        return [convert(inner, inner_arguments, item) for item in items]

    fields = types.fielddefs[name][1]
    return {
        item: convert(*description, getattr(message, normalize_fieldname(item)))
        for item, description in fields
        if item != PLACEHOLDER
    }


@pytest.fixture(scope="session")
def tools():
    return SimpleNamespace(
        messages=messages, exact=exact, to_rosbags=to_rosbags, from_rosbags=from_rosbags, custom=tuple(CUSTOM)
    )
