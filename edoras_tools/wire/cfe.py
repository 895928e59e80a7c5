"""cFE's formats: headers after the primary header, the checksum, telemetry with loss counters, and files.

Headers are big-endian, also those of files and tables, on every processor. The contents of telemetry and
files are in the flight processor's order, little-endian here.
"""

from __future__ import annotations

import re
from datetime import datetime
from functools import cache
from typing import TYPE_CHECKING, Any, Final, Literal

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.errors import ConfigError, FieldError
from edoras_tools.older import UTC
from edoras_tools.wire import ccsds
from edoras_tools.wire.ccsds import VERSION_1, VERSION_2, MsgIds
from edoras_tools.wire.layout import Field, Layout

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.wire.arrays import Octets

HIGHEST_MSG_ID: Final = 0x1FFF
"""cFE refuses a larger MsgId (CFE_PLATFORM_SB_HIGHEST_VALID_MSGID)."""
CHECKSUM_SEED: Final = 0xFF
EPOCH_S: Final = 315_532_800
"""Usual epoch of mission time, 1980-01-01, in seconds since 1970; consoles print mission time from it."""
USUAL_TICKS: Final = 1 << 16
_MISSION_TIME: Final = r"(?:(big|little)(?:, |$))?(?:1/(\d{1,5}) s(?:, |$))?(?:since (\S+))?"

COMMAND: Final = Layout(
    "cfe_command",
    "cFE Command Header",
    Field("reserved", 1, "always 0"),
    Field("function_code", 7, "EDORAS apps: 0 no-op, 1 set"),
    Field(
        "checksum", 8, "0xFF XOR every byte of the packet; the bridges send 0, no app here checks it", base=16
    ),
)
TELEMETRY: Final = Layout(
    "cfe_telemetry",
    "cFE Telemetry Header",
    Field("seconds", 32, "mission time: whole seconds since the mission's epoch, not UTC"),
    Field("subseconds", 16, "mission time: 1/65536 s"),
    Field("spare", 32, "alignment", kind="bytes"),
)
TELEMETRY_SHORT: Final = Layout(
    "cfe_telemetry",
    "cFE Telemetry Header (12 bytes, older builds)",
    *(slot.field for slot in TELEMETRY.slots[:2]),
)
COMMAND_EXTENDED: Final = Layout(
    "cfe_command",
    "cFE Command Header (behind an extended header)",
    *(slot.field for slot in COMMAND.slots),
    Field("spare", 32, "alignment", kind="bytes"),
)
TELEMETRY_EXTENDED: Final = Layout(
    "cfe_telemetry",
    "cFE Telemetry Header (behind an extended header)",
    *(slot.field for slot in TELEMETRY.slots[:2]),
)
EXTENDED: Final = Layout(
    "cfe_extended",
    "cFE Extended Header",
    Field("eds_version", 5, "electronic data sheet version"),
    Field("endian", 1, "payload byte order", names={0: "big", 1: "little"}),
    Field("playback", 1, "a recorded packet sent again", names={0: "original", 1: "playback"}),
    Field("subsystem_id", 9, "APID qualifier: subsystem", base=16),
    Field("system_id", 16, "APID qualifier: system or spacecraft", base=16),
)
EVENT: Final = Layout(
    "cfe_event",
    "cFE Event (EVS long format)",
    Field("app_name", 160, "who reports", kind="text"),
    Field("event_id", 16, "the app's number for it"),
    Field("event_type", 16, "severity", names={1: "debug", 2: "info", 3: "error", 4: "critical"}),
    Field("spacecraft_id", 32, "where", base=16),
    Field("processor_id", 32, "on which processor"),
    Field("message", 976, "what happened", kind="text"),
    Field("spare", 16, "alignment", kind="bytes"),
    byte_order="little",
)
"""Payload of telemetry 0x0808."""
SOFTWARE_BUS_HOUSEKEEPING: Final = Layout(
    "cfe_software_bus",
    "cFE Software Bus Housekeeping",
    Field("command_counter", 8, "ground commands accepted"),
    Field("command_error_counter", 8, "ground commands refused"),
    Field("no_subscribers_counter", 8, "messages sent that nobody takes"),
    Field("message_send_error_counter", 8, "sends that failed"),
    Field("message_receive_error_counter", 8, "receives that failed"),
    Field("internal_error_counter", 8, "queue reads and writes that failed"),
    Field("create_pipe_error_counter", 8, "pipes that could not be made"),
    Field("subscribe_error_counter", 8, "subscriptions that failed"),
    Field("pipe_options_error_counter", 8, "pipe options that failed"),
    Field("duplicate_subscriptions_counter", 8, "subscriptions made twice"),
    Field("get_pipe_id_by_name_error_counter", 8, "pipe names not found"),
    Field("spare", 8, "alignment"),
    Field("pipe_overflow_error_counter", 16, "messages lost because a pipe was full"),
    Field("message_limit_error_counter", 16, "messages lost because too many of one MsgId waited in a pipe"),
    Field("memory_pool_handle", 32, "the pool's handle", base=16),
    Field("memory_in_use", 32, "bytes of the pool in use"),
    Field("unmarked_memory", 32, "bytes of the pool never used"),
    byte_order="little",
)
"""Payload of telemetry 0x0803."""
COMMAND_INGEST_HOUSEKEEPING: Final = Layout(
    "ci_lab_housekeeping",
    "CI_LAB Housekeeping",
    Field("command_error_counter", 8, "commands to CI itself refused"),
    Field("command_counter", 8, "commands to CI itself accepted"),
    Field("checksums_enabled", 8, "whether it checks checksums"),
    Field("socket_connected", 8, "whether its socket is open"),
    Field("spare", 64, "alignment", kind="bytes"),
    Field("ingest_packets", 32, "datagrams accepted"),
    Field("ingest_errors", 32, "datagrams refused"),
    Field("spare2", 32, "alignment"),
    byte_order="little",
)
"""Payload of CI_LAB's telemetry 0x0884."""
COMMAND_INGEST_HOUSEKEEPING_7: Final = Layout(
    "ci_lab_housekeeping_7",
    "CI_LAB Housekeeping (cFS 7)",
    Field("command_counter", 8, "commands to CI itself accepted"),
    Field("command_error_counter", 8, "commands to CI itself refused"),
    Field("checksums_enabled", 8, "whether it checks checksums"),
    Field("socket_connected", 8, "whether its socket is open"),
    Field("ingest_packets", 32, "datagrams accepted"),
    Field("ingest_errors", 32, "datagrams refused"),
    byte_order="little",
)
"""The same payload in cFS 7, which is recognised by its length."""
TELEMETRY_OUTPUT_HOUSEKEEPING: Final = Layout(
    "to_lab_housekeeping",
    "TO_LAB Housekeeping",
    Field("command_counter", 8, "commands to TO itself accepted"),
    Field("command_error_counter", 8, "commands to TO itself refused"),
    Field("spare", 16, "alignment"),
    byte_order="little",
)
"""Payload of TO_LAB's telemetry 0x0880."""


