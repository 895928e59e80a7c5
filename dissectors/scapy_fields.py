# SPDX-License-Identifier: GPL-2.0-only
"""scapy fields made from a ``Layout``; scapy is GPL-2.0-only, so this file is too."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from scapy.fields import BitEnumField, BitField, Field, StrFixedLenField, XBitField

if TYPE_CHECKING:
    from edoras_tools.wire.layout import Layout, Slot


class Number(Field):  # type: ignore[misc]  # scapy has no types
    """A number of whole bytes, read as its layout says."""

    __slots__ = ("slot",)

    def __init__(self, slot: Slot, default: int | None, order: str) -> None:
        codes = {"int": "bhiq", "uint": "BHIQ", "float": "__fd"}[slot.field.kind]
        super().__init__(slot.field.name, default, order + codes[(slot.end - slot.start).bit_length() - 1])
        self.slot = slot

    def i2repr(self, _packet: Any, value: Any) -> str:
        """Return the value as people read it."""
        return self.slot.field.text(value) if isinstance(value, (int, float)) else repr(value)


class Text(StrFixedLenField):  # type: ignore[misc]
    """NUL-terminated text in a field of fixed size."""

    def m2i(self, _packet: Any, raw: bytes) -> str:
        """Return the text up to its NUL."""
        return raw.split(b"\0", 1)[0].decode("utf-8", "replace")

    def i2m(self, _packet: Any, value: Any) -> bytes:
        """Return the bytes; the field pads them."""
        return value.encode() if isinstance(value, str) else bytes(value or b"")

    def i2repr(self, _packet: Any, value: Any) -> str:
        """Return the text quoted."""
        return repr(value)


def fields(layout: Layout, **defaults: Any) -> list[Any]:
    """Return scapy fields of a layout; those not named in ``defaults`` are zero."""
    return [_field(layout, slot, defaults.get(slot.field.name, 0)) for slot in layout.slots]


def _field(layout: Layout, slot: Slot, default: Any) -> Any:
    item, size = slot.field, slot.end - slot.start
    if item.kind == "text":
        return Text(item.name, default or "", size)
    if item.kind == "bytes":
        return StrFixedLenField(item.name, default or bytes(size), size)
    if slot.mask == (1 << 8 * size) - 1:
        return Number(slot, default, ">" if layout.byte_order == "big" else "<")
    if item.names:
        return BitEnumField(item.name, default, item.bits, dict(item.names))
    return (XBitField if item.base == 16 else BitField)(item.name, default, item.bits)


def put(header: bytes, layout: Layout, name: str, value: int) -> bytes:
    """Return a header with a field of whole bytes set; what does not fit is cut, as fuzzing may ask for."""
    slot = layout.by_name[name]
    raw = (value & slot.mask).to_bytes(slot.end - slot.start, layout.byte_order)
    return header[: slot.start] + raw + header[slot.end :]
