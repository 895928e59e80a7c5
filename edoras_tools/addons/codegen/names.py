"""ROS names and values in C."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Collection

_KEYWORDS: Final = frozenset(
    """
    auto break case char const continue default do double else enum extern float for goto if inline int
    long register restrict return short signed sizeof static struct switch typedef union unsigned void
    volatile while bool true false asm and bitand bitor catch class compl const_cast constexpr decltype
    delete dynamic_cast explicit export friend mutable namespace new noexcept not nullptr operator or
    private protected public reinterpret_cast static_assert static_cast template this thread_local throw
    try typeid typename using virtual wchar_t xor linux unix
    """.split()  # noqa: SIM905  read as a text
)
"""Keywords of C and C++, and macros that compilers define."""
_TAKEN: Final = frozenset({"init", "read", "write", "encode", "decode", "MAX_CDR"})
"""Suffixes of names in C that are functions or constants of a type."""


def c_type_name(ros: str) -> str:
    """Return a message type's C name, as rosidl makes it: ``geometry_msgs__msg__Twist``."""
    return ros.replace("/", "__")


def member_name(ros: str, others: Collection[str] = ()) -> str:
    """Return a field's C name: its own; a keyword gets as many ``_`` behind it as needed.

    Args:
        ros: name in ROS.
        others: names of the other fields of the message.
    """
    name = ros
    while name in _KEYWORDS or (name != ros and name in others):
        name += "_"
    return name


def constant_name(owner: str, ros: str) -> str:
    """Return a constant's C name, as rosidl makes it."""
    return f"{c_type_name(owner)}__{ros}{'_' if ros in _TAKEN else ''}"


def literal(ros_type: str, value: Any) -> str:
    """Return a primitive or a string as a C constant of exactly its type."""
    if ros_type == "string":
        return string_literal(value)
    if ros_type == "bool":
        return "true" if value else "false"
    if ros_type.startswith("float"):
        return _floating(value, "F" if ros_type == "float32" else "")
    return _integer(ros_type, value)


def string_literal(value: str) -> str:
    """Return a string literal; characters other than printable ASCII are octal escapes of three digits."""
    return (
        '"'
        + "".join(
            chr(byte) if 32 <= byte < 127 and chr(byte) not in '"\\?' else f"\\{byte:03o}"
            for byte in value.encode("utf-8", "surrogatepass")
        )
        + '"'
    )


def comment(value: str) -> str:
    """Return a text that is safe inside a comment."""
    return value.replace("*/", "* /").replace("/*", "/ *")


def _integer(ros_type: str, value: int) -> str:
    suffix = "" if ros_type.startswith("int") else "U"
    digits = f"{abs(value)}{suffix}"
    if ros_type.endswith("64"):
        digits = f"{'U' * bool(suffix)}INT64_C({abs(value)})"
    if ros_type in {"int32", "int64"} and value == -(1 << (int(ros_type[3:]) - 1)):
        return f"(-{digits.replace(str(abs(value)), str(abs(value) - 1))} - 1)"
    return f"(-{digits})" if value < 0 else digits


def _floating(value: float, suffix: str) -> str:
    if math.isnan(value):
        return f"(0.0{suffix} / 0.0{suffix})"
    if math.isinf(value):
        return f"({'-' * (value < 0)}1.0{suffix} / 0.0{suffix})"
    digits = str(np.float32(value)) if suffix else repr(float(value))
    digits += suffix
    return f"({digits})" if value < 0 or digits.startswith("-") else digits
