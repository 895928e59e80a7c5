"""cFE files: the header that all have, and the contents that core services and Data Storage write after it.

The headers of files and tables are big-endian on every processor. The contents are in the flight processor's
byte order, little-endian here.
"""

from __future__ import annotations

from typing import Final

from edoras_tools.wire.layout import Field, Layout

CFE_MAGIC: Final = b"cFE1"
"""The first field of every such file."""
RESET_LOG, SYSTEM_LOG, PERFORMANCE_LOG, TABLE_IMAGE, EVENT_LOG, STORED_PACKETS = 1, 2, 4, 8, 16, 10_000
RESET_COMMAND, EXCEPTION = 5, 6
"""Reset subtypes of entries that are made while cFE runs; the others are made when it starts."""
FILE_HEADER: Final = Layout(
    "cfe_file",
    "cFE File Header",
    Field("content_type", 32, "always cFE1", base=16),
    Field(
        "subtype",
        32,
        "what follows",
        names={
            RESET_LOG: "exception and reset log",
            SYSTEM_LOG: "system log",
            3: "applications",
            PERFORMANCE_LOG: "performance log",
            6: "critical data stores",
            TABLE_IMAGE: "table image",
            9: "table registry",
            15: "event filters of applications",
            EVENT_LOG: "event log",
            20: "software bus pipes",
            21: "software bus routes",
            22: "software bus message map",
            23: "tasks",
            STORED_PACKETS: "stored packets",
        },
    ),
    Field("header_length", 32, "bytes of this header"),
    Field("spacecraft_id", 32, "of the processor that wrote it", base=16),
    Field("processor_id", 32, "that wrote it"),
    Field("application_id", 32, "that wrote it", base=16),
    Field("seconds", 32, "mission time when it was made: whole seconds"),
    Field("subseconds", 32, "mission time: 1/2^32 s"),
    Field("description", 256, "what it says it is", kind="text"),
)
_SUBTYPES: Final = FILE_HEADER.by_name["subtype"].field.names or {}
STORAGE_HEADER: Final = Layout(
    "data_storage",
    "Data Storage File Header",
    Field("closed_seconds", 32, "mission time when it was closed: whole seconds"),
    Field("closed_subseconds", 32, "mission time: 1/2^32 s"),
    Field("destination", 16, "its entry in Data Storage's table of files"),
    Field("file_name_type", 16, "how its name was made", names={1: "by count", 2: "by time"}),
    Field("file_name", 512, "on board", kind="text"),
    byte_order="little",
)
"""The header after the file header of stored packets."""
OF_PACKETS: Final = {EVENT_LOG: FILE_HEADER.size, STORED_PACKETS: FILE_HEADER.size + STORAGE_HEADER.size}
"""Subtypes of files of packets, with the offset of the first packet."""
ON_TIME_LINE: Final = frozenset({*OF_PACKETS, RESET_LOG})
"""Subtypes of files whose packets or entries have times."""
TABLE_HEADER: Final = Layout(
    "cfe_table",
    "cFE Table Header",
    Field("reserved", 32, "always 0"),
    Field("load_offset", 32, "bytes of the table before the first that is loaded"),
    Field("load_bytes", 32, "bytes that are loaded"),
    Field("table_name", 320, "application and table", kind="text"),
)
"""The header after the file header of a table image."""
TO_SUBSCRIPTION: Final = Layout(
    "to_lab_subscription",
    "TO_LAB Subscription",
    Field("msg_id", 32, "0 from the first unused entry on", base=16),
    Field("priority", 8, "quality of service"),
    Field("reliability", 8, "quality of service"),
    Field("message_limit", 16, "messages of it that may wait in TO's pipe"),
    byte_order="little",
)
"""An entry of Telemetry Output's table."""
SBN_MODULES, SBN_PEERS = 8, 16
"""Number of entries in SBN's table, used or not, in SBN's default configuration."""
SBN_FILTERS: Final = 8
"""Number of filter names of a peer."""
SBN_NAME_BYTES: Final = 16
SBN_MODULE: Final = Layout(
    "sbn_module",
    "SBN Module",
    Field("name", 8 * SBN_NAME_BYTES, "that peers name", kind="text"),
    Field("library", 512, "the file it is loaded from", kind="text"),
    Field("symbol", 160, "where it begins", kind="text"),
    Field("base_event_id", 16, "of its events"),
    byte_order="little",
)
"""A protocol or a filter in SBN's table."""
SBN_PEER: Final = Layout(
    "sbn_peer",
    "SBN Peer",
    Field("processor_id", 32, "ProcessorID of the peer"),
    Field("spacecraft_id", 32, "SpacecraftID of the peer"),
    Field("net", 8, "peers of one net have one protocol"),
    Field("protocol", 8 * SBN_NAME_BYTES, "name of a module", kind="text"),
    *(
        Field(f"filter_{place}", 8 * SBN_NAME_BYTES, "name of a module", kind="text")
        for place in range(SBN_FILTERS)
    ),
    Field("address", 384, "as the module understands it: HOST:PORT", kind="text"),
    Field("spare", 24, "alignment", kind="bytes"),
    Field(
        "task_flags",
        32,
        "tasks of its own",
        names={0: "none", 1: "to send", 2: "to receive", 3: "to send and receive"},
    ),
    byte_order="little",
)
"""A peer in SBN's table; the cFS itself is one of them."""
SBN_COUNT: Final = Layout(
    "sbn_count", "SBN Count", Field("modules", 8, "in use"), Field("spare", 8, "alignment")
)
"""The count after the protocols, and after the filters."""
SBN_PEER_COUNT: Final = Layout(
    "sbn_peer_count",
    "SBN Peer Count",
    Field("peers", 16, "in use"),
    Field("spare", 16, "alignment"),
    byte_order="little",
)
"""The count after the peers."""
RESET_ENTRY: Final = Layout(
    "cfe_reset",
    "cFE Exception or Reset",
    Field("entry_type", 32, "who made it", names={1: "core", 2: "application"}),
    Field("reset_type", 32, "kind of reset", names={1: "processor", 2: "power on"}),
    Field(
        "reset_subtype",
        32,
        "what caused it",
        names={
            1: "power cycle",
            2: "push button",
            3: "hardware special command",
            4: "watchdog",
            RESET_COMMAND: "reset command",
            EXCEPTION: "exception",
            7: "undefined",
            8: "hardware debugging",
            9: "bank switch",
        },
    ),
    Field("boot_source", 32, "where it booted from"),
    Field("processor_resets", 32, "since the last power-on"),
    Field("max_processor_resets", 32, "before a power-on reset is made"),
    Field("debug", 128, "debug variables of Executive Services", kind="bytes"),
    Field("seconds", 32, "mission time: whole seconds"),
    Field("subseconds", 32, "mission time: 1/2^32 s"),
    Field("description", 640, "what happened", kind="text"),
    Field("context_bytes", 32, "bytes of the context that are valid"),
    Field("application_id", 32, "0 for none", base=16),
    Field("context", 2048, "of the processor", kind="bytes"),
    byte_order="little",
)
"""An entry of the exception and reset log, with the usual 256 bytes of context."""
PERFORMANCE: Final = Layout(
    "cfe_performance",
    "cFE Performance Log",
    Field("version", 8, "of the format"),
    Field("endian", 8, "of the log", names={0: "little", 1: "big"}),
    Field("spare", 16, "alignment"),
    Field("ticks_per_second", 32, "of the timer"),
    Field("rollover", 32, "ticks of the lower half until the upper half counts one; 0: 2^32"),
    Field("state", 32, "when it was written", names={0: "idle", 1: "waiting", 2: "triggered"}),
    Field("mode", 32, "where the trigger lies", names={0: "start", 1: "center", 2: "end"}),
    Field("trigger_count", 32, "triggers seen"),
    Field("data_start", 32, "first entry in the buffer"),
    Field("data_end", 32, "last entry in the buffer"),
    Field("data_count", 32, "entries"),
    Field("invalid_markers", 32, "whether a marker out of range was reported"),
    Field("mask_words", 32, "words of each of the two masks that follow"),
    byte_order="little",
)
MARKER: Final = Layout(
    "cfe_performance_marker",
    "cFE Performance Marker",
    Field("marker", 32, "number of the marker; the highest bit is set at its exit", base=16),
    Field("upper", 32, "timer, upper half"),
    Field("lower", 32, "timer, lower half"),
    byte_order="little",
)
EXIT: Final = 1 << 31
"""Bit of ``marker`` for an exit: the code that the marker measures was left."""


def kind_of(subtype: int) -> str:
    """Return the kind of a file by its subtype, such as ``table image``."""
    return _SUBTYPES.get(subtype, f"file of subtype {subtype}")
