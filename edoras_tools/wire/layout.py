"""One table for each header, and the readers and the writer that are made from it.

A :class:`Layout` states a header once: names, widths, signs, byte order, enumerations, a line of
documentation and the clause. From it come the scalar :meth:`Layout.parse` and :meth:`Layout.emit`, the column
reader :meth:`Layout.columns`, and (elsewhere) the tree view and the dissectors of other tools.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final, Literal

import msgspec
import numpy as np

from edoras_tools.errors import FieldError, TruncatedError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.wire.arrays import Octets

_WORDS: Final = (1, 2, 3, 4, 8)
_FLOATS: Final = {4: "f", 8: "d"}
FieldKind = Literal["uint", "int", "float", "text", "bytes"]


class Field(msgspec.Struct, frozen=True):
    """One field of a header.

    Attributes:
        name: name in the standard, in snake case.
        bits: width in bits; ``text`` and ``bytes`` are whole bytes.
        doc: one line of documentation.
        kind: ``uint``, ``int`` (two's complement), ``float`` (IEEE 754), ``text`` (NUL-terminated ASCII) or
            ``bytes``.
        names: meanings of values, if they are enumerated.
        base: base in which people read the number: 10 or 16.
        clause: clause of the standard or source.
    """

    name: str
    bits: int
    doc: str
    kind: FieldKind = "uint"
    names: Mapping[int, str] = msgspec.field(default_factory=dict)
    base: Literal[10, 16] = 10
    clause: str = ""

    def text(self, value: Any) -> str:
        """Return a value as text for users: ``0x1827``, ``telecommand (1)``, ``42``."""
        if self.kind in {"text", "bytes"}:
            return value.hex() if isinstance(value, bytes) else str(value)
        if self.kind == "float":
            return f"{value:.9g}"
        number = f"0x{value:0{(self.bits + 3) // 4}x}" if self.base == 16 else str(value)
        name = self.names.get(value)
        return f"{name} ({number})" if name else number


class Slot(msgspec.Struct, frozen=True):
    """The place of a field in its header.

    Attributes:
        field: the field.
        start: first byte, from the start of the header.
        end: offset after the last byte.
        shift: bits to the right of it in the word ``start:end``.
        mask: mask of its bits, after the shift.
    """

    field: Field
    start: int
    end: int
    shift: int
    mask: int


class Layout:
    """The single description of a header.

    Attributes:
        name: short name of the layer, such as ``ccsds``.
        title: name of the layer for people.
        slots: fields with their places, in wire order.
        size: length of the header in bytes.
        byte_order: ``big`` or ``little``; bit fields are packed from the most significant bit of a big-endian
            word, so a little-endian layout holds only whole bytes.
    """

    def __init__(
        self, name: str, title: str, *fields: Field, byte_order: Literal["big", "little"] = "big"
    ) -> None:
        self.name = name
        self.title = title
        self.byte_order: Literal["big", "little"] = byte_order
        slots: list[Slot] = []
        bit = 0
        for item in fields:
            start, end = bit // 8, (bit + item.bits + 7) // 8
            shift = end * 8 - bit - item.bits
            if byte_order == "little" and (shift or bit % 8):
                raise ValueError(f"{name}.{item.name}: a little-endian layout holds whole bytes only")
            sizes = {"uint": _WORDS, "int": _WORDS, "float": _FLOATS}.get(item.kind)
            if sizes and end - start not in sizes:
                raise ValueError(f"{name}.{item.name}: lies across {end - start} bytes, not in a word")
            slots.append(Slot(item, start, end, shift, (1 << item.bits) - 1))
            bit += item.bits
        if bit % 8:
            raise ValueError(f"{name}: {bit} bits are no whole number of bytes")
        self.slots: tuple[Slot, ...] = tuple(slots)
        self.size = bit // 8

    @cached_property
    def big(self) -> Layout:
        """The same header in big-endian byte order, as some flight computers write it."""
        return Layout(self.name, self.title, *(slot.field for slot in self.slots))

    @cached_property
    def by_name(self) -> Mapping[str, Slot]:
        """The slots by field name."""
        return {slot.field.name: slot for slot in self.slots}

    def parse(self, data: bytes | memoryview, offset: int = 0) -> dict[str, Any]:
        """Read every field at ``offset``.

        Returns:
            Field name to int, str (``text``, cut at the first NUL) or bytes.

        Raises:
            TruncatedError: there are fewer than ``size`` bytes.
        """
        if len(data) - offset < self.size:
            raise TruncatedError(self.name, offset, self.size, max(0, len(data) - offset))
        return {slot.field.name: self.read(slot, data, offset) for slot in self.slots}

    def read(self, slot: Slot, data: bytes | memoryview, offset: int = 0) -> Any:
        """Read one field of a header that starts at ``offset``; its bytes must exist."""
        raw = bytes(data[offset + slot.start : offset + slot.end])
        if slot.field.kind == "bytes":
            return raw
        if slot.field.kind == "text":
            return raw.split(b"\0", 1)[0].decode("utf-8", "replace")
        if slot.field.kind == "float":
            return struct.unpack(self._code(slot), raw)[0]
        value = (int.from_bytes(raw, self.byte_order) >> slot.shift) & slot.mask
        return value - slot.mask - 1 if slot.field.kind == "int" and value > slot.mask >> 1 else value

    def _code(self, slot: Slot) -> str:
        return (">" if self.byte_order == "big" else "<") + _FLOATS[slot.end - slot.start]

    def emit(self, values: Mapping[str, Any]) -> bytes:
        """Write a header; fields without a value are zero.

        Raises:
            FieldError: a name is not in this layout, or a value does not fit its field.
        """
        number = 0
        for name, value in values.items():
            if name not in self.by_name:
                raise FieldError(self.name, name, f"no such field; there are {', '.join(self.by_name)}")
            slot = self.by_name[name]
            number |= self._word(slot, value) << (8 * (self.size - slot.end) + slot.shift)
        return number.to_bytes(self.size, "big")

    def _word(self, slot: Slot, value: Any) -> int:
        """Return the bits of a field as a number, most significant bit first."""
        kind, size = slot.field.kind, slot.end - slot.start
        if kind == "float":
            return int.from_bytes(struct.pack(self._code(slot), value), "big")
        if kind in {"text", "bytes"}:
            raw = value.encode() if isinstance(value, str) else bytes(value or b"")
            if len(raw) > size:
                raise FieldError(self.name, slot.field.name, f"{len(raw)} bytes exceed {size}")
            return int.from_bytes(raw.ljust(size, b"\0"), "big")
        low, high = (-(slot.mask >> 1) - 1, slot.mask >> 1) if kind == "int" else (0, slot.mask)
        if not low <= value <= high:
            raise FieldError(
                self.name, slot.field.name, f"{value} exceeds {slot.field.bits} bits ({low} to {high})"
            )
        word: int = value & slot.mask
        return word if self.byte_order == "big" else int.from_bytes(word.to_bytes(size, "little"), "big")

    def column(self, name: str, window: Octets, at: int = 0) -> NDArray[Any]:
        """Read one numeric field of many headers.

        Args:
            window: u8 (n, w), one row a header.
            at: offset of the header in a row; its bytes must be inside the row.

        Returns:
            (n,) of the smallest type of its sign that holds the field; float32 or float64 for a float.
        """
        slot = self.by_name[name]
        size = slot.end - slot.start
        value: NDArray[Any]
        order = ">" if self.byte_order == "big" else "<"
        if slot.field.kind == "float":
            floats = window[:, at + slot.start : at + slot.end].view(f"{order}f{size}")
            return floats[:, 0].astype(f"f{size}")
        if size == 3:
            octets = window[:, at + slot.start : at + slot.end][:, :: 1 if order == ">" else -1]
            size, value = 4, octets @ np.array([1 << 16, 1 << 8, 1], np.uint32)
        else:  # in a word of 1, 2, 4 or 8 bytes, so one strided read is enough
            word = window[:, at + slot.start : at + slot.end].view(f"{order}u{size}")
            value = word[:, 0].astype(f"u{size}")
        if slot.shift:
            value >>= slot.shift
        if slot.mask != (1 << 8 * size) - 1:
            value &= np.array(slot.mask, value.dtype)
        if slot.field.kind == "int":
            spare = 8 * size - slot.field.bits
            return (value << spare).view(f"i{size}") >> spare
        return value

    def columns(self, window: Octets, at: int = 0) -> dict[str, NDArray[Any]]:
        """Read every numeric field of many headers: see :meth:`column`."""
        return {
            slot.field.name: self.column(slot.field.name, window, at)
            for slot in self.slots
            if slot.field.kind not in {"text", "bytes"}
        }
