"""The arguments of the commands of cFE and the usual applications: a layout for each, in one table.

From the public sources of cFE 6 and 7, CI_LAB, TO_LAB, SBN, SCH, CF and DS; if both versions have different
types for a field, the bytes are the same. File Services has no commands. Little-endian, like the flight
computers here; :func:`arguments_of` reads the other order too.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from functools import cache
from itertools import takewhile
from typing import Any, Final

from edoras_tools.cfs import event_services, executive_services, names, sbn, table_services, telemetry_output
from edoras_tools.cfs import time_services as time
from edoras_tools.cfs.command_ingest import COMMAND_MSG_ID as CI_MSG_ID
from edoras_tools.wire.layout import Field, Layout, Slot

EVS_MSG_ID: Final = 0x1801
SB_MSG_ID: Final = 0x1803
TBL_MSG_ID: Final = 0x1804
TIME_MSG_ID: Final = 0x1805
SCH_MSG_ID: Final = 0x1895
CF_MSG_ID: Final = 0x18B3
DS_MSG_ID: Final = 0x18BB


def _text(name: str, size: int, doc: str) -> Field:
    return Field(name, 8 * size, doc, kind="text")


def _number(name: str, bits: int, doc: str = "", **names: int) -> Field:
    return Field(name, bits, doc, names={value: label for label, value in names.items()})


def _hex(name: str, bits: int, doc: str) -> Field:
    return Field(name, bits, doc, base=16)


def _path(name: str = "file_name", doc: str = "path on the flight computer") -> Field:
    return _text(name, executive_services.FILE_NAME_BYTES, doc)


_SPARE: Final = Field("spare", 8, "alignment")
_SPARE_WORD: Final = Field("spare", 16, "alignment")
_APP: Final = _text("application", executive_services.APP_NAME_BYTES, "as events print it")
_FILE: Final = _path()
_TABLE: Final = _text("table_name", table_services.TABLE_NAME_BYTES, "APPLICATION.TABLE")
_BUFFER: Final = _number("buffer", 16, "which image", inactive=0, active=1)
_TYPES: Final = (_hex("event_types", 8, "a bit each: 1 debug, 2 info, 4 error, 8 critical"), _SPARE)
_PORTS: Final = (_hex("ports", 8, "a bit each: 1, 2, 4, 8 for ports 1 to 4"), _SPARE)
_EVENT: Final = _number("event_id", 16, "the application's number for it")
_FILTER: Final = _hex("mask", 16, "an event passes where its count and this are 0")
_LOG_MODE: Final = {"overwrite": 0, "discard": 1}
_SECONDS: Final = _number("seconds", 32, "whole seconds")
_TIME: Final = (_SECONDS, _number("microseconds", 32, "0 to 999,999"))
_RATE: Final = (_SECONDS, _number("subseconds", 32, "1/2^32 s"))
_STREAM: Final = _hex("stream", 32, "MsgId; its second half is a packet size in old builds")
_ENTRY: Final = (
    _number("priority", 8, "quality of service", low=0, high=1),
    _number("reliability", 8, "quality of service", low=0, high=1),
    _number("limit", 8, "messages of it that may wait"),
)
_ROUTE: Final = (_hex("msg_id", 32, "MsgId"), _hex("pipe_id", 32, "as the routing file has it"), _SPARE)
_PERF: Final = (_number("mask_number", 32, "which 32 markers, from 0"), _hex("mask", 32, "a bit a marker"))
_NET: Final = _number("net", 8, "place of the network in SBN's table")
_PEER: Final = _number("peer", 8, "place of the peer there")
_CHANNEL: Final = _number("channel", 8, "255 for all")
_OF_CHANNEL: Final = (_CHANNEL, Field("spare", 24, "alignment", kind="bytes"))
_TRANSFER: Final = (
    _number("cfdp_class", 8, "0 unacknowledged, 1 acknowledged"),
    _number("keep", 8, "", delete=0, keep=1),
    _number("channel", 8),
    _number("priority", 8, "0 is highest"),
    _number("destination", 32, "entity ID"),
    _path("source_name", "file or folder on the flight computer"),
    _path("destination_name", "there"),
)
_TRANSACTION: Final = (
    _number("sequence", 32, "of the transaction"),
    _number("entity_id", 32, "that began it"),
    _number("channel", 8, "254 for any of it, 255 for all"),
    _SPARE,
    _SPARE_WORD,
)
_PARAMETER: Final = _number(
    "parameter",
    8,
    "of CF's table",
    ticks_per_second=0,
    rx_crc_bytes_per_wakeup=1,
    ack_timer_s=2,
    nak_timer_s=3,
    inactivity_timer_s=4,
    outgoing_chunk_size=5,
    ack_limit=6,
    nak_limit=7,
    local_entity_id=8,
    outgoing_messages_per_wakeup=9,
)
_FILE_ENTRY: Final = _number("file_index", 16, "place in the destination file table")
_DESTINATION: Final = (_FILE_ENTRY, _SPARE_WORD)
_PACKET: Final = (_hex("stream", 32, "MsgId"), _number("filter_index", 16, "which filter of it, from 0"))
_STATE: Final = {"disabled": 0, "enabled": 1}
_KIND: Final = {"by_count": 1, "by_time": 2}
_SLOT: Final = (_number("slot", 16, "of the schedule"), _number("entry", 16, "of the slot"))
_GROUPS: Final = (_hex("groups", 32, "a group in 8 bits, then 24 bits, one for each multi-group"),)

_FIELDS: Final[Mapping[int, Mapping[str, tuple[Field, ...]]]] = {
    executive_services.COMMAND_MSG_ID: {
        "RESTART": (Field("restart_type", 16, "how", names={1: "processor", 2: "power_on"}),),
        "START_APP": (
            _APP,
            _text("entry_point", executive_services.APP_NAME_BYTES, "its main function"),
            _FILE,
            _number("stack_size", 32, "bytes"),
            _number("exception_action", 8, "on an exception", restart_app=0, restart_all=1),
            _SPARE,
            _number("priority", 16, "of its task; 0 is highest"),
        ),
        "STOP_APP": (_APP,),
        "RESTART_APP": (_APP,),
        "RELOAD_APP": (_APP, _FILE),
        "QUERY_ONE": (_APP,),
        **dict.fromkeys(("QUERY_ALL", "QUERY_ALL_TASKS", "WRITE_SYS_LOG", "WRITE_ER_LOG"), (_FILE,)),
        **dict.fromkeys(("STOP_PERF_DATA", "DUMP_CDS_REGISTRY"), (_FILE,)),
        "START_PERF_DATA": (_number("trigger_mode", 32, "where the trigger lies", start=0, center=1, end=2),),
        **dict.fromkeys(("SET_PERF_FILTER_MASK", "SET_PERF_TRIGGER_MASK"), _PERF),
        "OVER_WRITE_SYS_LOG": (_number("mode", 32, "what a full log does", **_LOG_MODE),),
        "SET_MAX_PR_COUNT": (_number("max_resets", 16, "processor resets before a power-on reset"),),
        "DELETE_CDS": (_text("cds_name", 40, "APPLICATION.STORE"),),
        "SEND_MEM_POOL_STATS": (_APP, _hex("pool_handle", 32, "of the memory pool")),
    },
    EVS_MSG_ID: {
        **dict.fromkeys(("ENABLE_EVENT_TYPE", "DISABLE_EVENT_TYPE"), _TYPES),
        "SET_EVENT_FORMAT_MODE": (_number("format", 8, "of events", short=0, long=1), _SPARE),
        **dict.fromkeys(("ENABLE_APP_EVENT_TYPE", "DISABLE_APP_EVENT_TYPE"), (_APP, *_TYPES)),
        **dict.fromkeys(("ENABLE_APP_EVENTS", "DISABLE_APP_EVENTS", "RESET_APP_COUNTER"), (_APP,)),
        **dict.fromkeys(("SET_FILTER", "ADD_EVENT_FILTER"), (_APP, _EVENT, _FILTER)),
        **dict.fromkeys(("ENABLE_PORTS", "DISABLE_PORTS"), _PORTS),
        **dict.fromkeys(("RESET_FILTER", "DELETE_EVENT_FILTER"), (_APP, _EVENT)),
        "RESET_ALL_FILTERS": (_APP,),
        **dict.fromkeys(("WRITE_APP_DATA_FILE", "WRITE_LOG_DATA_FILE"), (_FILE,)),
        "SET_LOG_MODE": (_number("mode", 8, "what a full log does", **_LOG_MODE), _SPARE),
    },
    SB_MSG_ID: {
        **dict.fromkeys(("WRITE_ROUTING_INFO", "WRITE_PIPE_INFO", "WRITE_MAP_INFO"), (_FILE,)),
        **dict.fromkeys(("ENABLE_ROUTE", "DISABLE_ROUTE"), (*_ROUTE, _SPARE, _SPARE_WORD)),
    },
    TBL_MSG_ID: {
        "LOAD": (_FILE,),
        "DUMP": (_BUFFER, _TABLE, _FILE),
        "VALIDATE": (_BUFFER, _TABLE),
        "DUMP_REGISTRY": (_FILE,),
        **dict.fromkeys(("ACTIVATE", "SEND_REGISTRY", "DELETE_CDS", "ABORT_LOAD"), (_TABLE,)),
    },
    TIME_MSG_ID: {
        "SET_SOURCE": (_number("source", 16, "of time", internal=1, external=2),),
        "SET_STATE": (Field("state", 16, "of the clock", "int", {-1: "invalid", 0: "valid", 1: "flywheel"}),),
        **dict.fromkeys(("ADD_DELAY", "SUB_DELAY", "SET_TIME", "SET_MET", "SET_STCF"), _TIME),
        "SET_LEAP_SECONDS": (Field("leap_seconds", 16, "TAI - UTC, s", kind="int"),),
        **dict.fromkeys(("ADD_ADJUST", "SUB_ADJUST"), _TIME),
        **dict.fromkeys(("ADD_ONE_HZ", "SUB_ONE_HZ"), _RATE),
        "SET_SIGNAL": (_number("signal", 16, "tone", primary=1, redundant=2),),
    },
    telemetry_output.COMMAND_MSG_ID: {
        "ADD_PKT": (_STREAM, *_ENTRY, _SPARE),
        "REMOVE_PKT": (_STREAM,),
        "ENABLE_OUTPUT": (_text("address", 16, "IPv4 address that telemetry goes to"),),
    },
    SCH_MSG_ID: {
        **dict.fromkeys(("ENABLE", "DISABLE"), _SLOT),
        **dict.fromkeys(("ENABLE_GROUP", "DISABLE_GROUP"), _GROUPS),
    },
    CF_MSG_ID: {
        "RESET_COUNTERS": (
            _number("counters", 8, "which", all=0, command=1, fault=2, up=3, down=4),
            Field("spare", 24, "alignment", kind="bytes"),
        ),
        **dict.fromkeys(("TX_FILE", "PLAYBACK_DIR"), _TRANSFER),
        **dict.fromkeys(("FREEZE", "THAW", "ENABLE_DEQUEUE", "DISABLE_DEQUEUE"), _OF_CHANNEL),
        **dict.fromkeys(("SUSPEND", "RESUME", "CANCEL", "ABANDON"), _TRANSACTION),
        "SET_PARAM": (
            _number("value", 32, "new"),
            _PARAMETER,
            _number("channel", 8, "where it has one for each"),
            _SPARE_WORD,
        ),
        "GET_PARAM": (_PARAMETER, _number("channel", 8, "where it has one for each")),
        "WRITE_QUEUE": (
            _number("direction", 8, "", all=0, up=1, down=2),
            _CHANNEL,
            _number("queue", 8, "", pending=0, active=1, history=2, all=3),
            _SPARE,
            _FILE,
        ),
        **dict.fromkeys(
            ("ENABLE_DIR_POLLING", "DISABLE_DIR_POLLING"),
            (_CHANNEL, _number("folder", 8, "place in the table; 255 for all"), _SPARE_WORD),
        ),
        "PURGE_QUEUE": (_CHANNEL, _number("queues", 8, "", pending=0, history=1, both=2), _SPARE_WORD),
    },
    DS_MSG_ID: {
        "SET_APP_STATE": (_number("state", 16, "", **_STATE), _SPARE_WORD),
        "SET_FILTER_FILE": (*_PACKET, _FILE_ENTRY),
        "SET_FILTER_TYPE": (*_PACKET, _number("filter_type", 16, "", **_KIND)),
        "SET_FILTER_PARMS": (
            *_PACKET,
            _number("pass_count", 16, "N: so many of X pass"),
            _number("of", 16, "X"),
            _number("offset", 16, "O: of the first that passes"),
        ),
        "SET_DEST_TYPE": (_FILE_ENTRY, _number("name_type", 16, "of file names", **_KIND)),
        "SET_DEST_STATE": (_FILE_ENTRY, _number("state", 16, "", **_STATE)),
        "SET_DEST_PATH": (*_DESTINATION, _path("folder", "where files are written")),
        "SET_DEST_BASE": (*_DESTINATION, _text("base_name", 20, "of its files")),
        "SET_DEST_EXT": (*_DESTINATION, _text("extension", 8, "of its files")),
        "SET_DEST_SIZE": (*_DESTINATION, _number("max_size", 32, "bytes of a file")),
        "SET_DEST_AGE": (*_DESTINATION, _number("max_age", 32, "s")),
        "SET_DEST_COUNT": (*_DESTINATION, _number("sequence", 32, "in the next file's name")),
        "CLOSE_FILE": _DESTINATION,
        **dict.fromkeys(("ADD_MID", "REMOVE_MID"), (_hex("stream", 32, "MsgId"),)),
    },
    sbn.COMMAND_MSG_ID: {
        "HK_NET": (_NET,),
        **dict.fromkeys(("RESET_PEER", "HK_PEER", "HK_PEER_SUBS", "HK_RESET_PEER"), (_NET, _PEER)),
        "RELOAD": (_number("parameter", 32, "0 from Table Services"),),
    },
}
SERVICES: Final[Mapping[int, tuple[str, str]]] = {
    executive_services.COMMAND_MSG_ID: ("es", "CFE_ES"),
    EVS_MSG_ID: ("evs", "CFE_EVS"),
    SB_MSG_ID: ("sb", "CFE_SB"),
    TBL_MSG_ID: ("tbl", "CFE_TBL"),
    TIME_MSG_ID: ("time", "CFE_TIME"),
    telemetry_output.COMMAND_MSG_ID: ("to", "TO_LAB"),
    CI_MSG_ID: ("ci", "CI_LAB"),
    SCH_MSG_ID: ("sch", "SCH"),
    CF_MSG_ID: ("cf", "CF"),
    DS_MSG_ID: ("ds", "DS"),
    sbn.COMMAND_MSG_ID: ("sbn", "SBN"),
}
"""Prefixes of command names by command MsgId: as people type them (``es-stop-app``), and in C."""
DEFAULTS: Final[Mapping[tuple[int, str], Mapping[str, int]]] = {
    (executive_services.COMMAND_MSG_ID, "START_APP"): {
        "stack_size": executive_services.USUAL_STACK_BYTES,
        "exception_action": 0,
        "priority": executive_services.USUAL_PRIORITY,
    },
    (telemetry_output.COMMAND_MSG_ID, "ADD_PKT"): {
        "priority": 0,
        "reliability": 0,
        "limit": telemetry_output.USUAL_LIMIT,
    },
    (CF_MSG_ID, "TX_FILE"): {"keep": 1, "channel": 0, "priority": 0},
    (CF_MSG_ID, "PLAYBACK_DIR"): {"keep": 1, "channel": 0, "priority": 0},
    (CF_MSG_ID, "SET_PARAM"): {"channel": 0},
    (CF_MSG_ID, "GET_PARAM"): {"channel": 0},
    (CF_MSG_ID, "RESET_COUNTERS"): {"counters": 0},
    (sbn.COMMAND_MSG_ID, "RELOAD"): {"parameter": 0},
}
"""Optional arguments with their default values, by MsgId and command."""
TAILS: Final[Mapping[tuple[int, str], int]] = {
    (executive_services.COMMAND_MSG_ID, "START_APP"): 4,
    (telemetry_output.COMMAND_MSG_ID, "ENABLE_OUTPUT"): 4,
}
"""Bytes that may follow the arguments: alignment since cFE 7.0, or a longer text of other senders."""


BARE_TOO: Final = frozenset({(sbn.COMMAND_MSG_ID, sbn.RELOAD)})
"""Commands that are also sent without arguments, so that their length is not judged."""


def _layouts() -> dict[tuple[int, int], Layout]:
    layouts = {}
    for msg_id, (label, _) in SERVICES.items():
        fields = _FIELDS.get(msg_id, {})
        for code, title in names.function_code_names(msg_id).items():
            name = f"{label}_{title.lower()}"
            layouts[msg_id, code] = Layout(name, title, *fields.get(title, ()), byte_order="little")
    return layouts


ARGUMENTS: Final[Mapping[tuple[int, int], Layout]] = _layouts()
"""Layout of the arguments by command MsgId of version 1 and function code.

