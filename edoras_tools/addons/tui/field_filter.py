"""The filter for a selected field."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from edoras_tools.model import Decoded
    from edoras_tools.render.capture.tree import TreeRow


def filter_of(decoded: Decoded, row: TreeRow) -> str:
    """Return the filter for packets with the same value as a row of the tree; empty if there is none.

    For a layer, return the filter for packets that have this layer.
    """
    for layer in decoded.layers:
        if row.role == "layer" and (layer.start, layer.end, layer.title) == (row.start, row.end, row.label):
            return layer.name
        for item in layer.fields:
            if row.role != "field" or (item.start, item.end) != (row.start, row.end):
                continue
            if item.name == row.label or item.name.endswith(f".{row.label}"):
                value = _constant(item.value, item.text)
                return f"{layer.name}.{item.name} == {value}" if value else ""
    return ""


def _constant(value: Any, text: str) -> str:
    match value:
        case bool():
            return "true" if value else "false"
        case int():
            return text.partition(" ")[0] if text.startswith("0x") else str(value)
        case float():
            return repr(value) if math.isfinite(value) else ""
        case str():
            escaped = value.replace("\\", "\\\\").replace('"', '\\"')
            return f'"{escaped}"' if value.isprintable() else ""
        case _:
            return ""
