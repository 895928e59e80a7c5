"""CDR of one message to values, and values to CDR.

A message is valid if its representation is CDR, every field lies inside the message, every string ends in NUL
(or has length 0, as some writers send an empty one) and no bound is exceeded. Invalid UTF-8 is replaced, and
any non-zero ``bool`` is true. Bytes after the last field are ignored, as by every receiver of ROS 2. Reading
is fast if the message is valid, and gives the details of the mistake if it is not.

Values are dicts and lists, as from JSON or YAML, and are checked field by field when they are written.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

import numpy as np

from edoras_tools.errors import ConfigError, FieldError, TruncatedError, WireError
from edoras_tools.ros.cdr.plan import WIDE_UNIT, CdrPlan, Leaf, PrimitiveRun, Repeat, Text
from edoras_tools.ros.library import PRIMITIVES, STRINGS, Definition, MessageField, Shape
from edoras_tools.wire.envelope import CDR_BE, CDR_LE

ENCAPSULATION_BYTES: Final = 4
"""Bytes before the body: representation and options (DDSI-RTPS 10.2)."""
_ORDERS: Final = {CDR_LE: 0, CDR_BE: 1}
_COUNTS: Final = struct.Struct("<I"), struct.Struct(">I")


class OctetValues(bytes):
    """The elements of a sequence of octets, as the data of an image; equal to the list of their numbers."""

    __slots__ = ()

    def __eq__(self, other: object) -> bool:
        return list(self) == other if isinstance(other, list) else super().__eq__(other)

    __hash__ = bytes.__hash__


class ValueSpan(NamedTuple):
    """A value of a message and its place.

    Attributes:
        path: dotted path with indexes, as ``poses[0].position.x``.
        value: number, bool, str or a list of numbers.
        start: first byte, counted from the encapsulation's first byte; a string starts with its length.
        end: one past the last byte.
    """

    path: str
    value: Any
    start: int
    end: int


class _Misfit(struct.error):
    """The fast reader stopped, for example at missing bytes; ``value_spans`` reports place and reason."""


def decode(name: str, plan: CdrPlan, cdr: bytes) -> Any:
    """Return the value of a message.

    Raises:
        WireError: the message is not valid.
    """
    order = encapsulation_order(name, cdr)
    values: list[Any] = []
    try:
        end = _read(plan, order, cdr[ENCAPSULATION_BYTES:], 0, values)
    except struct.error:
        end = -1
    if end < 0:
        value_spans(name, plan, cdr)  # raises the error with its position
    return plan.build(values)


def value_spans(name: str, plan: CdrPlan, cdr: bytes) -> list[ValueSpan]:
    """Return every leaf of a message, in wire order.

    Raises:
        TruncatedError: a field needs more bytes than there are; offsets count from the start of ``cdr``.
        FieldError: a string has no NUL, or a field has more elements than the type allows.
        WireError: the representation is not CDR.
    """
    order = encapsulation_order(name, cdr)
    spans: list[ValueSpan] = []
    _Walk(name, cdr, order, spans).plan(plan, "", ENCAPSULATION_BYTES)
    return spans


def skip(plan: CdrPlan, order: int, body: bytes, position: int, times: int) -> int | None:
    """Return the end of elements that start at a position; None if they do not fit.

    Args:
        plan: plan of an element.
        order: 0 for little-endian, 1 for big-endian.
        body: the message without the encapsulation.
        position: start, from the start of the body.
        times: number of elements.
    """
    try:
        for _ in range(times):
            position = _read(plan, order, body, position, [])
    except struct.error:
        return None
    return position


def bytes_left(plan: CdrPlan, order: int, body: bytes) -> int:
    """Return the bytes after the last field; -1 if the body is not valid; arguments as in ``skip``."""
    end = skip(plan, order, body, 0, 1)
    return -1 if end is None else len(body) - end


def encapsulation_order(name: str, cdr: bytes) -> int:
    """Return 0 for a little-endian message, 1 for a big-endian one.

    Raises:
        WireError: the representation is not CDR.
    """
    if len(cdr) < ENCAPSULATION_BYTES:
        raise TruncatedError(f"{name} encapsulation", 0, ENCAPSULATION_BYTES, len(cdr))
    representation = int.from_bytes(cdr[:2], "big")
    if representation not in _ORDERS:
        raise WireError(
            f"{name}: representation 0x{representation:04x} is not supported; CDR is 0x0000 or 0x0001"
        )
    return _ORDERS[representation]


def _read(plan: CdrPlan, order: int, body: bytes, position: int, values: list[Any]) -> int:
    """Append the flat values of a plan; return its end."""
    for step in plan.steps:
        if isinstance(step, PrimitiveRun):
            position = (position + step.alignment - 1) & -step.alignment
            values += step.structs[order].unpack_from(body, position)
            position += step.size
        elif isinstance(step, Text):
            position = _read_texts(step, order, body, position, 1, values)
        else:
            position = _read_repeat(step, order, body, position, values)
    return position


def _read_texts(step: Text, order: int, body: bytes, position: int, times: int, values: list[Any]) -> int:
    count_at, width, size = _COUNTS[order].unpack_from, step.width, len(body)
    for _ in range(times):
        start = (position + 7) & -4
        (length,) = count_at(body, start - 4)
        position = start + length * width
        if position > size or (step.bound and _over(step, length)):
            raise _Misfit
        if width > 1:
            values.append(string_value(step, order, body[start:position]))
        elif length and body[position - 1]:
            raise _Misfit
        else:  # an empty string may have no NUL
            values.append(body[start : position - 1].decode("utf-8", "replace"))
    return position


def _read_repeat(step: Repeat, order: int, body: bytes, position: int, values: list[Any]) -> int:
    count, plan = step.count, step.plan
    if count is None:
        position = (position + 7) & -4
        (count,) = _COUNTS[order].unpack_from(body, position - 4)
        if step.bound and count > step.bound:
            raise _Misfit
    if count and (run := plan.uniform):
        position = (position + run.alignment - 1) & -run.alignment
        end = position + count * run.size
        if end > len(body):
            raise _Misfit
        leaf = plan.element
        if leaf is None:
            values.append(list(map(plan.build, run.structs[order].iter_unpack(body[position:end]))))
        elif leaf.code == "B":
            values.append(OctetValues(body[position:end]))
        else:
            values.append([*struct.unpack_from(f"{'<>'[order]}{count}{leaf.code}", body, position)])
        return end
    if position + count * plan.least > len(body):
        raise _Misfit
    elements: list[Any] = []
    values.append(elements)
    only = plan.steps[0]
    if plan.single and isinstance(only, Text):
        return _read_texts(only, order, body, position, count, elements)
    for _ in range(count):
        flat: list[Any] = []
        position = _read(plan, order, body, position, flat)
        elements.append(plan.build(flat))
    return position


def _numbers(leaf: Leaf, order: int, data: bytes) -> list[Any]:
    if leaf.code == "B":
        return list(data)
    return list(struct.unpack(f"{'<>'[order]}{len(data) // leaf.size}{leaf.code}", data))


def _over(step: Text, length: int) -> bool:
    """Return whether a string is longer than its bound; the length of a UTF-8 string counts the NUL."""
    return 0 < step.bound < length - (step.width == 1)


def string_value(step: Text, order: int, data: bytes) -> str:
    """Return a string from its bytes, NUL included."""
    if step.width == 1:
        return data[:-1].decode("utf-8", "replace")
    units = struct.unpack(f"{'<>'[order]}{len(data) // WIDE_UNIT}I", data)
    return struct.pack(f"<{len(units)}H", *(unit & 0xFFFF for unit in units)).decode("utf-16-le", "replace")


class _Walk:
    """Reads field by field and records positions, counted from the encapsulation's first byte."""

    def __init__(self, name: str, cdr: bytes, order: int, spans: list[ValueSpan]) -> None:
        self._name = name
        self._cdr = cdr
        self._order = order
        self._spans = spans

    def plan(self, plan: CdrPlan, path: str, position: int) -> int:
        """Append the spans of one plan; return its end."""
        for step in plan.steps:
            if isinstance(step, PrimitiveRun):
                position = self._run(step, path, position)
            elif isinstance(step, Text):
                position = self._text(step, path + step.name, position)
            else:
                position = self._repeat(step, path + step.name, position)
        return position

    def _run(self, step: PrimitiveRun, path: str, position: int) -> int:
        position = _aligned(position, step.alignment)
        for leaf in step.leaves:
            start, end = position + leaf.offset, position + leaf.end
            self._need(path + leaf.name, start, end)
            values = _numbers(leaf, self._order, self._cdr[start:end])
            self._spans.append(
                ValueSpan(path + leaf.name, values[0] if leaf.count is None else values, start, end)
            )
        return position + step.size

    def _text(self, step: Text, path: str, position: int) -> int:
        length, start = self._count(path, position)
        end = start + length * step.width
        self._need(path, start, end)
        if _over(step, length):
            self._refuse(path, f"{length} characters at byte {start}; at most {step.bound} may be there")
        if step.width == 1 and length > 0 and self._cdr[end - 1] != 0:
            self._refuse(path, f"the string of {length} bytes at byte {start} does not end in NUL")
        self._spans.append(
            ValueSpan(path, string_value(step, self._order, self._cdr[start:end]), start - 4, end)
        )
        return end

    def _repeat(self, step: Repeat, path: str, position: int) -> int:
        begin, count, plan = position, step.count, step.plan
        if count is None:
            count, position = self._count(path, position)
            begin = position - 4
            if step.bound and count > step.bound:
                self._refuse(path, f"{count} elements at byte {begin}; at most {step.bound} may be there")
        self._need(path, position, position + count * plan.least)
        leaf = plan.element
        if leaf is not None:
            start = _aligned(position, leaf.size) if count else position
            end = start + count * leaf.size
            self._need(path, start, end)
            self._spans.append(ValueSpan(path, _numbers(leaf, self._order, self._cdr[start:end]), begin, end))
            return end
        if not count:
            self._spans.append(ValueSpan(path, [], begin, position))
        dot = "." if _first_name(plan.steps[0]) else ""  # strings have no name of their own
        for index in range(count):
            position = self.plan(plan, f"{path}[{index}]{dot}", position)
        return position

    def _count(self, path: str, position: int) -> tuple[int, int]:
        start = _aligned(position, 4)
        self._need(path, start, start + 4)
        return _COUNTS[self._order].unpack_from(self._cdr, start)[0], start + 4

    def _need(self, path: str, start: int, end: int) -> None:
        if end > len(self._cdr):
            raise TruncatedError(f"{self._name} {path}", start, end - start, max(len(self._cdr) - start, 0))

    def _refuse(self, path: str, why: str) -> None:
        raise FieldError(self._name, path, why)


