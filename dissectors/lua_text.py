"""Python values as Lua source."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping

_SHORT = 100
"""Columns up to which a table stays on one line."""


def literal(value: Any, depth: int = 0) -> str:
    """Return a value as a Lua expression: tables of several lines are indented by ``depth`` tabs.

    Args:
        value: None, bool, int, float, str, or a list, tuple or dict of such; dict keys are int or str, and
            entries whose value is None are left out.
        depth: tabs in front of the closing brace.
    """
    if value is None or isinstance(value, bool):
        return {None: "nil", True: "true", False: "false"}[value]
    if isinstance(value, (int, float)):
        return repr(value)
    if isinstance(value, str):
        return quoted(value)
    if isinstance(value, dict):
        items = [f"{_key(key)}{literal(item, depth + 1)}" for key, item in _sorted(value).items()]
    else:
        items = [literal(item, depth + 1) for item in value]
    line = f"{{{', '.join(items)}}}"
    if len(line) + 4 * depth <= _SHORT and "\n" not in line:
        return line
    tabs = "\t" * (depth + 1)
    return "{\n" + "".join(f"{tabs}{item},\n" for item in items) + "\t" * depth + "}"


def quoted(text: str) -> str:
    """Return text as a Lua string; any character is safe in it."""
    out = []
    for octet in text.encode():
        character = chr(octet)
        plain = " " <= character <= "~" and character not in '"\\'
        out.append(character if plain else f"\\{octet:03d}")
    return '"' + "".join(out) + '"'


def _key(key: int | str) -> str:
    if isinstance(key, int):
        return f"[{key}] = "
    return f"{key} = " if key.isidentifier() and key not in _RESERVED else f"[{quoted(key)}] = "


def _sorted(values: Mapping[Any, Any]) -> dict[Any, Any]:
    """Return a dict without its Nones; numbered entries in order, so that the text is stable."""
    kept = {key: item for key, item in values.items() if item is not None}
    return dict(sorted(kept.items())) if all(isinstance(key, int) for key in kept) else kept


_RESERVED = frozenset(
    {"and", "break", "do", "else", "elseif", "end", "false", "for", "function", "goto", "if", "in", "local"}
    | {"nil", "not", "or", "repeat", "return", "then", "true", "until", "while"}
)
