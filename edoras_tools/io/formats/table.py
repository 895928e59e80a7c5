"""The table of all formats of captures and recordings: name, suffix, reader and writer.

A file is read by its content, and written by its suffix. A new format needs its folder and a line here.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.older import StrEnum

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path


@dataclass(frozen=True, slots=True)
class Format:
    """One format.

    Attributes:
        name: for the user.
        suffix: of its files; empty for a directory, which needs an option.
        reader: its source class, as ``folder:class`` of this folder; for rosbag2 the class that reads
            messages; empty if the format is only written.
        writer: its sink class, as ``folder:class``.
        messages: whether its sink also writes messages by topic, and can be split.
    """

    name: str
    suffix: str
    reader: str
    writer: str
    messages: bool = False

    def source(self) -> Any:
        """Return the class of ``reader``; imported on use, because that takes time."""
        return _class(self.reader, "reader")

    def sink(self) -> Any:
        """Return the class of ``writer``; imported on use."""
        return _class(self.writer, "writer")


PCAP: Final = Format("pcap", ".pcap", "pcap:PcapSource", "pcap:PcapSink")
PCAPNG: Final = Format("pcapng", ".pcapng", "pcapng:PcapngSource", "pcapng:PcapngSink")
MCAP: Final = Format("MCAP", ".mcap", "mcap:McapSource", "mcap:McapSink", messages=True)
ROSBAG2: Final = Format("rosbag2", "", "rosbag2:Rosbag", "rosbag2:Rosbag2Sink", messages=True)
CFE: Final = Format("cFE file", "", "cfe:CfePacketSource", "")

FILE_FORMATS: Final = (PCAP, PCAPNG, MCAP, ROSBAG2)

TABLE_FORMATS: Final = (
    Format("Parquet", ".parquet", "", "arrow:ParquetWriter"),
    Format("Arrow", ".arrow", "", "arrow:ArrowWriter"),
    Format("CSV", ".csv", "", "csv:CsvWriter"),
    Format("JSON Lines", ".jsonl", "", "jsonl:JsonLinesWriter"),
)
"""Tables of the messages of a topic, which are only written; their writers are ``TableWriter``."""


class TimeForm(StrEnum):
    """How the times of messages are written; those inside messages stay as they are."""

    UTC = "utc"
    NS = "ns"
    SECONDS = "seconds"


def written_as(path: Path, among: Sequence[Format] = FILE_FORMATS) -> Format | None:
    """Return the format of a file's suffix; None if it is not among these formats."""
    suffix = path.suffix.lower()
    return next((item for item in among if suffix and item.suffix == suffix), None)


def _listed(names: list[str], last: str) -> str:
    return f"{', '.join(names[:-1])} {last} {names[-1]}"


READ: Final = _listed([item.name for item in FILE_FORMATS if item.suffix], "or")
"""The formats that can be read, for the user: ``pcap, pcapng or MCAP``."""
READ_PACKED: Final = f"{READ.replace(' or', ',')} (.gz, .zst) or rosbag2"
"""The same, with how they may be packed, and the directories of rosbag2."""
READABLE: Final = READ.replace(" or ", " and ")
TOPIC_READERS: Final = "info, sniff, record, live, export, plot and check read its topics"
"""What to do with a recording of topics where datagrams are needed."""
FILE_SUFFIXES: Final = [item.suffix for item in reversed(FILE_FORMATS) if item.suffix]
WRITTEN: Final = _listed(FILE_SUFFIXES, "or")
"""The suffixes of outputs, for the user: ``.mcap, .pcapng or .pcap``."""
TABLES_WRITTEN: Final = _listed([item.suffix for item in TABLE_FORMATS], "or")
"""The suffixes of tables, for the user."""


def _class(where: str, role: str) -> Any:
    folder, _, name = where.partition(":")
    return getattr(import_module(f"edoras_tools.io.formats.{folder}.{role}"), name)