A layout's title is the application's name for the command. A layout of no bytes is a bare header.
"""
_WITH_SIZE: Final = Layout(
    "to_add_pkt", "ADD_PKT", _STREAM, _SPARE_WORD, *_ENTRY, _SPARE, _SPARE_WORD, byte_order="little"
)
"""Arguments of TO_LAB up to v2.5.0-rc4: with a packet size, which it does not use."""
APPLICATIONS: Final[Mapping[int, str]] = {
    executive_services.COMMAND_MSG_ID: executive_services.NAME,
    EVS_MSG_ID: event_services.NAME,
    SB_MSG_ID: "CFE_SB",
    TBL_MSG_ID: table_services.NAME,
    TIME_MSG_ID: time.NAME,
    telemetry_output.COMMAND_MSG_ID: telemetry_output.NAME,
    CI_MSG_ID: "CI_LAB_APP",
    sbn.COMMAND_MSG_ID: sbn.NAME,
}
"""Application that receives each command MsgId, among those that a diagnosis follows."""
CHANGES: Final = frozenset(
    {(msg_id, 1) for msg_id in APPLICATIONS}
    | {(executive_services.COMMAND_MSG_ID, code) for code in (2, 4, 5, 6, 7)}
    | {(EVS_MSG_ID, code) for code in (2, 3, 5, 6, 7, 8, 9, 10, 13, 14, 15, 16)}
    | {(SB_MSG_ID, code) for code in (4, 5)}
    | {(TBL_MSG_ID, code) for code in table_services.CODES}
    | {(TIME_MSG_ID, code) for code in time.SETS}
    | {(telemetry_output.COMMAND_MSG_ID, code) for code in (2, 4, 5, 6)}
    | {(sbn.COMMAND_MSG_ID, code) for code in (sbn.RESET_PEER, sbn.RELOAD)}
)
"""Commands that change the behaviour of a cFS: MsgId and function code."""


def arguments_of(
    msg_id: int, function_code: int, payload: bytes, *, big_endian: bool = False, cut: bool = False
) -> dict[str, Any] | None:
    """Read the arguments of a command that changes the behaviour of a cFS.

    Args:
        msg_id: MsgId of version 1.
        function_code: function code of the command.
        payload: bytes after the header; bytes after the arguments are ignored.
        big_endian: whether the receiving flight computer is big-endian.
        cut: whether the capture has only a part of the bytes.

    Returns:
        Argument to int or text, without alignment, up to the first absent one; None if the command is not in
        :data:`CHANGES`. A text is complete with its NUL, or at its end if nothing was cut.
    """
    if (msg_id, function_code) not in CHANGES:
        return None
    layout = ARGUMENTS[msg_id, function_code]
    layout = _WITH_SIZE if layout.title == _WITH_SIZE.title and len(payload) == _WITH_SIZE.size else layout
    layout = layout.big if big_endian else layout

    def is_there(slot: Slot) -> bool:
        part = payload[slot.start : slot.end]
        ends = slot.field.kind == "text" and (b"\0" in part or (bool(part) and not cut))
        return slot.end <= len(payload) or ends

    slots = takewhile(is_there, layout.slots)
    return {slot.field.name: layout.read(slot, payload) for slot in slots if slot.field.name != "spare"}


def argument_text(field: Field, value: Any) -> str:
    """Return an argument as it is typed: a value's name, a number, a text; quoted if it has spaces."""
    if field.kind == "text":
        return value if _PLAIN(value) else repr(value)
    if field.base == 16:
        return f"0x{value:0{min(field.bits // 4, 4)}x}"
    return field.names.get(value) or str(value)


