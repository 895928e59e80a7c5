"""Checks a recovered file by reading it as readers will: by its index, and with the ``mcap`` library."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Final

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Chunk, Message
from mcap.stream_reader import breakup_chunk
from msgspec.structs import replace

from edoras_tools.errors import CaptureError, os_errors
from edoras_tools.io.formats.mcap.index import RECORD_HEAD
from edoras_tools.io.formats.mcap.messages import chunk_content

if TYPE_CHECKING:
    from pathlib import Path

    from edoras_tools.io.formats.mcap.recovery.report import Recovery

_BY_LIBRARY: Final = 20_000
"""Approximate number of messages to read with the ``mcap`` library too: it takes some 40 us for each."""


def read_again(path: Path, report: Recovery) -> Recovery:
    """Return the report of a recovery, with a reason added if readers do not find all messages.

    Every message is read along the index, and whole chunks, evenly spread, by the ``mcap`` library.

    Raises:
        CaptureError: the file cannot be opened.
    """
    expected, read, refusal = Counter(report.messages), Counter[str](), ""
    with os_errors(f"{path}: cannot be read"), path.open("rb") as file:
        try:
            summary = make_reader(file).get_summary()
            assert summary is not None, "it has just been written"
            step = 1 + expected.total() // _BY_LIBRARY
            for number, index in enumerate(summary.chunk_indexes):
                counts = Counter(chunk_content(file, path.name, index, summary.channels).channel_id.tolist())
                for channel, count in counts.items():
                    read[summary.channels[channel].topic] += count
                if number % step == 0 and counts.total() <= _BY_LIBRARY:
                    file.seek(index.chunk_start_offset + RECORD_HEAD.size)
                    records = breakup_chunk(Chunk.read(ReadDataStream(file)), validate_crc=True)
                    again = Counter(item.channel_id for item in records if isinstance(item, Message))
                    refusal = refusal if again == counts else "the mcap library finds other messages in it"
        except (CaptureError, McapError, EOFError, ValueError) as error:
            refusal = str(error)
    if read != expected and not refusal:
        refusal = f"its index leads to {read.total():,} of {expected.total():,} messages"
    if not refusal:
        return report
    return replace(report, lost=True, reasons=[*report.reasons, f"of the result: {refusal}"])
