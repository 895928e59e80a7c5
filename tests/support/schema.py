"""A value held to the published schema of a command's JSON."""

from __future__ import annotations

import json
from typing import Any

from places import ROOT

KINDS = {
    "object": dict,
    "array": list,
    "string": str,
    "integer": int,
    "number": (int, float),
    "boolean": bool,
    "null": type(None),
}


def published(name: str) -> dict[str, Any]:
    """Return a schema of ``docs/schemas``, as ``doctor``."""
    return json.loads((ROOT / f"docs/schemas/{name}.schema.json").read_text())


def check(value: Any, root: dict[str, Any], schema: dict[str, Any] | None = None, path: str = "$") -> None:
    """Hold a value to the part of JSON Schema that the schemas use; names that they do not have fail."""
    schema = root if schema is None else schema
    if "$ref" in schema:
        return check(value, root, root["$defs"][schema["$ref"].rpartition("/")[2]], path)
    if "enum" in schema:
        assert value in schema["enum"], path
        return None
    kinds = schema["type"] if isinstance(schema["type"], list) else [schema["type"]]
    assert any(isinstance(value, KINDS[kind]) for kind in kinds), path
    assert not (isinstance(value, bool) and "boolean" not in kinds), path
    if isinstance(value, dict):
        assert set(schema["required"]) <= set(value), path
        known, others = schema.get("properties", {}), schema.get("additionalProperties")
        assert others or set(value) <= set(known), f"{path}: {set(value) - set(known)}"
        for name, item in value.items():
            check(item, root, known.get(name) or others, f"{path}.{name}")
    if isinstance(value, list):
        for index, item in enumerate(value):
            check(item, root, schema["items"], f"{path}[{index}]")
    return None
