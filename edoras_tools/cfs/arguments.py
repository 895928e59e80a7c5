"""What follows the header of the commands that change what a cFS does: a layout for each, in one table.

From the public sources of cFE 6 and 7, TO_LAB and SBN; where both have other types for a field, it takes the
same bytes. Little-endian, as flight computers here are; :func:`arguments_of` reads the other order too.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.cfs import event_services, executive_services, sbn, table_services, telemetry_output
from edoras_tools.cfs import time_services as time
from edoras_tools.cfs.command_ingest import COMMAND_MSG_ID as CI_MSG_ID
from edoras_tools.errors import TruncatedError
from edoras_tools.wire.layout import Field, Layout

if TYPE_CHECKING:
    from collections.abc import Mapping

EVS_MSG_ID: Final = 0x1801
TBL_MSG_ID: Final = 0x1804
TIME_MSG_ID: Final = 0x1805
_NAME_BITS: Final = 8 * executive_services.APP_NAME_BYTES
_APP: Final = Field("app_name", _NAME_BITS, "an application, as events print it", kind="text")
_FILE: Final = Field(
    "file_name", 8 * executive_services.FILE_NAME_BYTES, "path on the flight computer", "text"
)
_TABLE: Final = Field("table_name", 8 * table_services.TABLE_NAME_BYTES, "APPLICATION.TABLE", kind="text")
_ACTIVE: Final = Field("buffer", 16, "which image", names={0: "inactive", 1: "active"})
_MASK: Final = Field("event_types", 8, "a bit each: 1 debug, 2 info, 4 error, 8 critical", base=16)
_SPARE: Final = Field("spare", 8, "alignment")
_EVENT: Final = Field("event_id", 16, "the application's number for it")
_FILTER: Final = Field("mask", 16, "an event passes where its count and this are 0", base=16)
_SECONDS: Final = Field("seconds", 32, "whole seconds")
_MICROS: Final = Field("microseconds", 32, "0 to 999,999")
_MSG_ID: Final = Field("msg_id", 32, "MsgId; its second half is a packet size in old builds", base=16)
_NET: Final = Field("net", 8, "place of the network in SBN's table")
_PEER: Final = Field("peer", 8, "place of the peer there")
_BITS: Final = (_MASK, _SPARE)


def _layouts(app: str, msg_id: int, commands: Mapping[int, tuple[Any, ...]]) -> dict[tuple[int, int], Layout]:
    return {
        (msg_id, code): Layout(f"{app.lower()}_{title.lower()}", title, *fields, byte_order="little")
        for code, (title, *fields) in commands.items()
    }


_RESET_COUNTERS: Final = 1
ARGUMENTS: Final[Mapping[tuple[int, int], Layout]] = {
    **_layouts(
        "es",
        executive_services.COMMAND_MSG_ID,
        {
            _RESET_COUNTERS: ("RESET_COUNTERS",),
            executive_services.RESTART: (
                "RESTART",
                Field("restart_type", 16, "how", names={1: "processor", 2: "power-on"}),
            ),
            executive_services.START_APP: (
                "START_APP",
                _APP,
                Field("entry_point", _NAME_BITS, "its main function", kind="text"),
                _FILE,
                Field("stack_size", 32, "bytes"),
                Field("exception_action", 16, "on an exception", names={0: "restart it", 1: "restart all"}),
                Field("priority", 16, "of its task; 0 is highest"),
            ),
            executive_services.STOP_APP: ("STOP_APP", _APP),
            executive_services.RESTART_APP: ("RESTART_APP", _APP),
            executive_services.RELOAD_APP: ("RELOAD_APP", _APP, _FILE),
        },
    ),
    **_layouts(
        "evs",
        EVS_MSG_ID,
        {
            _RESET_COUNTERS: ("RESET_COUNTERS",),
            event_services.ENABLE_TYPE: ("ENABLE_EVENT_TYPE", *_BITS),
            event_services.DISABLE_TYPE: ("DISABLE_EVENT_TYPE", *_BITS),
            event_services.ENABLE_APP_TYPE: ("ENABLE_APP_EVENT_TYPE", _APP, *_BITS),
            event_services.DISABLE_APP_TYPE: ("DISABLE_APP_EVENT_TYPE", _APP, *_BITS),
            event_services.ENABLE_APP: ("ENABLE_APP_EVENTS", _APP),
            event_services.DISABLE_APP: ("DISABLE_APP_EVENTS", _APP),
            event_services.RESET_APP_COUNTER: ("RESET_APP_COUNTER", _APP),
            event_services.SET_FILTER: ("SET_FILTER", _APP, _EVENT, _FILTER),
            event_services.RESET_FILTER: ("RESET_FILTER", _APP, _EVENT),
            event_services.RESET_ALL_FILTERS: ("RESET_ALL_FILTERS", _APP),
            event_services.ADD_FILTER: ("ADD_EVENT_FILTER", _APP, _EVENT, _FILTER),
            event_services.DELETE_FILTER: ("DELETE_EVENT_FILTER", _APP, _EVENT),
        },
    ),
    **_layouts(
        "tbl",
        TBL_MSG_ID,
        {
            _RESET_COUNTERS: ("RESET_COUNTERS",),
            table_services.LOAD: ("LOAD", _FILE),
            table_services.VALIDATE: ("VALIDATE", _ACTIVE, _TABLE),
            table_services.ACTIVATE: ("ACTIVATE", _TABLE),
            table_services.ABORT_LOAD: ("ABORT_LOAD", _TABLE),
        },
    ),
    **_layouts(
        "time",
        TIME_MSG_ID,
        {
            _RESET_COUNTERS: ("RESET_COUNTERS",),
            time.SET_TIME: ("SET_TIME", _SECONDS, _MICROS),
            time.SET_MET: ("SET_MET", _SECONDS, _MICROS),
            time.SET_STCF: ("SET_STCF", _SECONDS, _MICROS),
            time.SET_LEAP_SECONDS: (
                "SET_LEAP_SECONDS",
                Field("leap_seconds", 16, "TAI - UTC, s", kind="int"),
            ),
            time.ADD_ADJUST: ("ADD_ADJUST", _SECONDS, _MICROS),
            time.SUB_ADJUST: ("SUB_ADJUST", _SECONDS, _MICROS),
            time.ADD_ONE_HZ: ("ADD_ONE_HZ", _SECONDS, Field("subseconds", 32, "1/2^32 s")),
            time.SUB_ONE_HZ: ("SUB_ONE_HZ", _SECONDS, Field("subseconds", 32, "1/2^32 s")),
        },
    ),
    **_layouts(
        "to",
        telemetry_output.COMMAND_MSG_ID,
        {
            telemetry_output.RESET: ("RESET_COUNTERS",),
            telemetry_output.ADD_PACKET: (
                "ADD_PACKET",
                _MSG_ID,
                Field("priority", 8, "quality of service"),
                Field("reliability", 8, "quality of service"),
                Field("limit", 8, "messages of it that may wait"),
                _SPARE,
            ),
            telemetry_output.REMOVE_PACKET: ("REMOVE_PACKET", _MSG_ID),
            telemetry_output.REMOVE_ALL: ("REMOVE_ALL",),
            telemetry_output.ENABLE: (
                "ENABLE_OUTPUT",
                Field("address", 128, "IPv4 address that telemetry goes to", kind="text"),
            ),
        },
    ),
    **_layouts("ci", CI_MSG_ID, {_RESET_COUNTERS: ("RESET_COUNTERS",)}),
    **_layouts(
        "sbn",
        sbn.COMMAND_MSG_ID,
        {
            _RESET_COUNTERS: ("RESET_COUNTERS",),
            sbn.RESET_PEER: ("RESET_PEER", _NET, _PEER),
            sbn.RELOAD: ("RELOAD", Field("parameter", 32, "0 from Table Services")),
        },
    ),
}
"""Command MsgId of version 1 and function code to the layout of what follows the header.

