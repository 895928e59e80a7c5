"""A value held to the published schema of a command's JSON."""

from __future__ import annotations

import json
from functools import cache
from typing import TYPE_CHECKING, Any

from places import ROOT

if TYPE_CHECKING:
    from collections.abc import Sequence

KINDS = {
    "object": dict,
    "array": list,
    "string": str,
    "integer": int,
    "number": (int, float),
    "boolean": bool,
    "null": type(None),
}


@cache
def _names() -> list[str]:
    return [path.name.removesuffix(".schema.json") for path in (ROOT / "docs/schemas").iterdir()]


@cache
def published(name: str) -> dict[str, Any]:
    """Return a schema of ``docs/schemas``, as ``doctor``."""
    return json.loads((ROOT / f"docs/schemas/{name}.schema.json").read_text())


def held(value: Any, words: Sequence[str]) -> Any:
    """Hold what a command printed to the published schema whose title names most of its words; return it."""
    titles = (
        (title.split()[1:], name) for name in _names() for title in published(name)["title"].split(", ")
    )
    named = [(len(title), name) for title, name in titles if set(title) <= set(words)]
    assert named, f"no schema is that of {' '.join(words)}"
    check({key: item for key, item in value.items() if key != "settings"}, published(max(named)[1]))
    return value


def check(value: Any, root: dict[str, Any], schema: dict[str, Any] | None = None, path: str = "$") -> None:
    """Hold a value to the part of JSON Schema that the schemas use; names that they do not have fail."""
    schema = root if schema is None else schema
    if "$ref" in schema:
        file, _, name = schema["$ref"].partition("#/$defs/")
        root = published(file.removesuffix(".schema.json")) if file else root
        return check(value, root, root["$defs"][name], path)
    if "enum" in schema:
        assert value in schema["enum"], path
        return None
    kinds = schema["type"] if isinstance(schema["type"], list) else [schema["type"]]
    assert any(isinstance(value, KINDS[kind]) for kind in kinds), path
    assert not (isinstance(value, bool) and "boolean" not in kinds), path
    if isinstance(value, dict):
        required = set(schema.get("required", ()))
        assert required <= set(value), f"{path}: {required - set(value)}"
        known, others = schema.get("properties", {}), schema.get("additionalProperties")
        if others is True:
            return None
        assert others or set(value) <= set(known), f"{path}: {set(value) - set(known)}"
        for name, item in value.items():
            check(item, root, known.get(name) or others, f"{path}.{name}")
    if isinstance(value, list):
        for index, item in enumerate(value):
            check(item, root, schema["items"], f"{path}[{index}]")
    return None
