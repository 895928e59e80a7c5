"""The table of all formats of captures and recordings: name, suffix, reader and writer.

A file is read by its content, and written by its suffix. A new format needs its folder or file and a line
here; a format of another package needs an entry point ``edoras.formats``, which is consulted where no line
fits.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

from edoras_tools import doors
from edoras_tools.older import StrEnum

if TYPE_CHECKING:
    from pathlib import Path


LONGEST_MAGIC: Final = 8
"""Longest magic number that identifies a format, in bytes."""


class Format(NamedTuple):
    """One format.

    Attributes:
        name: name for the user.
        suffix: suffix of its files; empty for a directory, which needs an option.
        reader: location of the source class: ``module:class``, ``.module:class`` in this folder, or
            ``part/name:class`` in an add-on; rosbag2's reads messages; empty if the format is only written.
        writer: location of the sink class or ``TableWriter``; empty if the format is only read.
        messages: whether the sink also writes messages by topic, and can split files.
        table: whether it is a table of the messages of a topic, and is only written.
        magic: first bytes of the files, at most 8, of a readable format of another package, whose source
            takes a ``Window``.
    """

    name: str
    suffix: str
    reader: str
    writer: str
    messages: bool = False
    table: bool = False
    magic: bytes = b""

    def source(self) -> Any:
        """Return the class of ``reader``; imported on use, because that takes time."""
        return _imported(self.reader)

    def sink(self) -> Any:
        """Return the class of ``writer``; imported on use."""
        return _imported(self.writer)


PCAP: Final = Format("pcap", ".pcap", ".pcap:PcapSource", ".pcap:PcapSink")
PCAPNG: Final = Format("pcapng", ".pcapng", ".pcapng:PcapngSource", ".pcapng:PcapngSink")
MCAP: Final = Format("MCAP", ".mcap", ".mcap.reader:McapSource", ".mcap.writer:McapSink", messages=True)
ROSBAG2: Final = Format("rosbag2", "", ".rosbag2.reader:Rosbag", ".rosbag2.writer:Rosbag2Sink", messages=True)
CFE: Final = Format("cFE file", "", ".cfe:CfePacketSource", "")

FILE_FORMATS: Final = (PCAP, PCAPNG, MCAP, ROSBAG2)

TABLE_FORMATS: Final = (
    Format("Parquet", ".parquet", "", "part/arrow_tables:ParquetWriter", table=True),
    Format("Arrow", ".arrow", "", "part/arrow_tables:ArrowWriter", table=True),
    Format("CSV", ".csv", "", ".columns:CsvWriter", table=True),
    Format("JSON Lines", ".jsonl", "", ".columns:JsonLinesWriter", table=True),
)
"""Tables of the messages of a topic, which are only written; their writers are ``TableWriter``."""


class TimeForm(StrEnum):
    """How the times of messages are written; those inside messages stay as they are."""

    UTC = "utc"
    NS = "ns"
    SECONDS = "seconds"


def written_as(path: Path, *, table: bool = False) -> Format | None:
    """Return the format that a file's suffix names, of recordings or of tables; None if none fits.

    Raises:
        ConfigError: a format of an installed package cannot be loaded.
    """
    suffix = path.suffix.lower()
    if not suffix:
        return None
    for item in TABLE_FORMATS if table else FILE_FORMATS:
        if item.suffix == suffix:
            return item
    return next((item for item in installed_formats() if (item.suffix, item.table) == (suffix, table)), None)


def installed_formats() -> list[Format]:
    """Return the formats that installed packages add.

    Raises:
        ConfigError: one cannot be loaded, or is not a ``Format``.
    """
    formats = []
    for item in doors.installed("formats"):
        loaded = item.load()
        if not isinstance(loaded, Format) or len(loaded.magic) > LONGEST_MAGIC:
            raise item.error(f"{item.place} is not an object of Format, with at most 8 bytes of magic")
        formats.append(loaded)
    return formats


def _listed(names: list[str], last: str) -> str:
    return f"{', '.join(names[:-1])} {last} {names[-1]}"


READ: Final = _listed([item.name for item in FILE_FORMATS if item.suffix], "or")
"""The formats that can be read, for the user: ``pcap, pcapng or MCAP``."""
READ_PACKED: Final = f"{READ.replace(' or', ',')} (.gz, .zst) or rosbag2"
"""The same formats, with the compressions, and rosbag2's directories."""
READABLE: Final = READ.replace(" or ", " and ")
TOPIC_READERS: Final = "info, sniff, record, live, export, plot and check read its topics"
"""Text for the user of a recording of topics where datagrams are needed."""
FILE_SUFFIXES: Final = [item.suffix for item in reversed(FILE_FORMATS) if item.suffix]
WRITTEN: Final = _listed(FILE_SUFFIXES, "or")
"""The suffixes of outputs, for the user: ``.mcap, .pcapng or .pcap``."""
TABLES_WRITTEN: Final = _listed([item.suffix for item in TABLE_FORMATS], "or")
"""The suffixes of tables, for the user."""


def _imported(place: str) -> Any:
    if place.startswith("part/"):
        name, _, written = place.removeprefix("part/").partition(":")
        return getattr(doors.part(name), written)
    return doors.imported(f"edoras_tools.io.formats{place}" if place.startswith(".") else place)