_PLAIN: Final = re.compile(r"\S+").fullmatch


@cache
def argument_words(msg_id: int, function_code: int) -> tuple[tuple[Slot, Callable[[Any], str]], ...]:
    """Return the arguments of a command, each with a function for its text: `` limit=4``, or empty."""
    layout = ARGUMENTS[msg_id, function_code]
    usual = DEFAULTS.get((msg_id, layout.title), {})

    def word_of(item: Field) -> Callable[[Any], str]:
        if usual.get(item.name) == 0:
            return lambda value: f" {item.name}={argument_text(item, value)}" if value else ""
        if item.kind == "text" or item.names:
            return lambda value: f" {item.name}={argument_text(item, value)}"
        form = f"0x{{:0{min(item.bits // 4, 4)}x}}" if item.base == 16 else "{}"
        return f" {item.name}={form}".format  # many differ: a list of commands is made of these

    shown_slots = (slot for slot in layout.slots if slot.field.name != "spare")
    return tuple((slot, word_of(slot.field)) for slot in shown_slots)


def command_line(msg_id: int, function_code: int, values: Mapping[str, Any]) -> str:
    """Return a command with its arguments by name: ``ADD_PKT stream=0x0827 limit=4``.

    An argument that is zero by default and has this value is left out.

    Args:
        values: values of all its arguments; others are ignored.
    """
    words = (word(values[slot.field.name]) for slot, word in argument_words(msg_id, function_code))
    return ARGUMENTS[msg_id, function_code].title + "".join(words)


def command_text(msg_id: int, function_code: int, values: Mapping[str, Any]) -> str:
    """Return a command as people read it: ``ADD_PKT 0x0827, limit 1``, ``STOP_APP SBN``."""
    layout = ARGUMENTS[msg_id, function_code]
    seconds = values.get("seconds")
    if seconds is not None:
        fraction = values.get("microseconds", 0) / 1e6 + values.get("subseconds", 0) / 2**32
        return (
            f"{layout.title} {seconds + fraction:g} s" if seconds < 10**6 else f"{layout.title} {seconds} s"
        )
    words = []
    for slot in layout.slots:
        name, value = slot.field.name, values.get(slot.field.name)
        if value is None or name in {
            "entry_point",
            "stack_size",
            "exception_action",
            "priority",
            "reliability",
        }:
            continue
        text = f"0x{value & 0xFFFF:04x}" if name == "stream" else slot.field.text(value)
        words.append(
            text if slot.field.kind == "text" or name == "stream" else f"{name.replace('_', ' ')} {text}"
        )
    return " ".join((layout.title, ", ".join(words))).rstrip()
