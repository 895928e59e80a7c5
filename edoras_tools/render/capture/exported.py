"""What ``edoras export`` and ``edoras files`` found and wrote."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from edoras_tools.render import units
from edoras_tools.render.terminal.text import clean
from edoras_tools.wire.cfdp import Checksum
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

_HEAD: Final = ("from", "to", "file", "bytes", "captured", "pieces", "resent", "filled", "NAKs", "end")


def exported_lines(summary: Mapping[str, Any]) -> Iterator[str]:
    """Yield a line for each file of a report in the shape of ``export --json``."""
    for item in summary["files"]:
        kind = f", {item['type']}" if item["type"] else ""
        yield clean(f"{item['path']}: {plural(item['rows'], 'row')} of {item['topic']}{kind}")


def files_lines(report: Mapping[str, Any]) -> Iterator[str]:
    """Yield a line for each transaction, then where its file is if its name was refused.

    Args:
        report: as ``files --json`` prints it.
    """
    rows = [_HEAD, *map(_row, report["transactions"])]
    if len(rows) == 1:
        yield "no CFDP transaction"
        yield from _not_taken(report)
        return
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    left_aligned = {0, 1, 2, len(_HEAD) - 1}
    for row in rows:
        cells = (
            text.ljust(width) if index in left_aligned else text.rjust(width)
            for index, (text, width) in enumerate(zip(row, widths, strict=True))
        )
        yield clean("  ".join(cells).rstrip())
    for item in report["transactions"]:
        if item["refused"] and item["path"]:
            name = item["destination_file_name"] or item["source_file_name"]
            yield clean(f"the name {name!r} is refused: written to {item['path']}")
    yield from _not_taken(report)


def _not_taken(report: Mapping[str, Any]) -> Iterator[str]:
    if report["corrupt"]:
        yield f"{plural(report['corrupt'], 'PDU')} with a wrong CRC not taken"
    if report["left_out"]:
        yield f"{units.count(report['left_out'])} PDUs of further transactions are left out"


def _row(item: Mapping[str, Any]) -> tuple[str, ...]:
    name = item["destination_file_name"] or item["source_file_name"]
    end = item["state"] + (", wrong checksum" if item["checksum_right"] is False else "")
    kind = item["checksum_type"]
    end += "" if kind is None or kind in set(Checksum) else f", checksum of unknown type {kind}"
    counts = (item["file_size"], *(item[key] for key in ("received", "segments", "resent", "filled", "naks")))
    return (
        f"{item['source_entity_id']}:{item['transaction_sequence_number']}",
        str(item["destination_entity_id"]),
        "-" if name is None else name,
        *("-" if value is None else units.count(value) for value in counts),
        end,
    )
