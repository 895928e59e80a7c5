"""Writes values as CDR: dicts and lists, as from JSON or YAML, checked field by field."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np

from edoras_tools.errors import ConfigError, FieldError
from edoras_tools.ros.types.schema import PRIMITIVES, STRINGS, Definition, MessageField, Shape

_FLOATS: Final = frozenset({"float32", "float64"})
_BYTES: Final = frozenset({"uint8", "byte", "char"})
_ZEROS: Final = tuple(bytes(count) for count in range(8))


class _Misfit(Exception):  # noqa: N818  it never leaves this file
    """A value does not fit; each level that the exception passes puts its name in front of the path."""

    def __init__(self, why: str) -> None:
        super().__init__(why)
        self.why = why
        self.path: list[str] = []


class Writer:
    """Writes messages in one byte order.

    Args:
        find: returns the definition of a type; raises if there is none.
        big_endian: whether the byte order is big-endian.
    """

    def __init__(self, find: Callable[[str], Definition], *, big_endian: bool) -> None:
        self._find = find
        self._order = ">" if big_endian else "<"
        self._head = bytes((0, not big_endian, 0, 0))
        self._writers: dict[str, Callable[[bytearray, Any], None]] = {}

    def encode(self, name: str, values: Any) -> bytes:
        """Return a message, encapsulation included.

        Raises:
            FieldError: a value does not fit its field; the error names the field's path and the values it
                takes.
        """
        body = bytearray()
        try:
            self._message(name)(body, values)
        except _Misfit as error:
            path = "".join(error.path).removeprefix(".")
            raise FieldError(name, path or "(message)", error.why) from None
        return self._head + body

    def _message(self, name: str) -> Callable[[bytearray, Any], None]:
        if name not in self._writers:
            self._writers[name] = self._compile(name)
        return self._writers[name]

    def _compile(self, name: str) -> Callable[[bytearray, Any], None]:
        definition = self._find(name)
        fields = [(item.name, self._field(item), self._default(item)) for item in definition.fields]
        names = {item.name for item in definition.fields}
        listed = ", ".join(item.name for item in definition.fields) or "no field"

        def write(body: bytearray, values: Any) -> None:
            if not isinstance(values, Mapping):
                raise _Misfit(f"takes a mapping of {listed}, not {_printed(values)}")
            if unknown := values.keys() - names:
                raise _Misfit(f"{name} has no field {', '.join(sorted(map(str, unknown)))}; it has {listed}")
            for item, write_field, default in fields:
                try:
                    write_field(body, values.get(item, default))
                except _Misfit as error:
                    error.path.insert(0, f".{item}")
                    raise
            if not fields:
                body.append(0)

        return write

    def _field(self, field: MessageField) -> Callable[[bytearray, Any], None]:
        write = self._one(field)
        if field.shape is Shape.SCALAR:
            return write
        code = PRIMITIVES.get(field.type, "")
        size = struct.calcsize(self._order + code)
        plain = {int, float} if field.type in _FLOATS else {_kind(field.type)}
        order, count, bound = self._order, field.size, field.size if field.shape is Shape.SEQUENCE else 0
        is_array = field.shape is Shape.ARRAY
        takes = f"{field.type_text} takes a list"

        def write_all(body: bytearray, values: Any) -> None:
            if isinstance(values, np.ndarray):
                values = values.tolist()
            is_bytes = isinstance(values, bytes | bytearray | memoryview) and field.type in _BYTES
            values = bytes(values) if is_bytes else values
            if not is_bytes and not isinstance(values, list | tuple):
                raise _Misfit(f"{takes}{' or bytes' if field.type in _BYTES else ''}, not {_printed(values)}")
            if is_array and len(values) != count:
                raise _Misfit(f"{takes} of {count} values, not {len(values)}")
            if bound and len(values) > bound:
                raise _Misfit(f"{takes} of at most {bound} values, not {len(values)}")
            if not is_array:
                body += _ZEROS[-len(body) & 3] + struct.pack(f"{order}I", len(values))
            if code and values and (is_bytes or set(map(type, values)) <= plain):
                try:
                    packed = values if is_bytes else struct.pack(f"{order}{len(values)}{code}", *values)
                except (struct.error, OverflowError):
                    pass  # a value is out of range: writing one by one names it
                else:
                    body += _ZEROS[-len(body) & (size - 1)] + packed
                    return
            for index, value in enumerate(values):
                try:
                    write(body, value)
                except _Misfit as error:
                    error.path.insert(0, f"[{index}]")
                    raise

        return write_all

    def _one(self, field: MessageField) -> Callable[[bytearray, Any], None]:
        """Return the function that writes one value of a field's type, without the field's shape."""
        if field.type in PRIMITIVES:
            return self._primitive(field.type)
        if field.type in STRINGS:
            return self._text(field)
        if "/" not in field.type:
            raise ConfigError(f"{field.name}: ROS 2 sends no {field.type}")
        return self._message(field.type)

    def _primitive(self, type_name: str) -> Callable[[bytearray, Any], None]:
        packer = struct.Struct(self._order + PRIMITIVES[type_name])
        pack, mask, kind, takes = packer.pack, packer.size - 1, _kind(type_name), _takes(type_name)

        def write(body: bytearray, value: Any) -> None:
            if type(value) is not kind:
                value = _plain(value)
                if type(value) is not kind and not (kind is float and type(value) is int):
                    raise _Misfit(f"{takes}, not {_printed(value)}")
            try:
                packed = pack(value)
            except (struct.error, OverflowError):
                raise _Misfit(f"{takes}, not {_printed(value)}") from None
            body += _ZEROS[-len(body) & mask]
            body += packed

        return write

    def _text(self, field: MessageField) -> Callable[[bytearray, Any], None]:
        order, bound = self._order, field.string_bound
        narrow = field.type == "string"
        takes = f"takes a string{f' of at most {bound} characters' if bound else ''}"

        def write(body: bytearray, value: Any) -> None:
            if not isinstance(value, str):
                raise _Misfit(f"{takes}, not {_printed(value)}")
            try:
                data = value.encode("utf-8" if narrow else "utf-16-le")
            except UnicodeEncodeError:
                raise _Misfit(f"{takes} of Unicode characters, not {_printed(value)}") from None
            length = len(data) if narrow else len(data) // 2
            if bound and length > bound:
                raise _Misfit(f"{takes}, not {length}")
            if narrow:
                data, length = data + b"\0", length + 1
            else:
                data = struct.pack(f"{order}{length}I", *struct.unpack(f"<{length}H", data))
            body += _ZEROS[-len(body) & 3] + struct.pack(f"{order}I", length) + data

        return write

    def _default(self, field: MessageField) -> Any:
        if field.default is not None:
            return field.default
        if field.shape is Shape.SEQUENCE:
            return ()
        one: Any = {} if "/" in field.type else "" if field.type in STRINGS else _kind(field.type)()
        return one if field.shape is Shape.SCALAR else (one,) * field.size


def _kind(type_name: str) -> type:
    return bool if type_name == "bool" else float if type_name in _FLOATS else int


def _takes(type_name: str) -> str:
    if type_name == "bool":
        return "takes true or false"
    if type_name in _FLOATS:
        return f"takes a number that fits {type_name}"
    code = PRIMITIVES[type_name]
    bits = 8 * struct.calcsize("<" + code)
    low, high = (0, 2**bits - 1) if code.isupper() else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
    return f"takes a whole number from {low} to {high}"


def _plain(value: Any) -> Any:
    """Return a numpy scalar, an enum or a YAML scalar as a plain number; any other value unchanged."""
    if isinstance(value, np.generic):
        return value.item()
    kind = next((kind for kind in (bool, int, float) if isinstance(value, kind)), None)
    return kind(value) if kind else value


def _printed(value: Any) -> str:
    """Return a value as error messages show it: its type and a short text."""
    text = repr(value)
    return f"{type(value).__name__} {text if len(text) <= 60 else text[:57] + '...'}"