def _aligned(position: int, alignment: int) -> int:
    """Align a position that counts from the encapsulation: alignment counts from the byte after it."""
    return ((position - ENCAPSULATION_BYTES + alignment - 1) & -alignment) + ENCAPSULATION_BYTES


def _first_name(step: PrimitiveRun | Text | Repeat) -> str:
    return step.leaves[0].name if isinstance(step, PrimitiveRun) else step.name


_FLOATS: Final = frozenset({"float32", "float64"})
_BYTES: Final = frozenset({"uint8", "byte", "char"})
_ZEROS: Final = tuple(bytes(count) for count in range(8))


class _Unwritable(Exception):  # noqa: N818  it never leaves this file
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
        except _Unwritable as error:
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
                raise _Unwritable(f"takes a mapping of {listed}, not {_printed(values)}")
            if unknown := values.keys() - names:
                raise _Unwritable(
                    f"{name} has no field {', '.join(sorted(map(str, unknown)))}; it has {listed}"
                )
            for item, write_field, default in fields:
                try:
                    write_field(body, values.get(item, default))
                except _Unwritable as error:
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
                raise _Unwritable(
                    f"{takes}{' or bytes' if field.type in _BYTES else ''}, not {_printed(values)}"
                )
            if is_array and len(values) != count:
                raise _Unwritable(f"{takes} of {count} values, not {len(values)}")
            if bound and len(values) > bound:
                raise _Unwritable(f"{takes} of at most {bound} values, not {len(values)}")
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
                except _Unwritable as error:
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
                    raise _Unwritable(f"{takes}, not {_printed(value)}")
            try:
                packed = pack(value)
            except (struct.error, OverflowError):
                raise _Unwritable(f"{takes}, not {_printed(value)}") from None
            body += _ZEROS[-len(body) & mask]
            body += packed

        return write

    def _text(self, field: MessageField) -> Callable[[bytearray, Any], None]:
        order, bound = self._order, field.string_bound
        narrow = field.type == "string"
        takes = f"takes a string{f' of at most {bound} characters' if bound else ''}"

        def write(body: bytearray, value: Any) -> None:
            if not isinstance(value, str):
                raise _Unwritable(f"{takes}, not {_printed(value)}")
            try:
                data = value.encode("utf-8" if narrow else "utf-16-le")
            except UnicodeEncodeError:
                raise _Unwritable(f"{takes} of Unicode characters, not {_printed(value)}") from None
            length = len(data) if narrow else len(data) // 2
            if bound and length > bound:
                raise _Unwritable(f"{takes}, not {length}")
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