A layout's title is the application's name for the command. A layout of no bytes is a bare header.
"""
APPLICATIONS: Final[Mapping[int, str]] = {
    executive_services.COMMAND_MSG_ID: executive_services.NAME,
    EVS_MSG_ID: event_services.NAME,
    TBL_MSG_ID: table_services.NAME,
    TIME_MSG_ID: time.NAME,
    telemetry_output.COMMAND_MSG_ID: telemetry_output.NAME,
    CI_MSG_ID: "CI_LAB_APP",
    sbn.COMMAND_MSG_ID: sbn.NAME,
}
"""Command MsgId to the application that takes it."""


@cache
def _big(layout: Layout) -> Layout:
    return Layout(layout.name, layout.title, *(slot.field for slot in layout.slots))


def arguments_of(
    msg_id: int, function_code: int, payload: bytes, *, big_endian: bool = False
) -> dict[str, Any] | None:
    """Read the arguments of a command.

    Args:
        msg_id: of version 1.
        payload: what follows the header; bytes behind the arguments are left out.
        big_endian: the byte order of the flight computer that takes it.

    Returns:
        argument to int or text, alignment left out; None where the command is none of the table, or is
        shorter than its arguments.
    """
    layout = ARGUMENTS.get((msg_id, function_code))
    if layout is None:
        return None
    try:
        values = (_big(layout) if big_endian else layout).parse(payload)
    except TruncatedError:
        return None
    values.pop("spare", None)
    return values


def command_text(msg_id: int, function_code: int, values: Mapping[str, Any]) -> str:
    """Return a command as people read it: ``ADD_PACKET 0x0827, limit 1``, ``STOP_APP SBN``."""
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
        text = f"0x{value & 0xFFFF:04x}" if name == "msg_id" else slot.field.text(value)
        words.append(
            text if slot.field.kind == "text" or name == "msg_id" else f"{name.replace('_', ' ')} {text}"
        )
    return " ".join((layout.title, ", ".join(words))).rstrip()
