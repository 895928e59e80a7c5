"""JSON and CSV on standard output."""

from __future__ import annotations

import csv
import json
import sys
from typing import TYPE_CHECKING, Any

from edoras_tools.cli.settings import in_effect

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence


def print_json(value: Mapping[str, Any]) -> None:
    """Print one JSON object, as ``docs/schemas`` describe it.

    ``schema`` is the version of its shape, 1 unless the value has another one; ``settings`` is the path of
    the settings file, if there is one.
    """
    file = in_effect()
    value = {"schema": 1, **value} | ({"settings": str(file.path)} if file else {})
    sys.stdout.write(json.dumps(value, indent=2, ensure_ascii=False) + "\n")


def print_csv(rows: Sequence[Mapping[str, Any]]) -> None:
    """Print rows with the same keys as CSV with a header; lists and maps as JSON, None as an empty field."""
    if rows:
        write_csv(list(rows[0]), (list(row.values()) for row in rows))


def write_csv(names: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Print rows below the names of their columns, as ``print_csv`` does."""
    writer = csv.writer(sys.stdout)
    writer.writerow(names)
    for row in rows:
        writer.writerow(
            json.dumps(value, ensure_ascii=False) if isinstance(value, dict | list) else value
            for value in row
        )
