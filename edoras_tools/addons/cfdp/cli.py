"""``edoras files``: the files that CFDP transferred."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Final

from typer import Option

from edoras_tools.cli import options
from edoras_tools.cli.inputs import FileOptions, InputOptions, open_input
from edoras_tools.cli.options import grouped
from edoras_tools.cli.output import end, file_progress, lost, no_datagrams, print_json
from edoras_tools.render.terminal.text import clean
from edoras_tools.words import count, plural

_HEAD: Final = ("from", "to", "file", "bytes", "captured", "pieces", "resent", "filled", "NAKs", "end")


@grouped
def files(
    *,
    inputs: FileOptions,
    output: Annotated[Path | None, Option("--output", "-o", help="Write them to a new or empty DIR.")] = None,
    printing: options.PrintOptions,
    part: options.PartOptions,
    filters: options.SelectionOptions,
    decoding: options.DecodingOptions,
) -> None:
    """Show the files that CFDP transferred, or take them out.

    Names of files that would lie outside DIR are refused.
    """
    from edoras_tools.addons.cfdp.taking import take_out

    paths = inputs.required()
    limits, quiet = part.limits(paths), printing.quiet or printing.json
    with file_progress(paths, quiet=quiet) as bar:
        source, bench = open_input(InputOptions(inputs), decoding.settings())
        report = take_out(source, bench, output, selection=filters.selection(), limits=limits, progress=bar)
    if report.failure is None:
        no_datagrams(source)
    if printing.json:
        print_json(report.summary())
    elif not printing.quiet:
        sys.stdout.writelines(f"{line}\n" for line in _lines(report.summary()))
    end(failure=report.failure, lost=not all(item.good for item in report.files))
    lost(source)


def _lines(report: Mapping[str, Any]) -> Iterator[str]:
    """Yield a line for each transaction, and the path of its file if its name was refused.

    Args:
        report: report in the shape of ``files --json``.
    """
    transactions = report["transactions"]
    rows = [_HEAD, *map(_row, transactions)] if transactions else []
    if not rows:
        yield "no CFDP transaction"
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    left_aligned = {0, 1, 2, len(_HEAD) - 1}
    for row in rows:
        cells = (
            text.ljust(width) if index in left_aligned else text.rjust(width)
            for index, (text, width) in enumerate(zip(row, widths, strict=True))
        )
        yield clean("  ".join(cells).rstrip())
    for item in transactions:
        if item["refused"] and item["path"]:
            name = item["destination_file_name"] or item["source_file_name"]
            yield clean(f"the name {name!r} is refused: written to {item['path']}")
    if report["corrupt"]:
        yield f"{plural(report['corrupt'], 'PDU')} with a wrong CRC not taken"
    if report["left_out"]:
        yield f"{count(report['left_out'])} PDUs of further transactions are left out"


def _row(item: Mapping[str, Any]) -> tuple[str, ...]:
    from edoras_tools.addons.cfdp.link import Checksum

    name = item["destination_file_name"] or item["source_file_name"]
    end = item["state"] + (", wrong checksum" if item["checksum_right"] is False else "")
    kind = item["checksum_type"]
    end += "" if kind is None or kind in set(Checksum) else f", checksum of unknown type {kind}"
    counts = (item["file_size"], *(item[key] for key in ("received", "segments", "resent", "filled", "naks")))
    return (
        f"{item['source_entity_id']}:{item['transaction_sequence_number']}",
        str(item["destination_entity_id"]),
        "-" if name is None else name,
        *("-" if value is None else count(value) for value in counts),
        end,
    )
