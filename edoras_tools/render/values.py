"""Decoded values as text, cut where they are long."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import islice
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from edoras_tools.model import LayerField

_MOST_ITEMS: Final = 64
_MOST_BYTES: Final = 32
_MOST_TEXT: Final = 1024


def field_text(item: LayerField) -> str:
    """Return a field's value: its text where it has one, the plain number behind it in brackets.

    The result is not yet safe for a terminal: see :func:`edoras_tools.render.terminal.text.clean`.
    """
    plain = value_text(item.value)
    if not item.text or item.text == plain or isinstance(item.value, str):
        return plain
    if isinstance(item.value, bytes):
        return plain if item.text == item.value.hex() else item.text
    # One word is the number in another base; a text of several words has said what the number means.
    return f"{item.text} ({plain})" if isinstance(item.value, int) and " " not in item.text else item.text


def value_text(value: Any) -> str:
    """Return a plain value on one line; long lists, bytes and texts are cut and say how long they are."""
    match value:
        case str():
            cut = f'"{value[:_MOST_TEXT]}"'
            return cut if len(value) <= _MOST_TEXT else f"{cut}… ({len(value):,} characters)"
        case bool():
            return "true" if value else "false"
        case bytes() | bytearray() | memoryview():
            data = bytes(value[:_MOST_BYTES])
            return data.hex(" ") if len(value) <= _MOST_BYTES else f"{data.hex(' ')} … ({len(value):,} bytes)"
        case Mapping():
            inside = ", ".join(
                f"{name}: {value_text(item)}" for name, item in islice(value.items(), _MOST_ITEMS)
            )
            return (
                f"{{{inside}}}" if len(value) <= _MOST_ITEMS else f"{{{inside}, …}} ({len(value):,} entries)"
            )
        case Sequence():
            inside = ", ".join(value_text(item) for item in islice(value, _MOST_ITEMS))
            return f"[{inside}]" if len(value) <= _MOST_ITEMS else f"[{inside}, …] ({len(value):,} items)"
        case _:
            return str(value)