class MissionTime(msgspec.Struct, frozen=True):
    """The format of mission time in telemetry headers; a part that is None is unknown, and read as usual.

    Attributes:
        byte_order: byte order of both words; usually big.
        ticks: subseconds in a second; usually 65,536.
        epoch_s: begin of mission time, s since 1970 UTC; usually :data:`EPOCH_S`.
    """

    byte_order: Literal["big", "little"] | None = None
    ticks: int | None = None
    epoch_s: int | None = None

    @classmethod
    def of_text(cls, text: str) -> MissionTime:
        """Read ``little, 1/1000 s, since 2000-01-01T12:00``, or some of its parts.

        Raises:
            ConfigError: the text has another form.
        """
        match, moment = re.fullmatch(_MISSION_TIME, text), None
        parts: Any = match.groups() if match else (None, "0", None)
        order, ticks, epoch = parts
        try:
            moment = datetime.fromisoformat(epoch).replace(tzinfo=UTC) if epoch else None
        except ValueError:
            ticks = "0"
        if ticks and not 0 < int(ticks) <= USUAL_TICKS:
            allowed = "some of: big or little, 1/65536 s or fewer parts, since 1980-01-01T12:00"
            raise ConfigError(f"time {text!r} is not known; in this order {allowed}")
        return cls(order, int(ticks) if ticks else None, int(moment.timestamp()) if moment else None)

    def __str__(self) -> str:
        parts = [self.byte_order or "", f"1/{self.ticks} s" if self.ticks else ""]
        if self.epoch_s is not None:
            parts.append(f"since {datetime.fromtimestamp(self.epoch_s, UTC):%FT%T}")
        return ", ".join(filter(None, parts))

    def layout(self, telemetry: Layout) -> Layout:
        """Return the layout of a telemetry header with this format of time."""
        return telemetry if self == MissionTime() else _timed(telemetry, self)

    def ns(self, seconds: Any, subseconds: Any) -> Any:
        """Return ns since the epoch of a time, or i64 of many."""
        return seconds * 1_000_000_000 + subseconds * 1_000_000_000 // (self.ticks or USUAL_TICKS)

    def words(self, time_ns: int) -> dict[str, int]:
        """Return the fields for a time in ns since 1970; 0 for a time before the epoch."""
        epoch_s = EPOCH_S if self.epoch_s is None else self.epoch_s
        seconds, rest = divmod(max(time_ns - epoch_s * 1_000_000_000, 0), 1_000_000_000)
        return {"seconds": seconds, "subseconds": rest * (self.ticks or USUAL_TICKS) // 1_000_000_000}


class _Moments(dict[int, str]):
    """The date and time of each number of seconds since an epoch."""

    def __init__(self, epoch_s: int) -> None:
        self.epoch_s = epoch_s

    def get(self, key: int, _: Any = None) -> Any:
        return f"{datetime.fromtimestamp(self.epoch_s + key, UTC):%FT%TZ}"


@cache
def _timed(telemetry: Layout, time: MissionTime) -> Layout:
    seconds, subseconds, *rest = (slot.field for slot in telemetry.slots)
    seconds = replace(seconds, names={} if time.epoch_s is None else _Moments(time.epoch_s))
    subseconds = replace(subseconds, doc=f"mission time: 1/{time.ticks or USUAL_TICKS} s")
    order = time.byte_order or "big"
    return Layout(telemetry.name, telemetry.title, seconds, subseconds, *rest, byte_order=order)


class Headers(msgspec.Struct, frozen=True):
    """The headers of one build of cFE, after the primary header.

    Attributes:
        name: name for users.
        extended: whether the extended header comes first.
        command: layout after it in a command.
        telemetry: layout after it in telemetry.
        msg_ids: rule that builds MsgIds from the headers.
    """

    name: str
    extended: bool
    command: Layout
    telemetry: Layout
    msg_ids: MsgIds = VERSION_1

    @property
    def start(self) -> int:
        """Offset of the command or telemetry header in the packet."""
        return ccsds.PRIMARY.size + (EXTENDED.size if self.extended else 0)

    @property
    def command_bytes(self) -> int:
        """Bytes of all headers of a command."""
        return self.start + self.command.size

    @property
    def telemetry_bytes(self) -> int:
        """Bytes of all headers of telemetry."""
        return self.start + self.telemetry.size

    def size(self, msg_id: int) -> int:
        """Return the bytes of all headers of packets with a MsgId."""
        return self.command_bytes if self.msg_ids.is_command(msg_id) else self.telemetry_bytes

    def emit(self, msg_id: int, total: int, sequence_flags: int, sequence_count: int) -> bytes:
        """Write the headers before the command or telemetry header, of a packet of ``total`` bytes."""
        word, subsystem = self.msg_ids.words(msg_id)
        head = ccsds.emit(word, total, sequence_flags=sequence_flags, sequence_count=sequence_count)
        return head + (EXTENDED.emit({"subsystem_id": subsystem}) if self.extended else b"")


STANDARD: Final = Headers("16-byte telemetry header", False, COMMAND, TELEMETRY)
SHORT: Final = Headers("12-byte telemetry header", False, COMMAND, TELEMETRY_SHORT)
WITH_EXTENDED: Final = Headers("extended header", True, COMMAND_EXTENDED, TELEMETRY_EXTENDED)
WITH_EXTENDED_2: Final = replace(
    WITH_EXTENDED, name="extended header and MsgIds of version 2", msg_ids=VERSION_2
)
DETECTABLE: Final = (STANDARD, SHORT, WITH_EXTENDED)
"""The kinds of build that can be detected from the bytes, the usual one first."""
HEADERS: Final = (*DETECTABLE, WITH_EXTENDED_2)
"""Every kind of build."""

_SECOND: Final = HEADERS.index(WITH_EXTENDED_2)
CHECKSUM_BYTE: Final = 1
"""Offset of the checksum in the command header."""
COMMAND_HEADER_BYTES: Final = ccsds.PRIMARY.size + COMMAND.size
TELEMETRY_HEADER_BYTES: Final = ccsds.PRIMARY.size + TELEMETRY.size
EVENT_MSG_ID: Final = 0x0808
SHORT_EVENT_MSG_ID: Final = 0x0809
SOFTWARE_BUS_HOUSEKEEPING_MSG_ID: Final = 0x0803
PAYLOADS: Final = {EVENT_MSG_ID: EVENT, SOFTWARE_BUS_HOUSEKEEPING_MSG_ID: SOFTWARE_BUS_HOUSEKEEPING}
"""Packets whose payload is a layer of its own, by MsgId of version 1."""


def known_ids(msg_id: NDArray[np.int32], headers: Octets) -> NDArray[np.int32]:
    """Return the MsgIds of many packets, converted to version 1 (see :mod:`edoras_tools.wire.ccsds`).

    Args:
        msg_id: MsgId of each packet, or a negative number.
        headers: index in ``HEADERS`` of the headers of each, u8.
    """
    second = headers == _SECOND
    return np.where(second, VERSION_2.standard(msg_id), msg_id) if np.count_nonzero(second) else msg_id


def checksum(packet: bytes | memoryview) -> int:
    """Return 0xFF XOR every byte: the checksum of a packet whose field is 0; 0 for a correct packet."""
    # XOR does not depend on order, so whole words are folded first.
    data = bytes(packet) + bytes(-len(packet) % 8)
    word = 0
    for at in range(0, len(data), 8):
        word ^= int.from_bytes(data[at : at + 8], "big")
    for shift in (32, 16, 8):
        word ^= word >> shift
    return (word ^ CHECKSUM_SEED) & 0xFF


def emit_command(
    msg_id: int,
    function_code: int,
    payload: bytes = b"",
    *,
    sequence_flags: int = ccsds.UNSEGMENTED,
    sequence_count: int = 0,
    with_checksum: bool = True,
    headers: Headers = STANDARD,
) -> bytes:
    """Write a whole command packet: 8 header bytes (16 with an extended header), and the payload.

    The EDORAS bridges send ``sequence_flags=0`` and ``with_checksum=False``.

    Raises:
        FieldError: a value does not fit its field, or the MsgId is a telemetry one.
    """
    if not headers.msg_ids.is_command(msg_id):
        bit = f"0x{headers.msg_ids.command_bit:04x}"
        raise FieldError("cfe_command", "msg_id", f"0x{msg_id:04x} lacks the command bit {bit}")
    head = headers.emit(msg_id, headers.command_bytes + len(payload), sequence_flags, sequence_count)
    packet = head + headers.command.emit({"function_code": function_code}) + payload
    if not with_checksum:
        return packet
    at = headers.start + CHECKSUM_BYTE
    return packet[:at] + bytes([checksum(packet)]) + packet[at + 1 :]


def emit_telemetry(
    msg_id: int,
    payload: bytes = b"",
    *,
    seconds: int = 0,
    subseconds: int = 0,
    sequence_flags: int = ccsds.UNSEGMENTED,
    sequence_count: int = 0,
    headers: Headers = STANDARD,
    time: MissionTime = MissionTime(),  # noqa: B008  frozen
) -> bytes:
    """Write a whole telemetry packet: 16 header bytes (12 in older builds) and the payload.

    Raises:
        FieldError: a value does not fit its field, or the MsgId is a command one.
    """
    if headers.msg_ids.is_command(msg_id):
        bit = f"0x{headers.msg_ids.command_bit:04x}"
        raise FieldError("cfe_telemetry", "msg_id", f"0x{msg_id:04x} has the command bit {bit}")
    head = headers.emit(msg_id, headers.telemetry_bytes + len(payload), sequence_flags, sequence_count)
    layout = time.layout(headers.telemetry)
    return head + layout.emit({"seconds": seconds, "subseconds": subseconds}) + payload


def with_headers(packet: bytes, old: Headers, new: Headers) -> bytes:
    """Return a packet with the headers of another build; function code or time, and the payload, stay.

    The MsgId becomes that of the other version (:mod:`edoras_tools.wire.ccsds`). A correct checksum is
    correct again. A packet shorter than its headers is returned unchanged.
    """
    msg_id = old.msg_ids.standard(old.msg_ids.of(packet)) if len(packet) > 1 else 0
    command = VERSION_1.is_command(msg_id)
    size, new_size = (item.command_bytes if command else item.telemetry_bytes for item in (old, new))
    if old is new or len(packet) < size:
        return packet
    shared = COMMAND.size if command else TELEMETRY_SHORT.size
    length = (int.from_bytes(packet[4:6], "big") + new_size - size) & 0xFFFF
    head = new.emit(new.msg_ids.of_known(msg_id), ccsds.LENGTH_BIAS + length, 0, 0)
    head = head[:2] + packet[2:4] + head[4:]
    if old.extended and new.extended:
        head = head[:6] + packet[6:7] + head[7:8] + packet[8:10]
    out = (head + packet[old.start : old.start + shared]).ljust(new_size, b"\0") + packet[size:]
    at = new.start + CHECKSUM_BYTE
    if command and checksum(packet) == 0:
        out = out[:at] + b"\0" + out[at + 1 :]
        out = out[:at] + bytes([checksum(out)]) + out[at + 1 :]
    return out


def msg_id_of(packet: bytes) -> int:
    """Return the MsgId of a packet: its first word."""
    return packet[0] << 8 | packet[1]


def length_of(packet: bytes) -> int:
    """Return the length in a packet's header, header included; its buffer may hold more or less."""
    return (packet[4] << 8 | packet[5]) + ccsds.LENGTH_BIAS


def function_code_of(packet: bytes) -> int:
    """Return the function code of a command: 7 bits after the primary header."""
    return packet[6] & 0x7F


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
