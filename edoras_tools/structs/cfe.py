"""What cFE's core services and the usual applications send and take, so that it decodes without an ELF file.

Each struct describes the bytes after the packet's header. Numbers are little-endian; the order and widths of
telemetry members were measured on a flight. Names follow this package's words, not cFE's. Events and the
counters of the software bus come from the tables of :mod:`edoras_tools.wire.cfe`, with which the sessions
write them; commands come from the table of their arguments, :mod:`edoras_tools.cfs.arguments`.
"""

from __future__ import annotations

from functools import cache
from typing import Any, Final

from msgspec.structs import replace

from edoras_tools.cfs.arguments import ARGUMENTS, BARE_TOO, SERVICES, TAILS
from edoras_tools.structs import shapes
from edoras_tools.structs.files import layout_of
from edoras_tools.wire import cfe
from edoras_tools.wire import layout as wire
from edoras_tools.wire.ccsds import VERSION_1, MsgIds

LAYOUT_NAME: Final = shapes.SHIPPED
"""Name of this layout on the command line."""
_COUNTERS: Final = {
    "command_counter": ("uint8", "ground commands accepted"),
    "command_error_counter": ("uint8", "ground commands refused"),
}
_TIME: Final = "CFE_TIME_SysTime"
_ENUMS: Final[dict[str, dict[str, Any]]] = {
    "CFE_LogMode": {"type": "uint8", "values": {"overwrite": 0, "discard": 1}},
    "CFE_EVS_Format": {"type": "uint8", "values": {"short": 0, "long": 1}},
    "CFE_ES_SysLogMode": {"type": "uint32", "values": {"overwrite": 0, "discard": 1}},
    "CFE_ES_ResetType": {"type": "uint32", "values": {"processor": 1, "power_on": 2}},
    "CFE_ES_PerfState": {"type": "uint32", "values": {"idle": 0, "waiting": 1, "triggered": 2}},
    "CFE_ES_PerfMode": {"type": "uint32", "values": {"start": 0, "center": 1, "end": 2}},
    "CFE_TIME_ClockState": {"type": "int16", "values": {"invalid": -1, "valid": 0, "flywheel": 1}},
}
_STRUCTS: Final[dict[str, tuple[str, dict[str, str | tuple[str, str]]]]] = {
    _TIME: ("", {"seconds": "uint32", "subseconds": ("uint32", "1/2^32 s")}),
    "CFE_ES_HousekeepingTlm": (
        "Executive Services housekeeping",
        {
            **_COUNTERS,
            "cfe_checksum": ("uint16 hex", "of the cFE core's code"),
            **{
                f"{part}_{item}": "uint8"
                for part in ("cfe", "osal", "psp")
                for item in ("major", "minor", "revision", "mission_revision")
            },
            "system_log_bytes_used": "uint32",
            "system_log_size": ("uint32", "bytes"),
            "system_log_entries": "uint32",
            "system_log_mode": ("CFE_ES_SysLogMode", "what a full system log does"),
            "reset_log_index": ("uint32", "of the exception and reset log; it wraps around"),
            "reset_log_entries": "uint32",
            "registered_core_apps": "uint32",
            "registered_external_apps": "uint32",
            "registered_tasks": ("uint32", "main and child tasks"),
            "registered_libraries": "uint32",
            "reset_type": ("CFE_ES_ResetType", "of the last reset"),
            "reset_subtype": "uint32",
            "processor_resets": ("uint32", "since the last power-on"),
            "max_processor_resets": ("uint32", "before a power-on reset is made"),
            "boot_source": "uint32",
            "perf_state": ("CFE_ES_PerfState", "of the performance analyzer"),
            "perf_mode": ("CFE_ES_PerfMode", "where its trigger lies in what it keeps"),
            "perf_trigger_count": "uint32",
            "perf_filter_mask": "uint32[4] hex",
            "perf_trigger_mask": "uint32[4] hex",
            "perf_data_start": ("uint32", "first entry kept"),
            "perf_data_end": ("uint32", "last entry kept"),
            "perf_data_count": "uint32",
            "perf_data_to_write": ("uint32", "entries not yet in the file"),
            "heap_bytes_free": "uint32",
            "heap_blocks_free": "uint32",
            "heap_max_block_size": ("uint32", "largest block that is free"),
        },
    ),
    "CFE_EVS_AppData": (
        "",
        {
            "app_id": ("uint32 hex", "0 for none"),
            "messages_sent": "uint16",
            "enabled": ("bool", "whether it may send events"),
            "messages_squelched": "uint8",
        },
    ),
    "CFE_EVS_HousekeepingTlm": (
        "Event Services housekeeping",
        {
            **_COUNTERS,
            "message_format": ("CFE_EVS_Format", "of events"),
            "messages_truncated": "uint8",
            "unregistered_app_counter": ("uint8", "events of apps that had not registered"),
            "output_ports": ("uint8 hex", "a bit each"),
            "log_full": "bool",
            "log_mode": ("CFE_LogMode", "what a full event log does"),
            "messages_sent": "uint16",
            "log_overflow_counter": "uint16",
            "log_enabled": "bool",
            "app_data": ("CFE_EVS_AppData[] @16", "one for each app, as many as the build has room for"),
        },
    ),
    "CFE_SB_PipeDepth": (
        "",
        {
            "pipe_id": ("uint32 hex", "0 for none"),
            "max_queue_depth": "uint16",
            **dict.fromkeys(("current_queue_depth", "peak_queue_depth", "spare"), "uint16"),
        },
    ),
    "CFE_SB_StatsTlm": (
        "Software Bus statistics",
        {
            **{
                name: "uint32"
                for resource in ("msg_ids", "pipes", "memory", "subscriptions")
                for name in (f"{resource}_in_use", f"peak_{resource}_in_use", f"max_{resource}_allowed")
            },
            **dict.fromkeys(("buffers_in_use", "peak_buffers_in_use", "max_pipe_depth_allowed"), "uint32"),
            "pipes": ("CFE_SB_PipeDepth[]", "one for each pipe, as many as the build has room for"),
        },
    ),
    "CFE_TBL_HousekeepingTlm": (
        "Table Services housekeeping",
        {
            **_COUNTERS,
            "tables": ("uint16", "registered"),
            "loads_pending": ("uint16", "tables that wait for their app"),
            "validation_counter": ("uint16", "validations completed"),
            "last_validation_crc": "uint32 hex",
            "last_validation_status": "int32",
            "active_buffer": ("bool", "whether the active buffer was validated"),
            "last_validated_table": "char[40]",
            "validation_success_counter": "uint8",
            "validation_failure_counter": "uint8",
            "validation_request_counter": "uint8",
            "free_shared_buffers": "uint8",
            "memory_pool_handle": "uint32 hex @64",
            "last_update_time": _TIME,
            "last_updated_table": "char[40]",
            "last_file_loaded": "char[64]",
            "last_file_dumped": "char[64]",
            "last_table_loaded": "char[40]",
        },
    ),
    "CFE_TIME_HousekeepingTlm": (
        "Time Services housekeeping",
        {
            **_COUNTERS,
            "clock_state_flags": "uint16 hex",
            "clock_state": "CFE_TIME_ClockState",
            "leap_seconds": "int16",
            "met_seconds": ("uint32", "mission elapsed time"),
            "met_subseconds": ("uint32", "1/2^32 s"),
            "stcf_seconds": ("uint32", "what is added to it, the spacecraft time correlation factor"),
            "stcf_subseconds": ("uint32", "1/2^32 s"),
            "adjust_seconds": ("uint32", "of a server 1 Hz adjustment, of a client delay"),
            "adjust_subseconds": ("uint32", "1/2^32 s"),
        },
    ),
    "CFE_TIME_DiagnosticTlm": (
        "Time Services diagnostics",
        {
            **dict.fromkeys(("tone_met", "tone_stcf", "tone_delay", "tone_latch"), _TIME),
            "tone_leap_seconds": "int16",
            "clock_state": "CFE_TIME_ClockState",
            **dict.fromkeys(("since_tone", "current_latch", "current_met", "tai", "utc"), _TIME),
            **dict.fromkeys(("clock_set", "flywheel", "clock_source", "clock_signal"), "int16"),
            **dict.fromkeys(("server_flywheel", "forced_flywheel"), "int16"),
            "clock_state_flags": "uint16 hex",
            **dict.fromkeys(("one_time_direction", "one_hz_direction", "delay_direction"), "int16"),
            **dict.fromkeys(("one_time_adjust", "one_hz_adjust", "signal_latch", "data_latch"), _TIME),
            **{
                f"{name}_counter": "uint32"
                for name in (
                    *("tone_match", "tone_match_error", "tone_signal", "tone_data", "tone_interrupt"),
                    *("tone_interrupt_error", "tone_task", "version", "local_interrupt", "local_task"),
                )
            },
            "virtual_met": ("uint32", "s"),
            "min_elapsed": ("uint32", "1/2^32 s"),
            "max_elapsed": ("uint32", "1/2^32 s"),
            "max_local_clock": _TIME,
            "tone_over_limit": "uint32",
            "tone_under_limit": "uint32",
            "data_store_status": "int32",
        },
    ),
    "CFE_ES_OneAppTlm": (
        "one application, as asked for",
        {
            "resource_id": "uint32 hex",
            "type": "uint32",
            "name": "char[20]",
            "entry_point": "char[20]",
            "file_name": "char[64]",
            "stack_size": ("uint32", "bytes"),
            "addresses_valid": ("bool32", "whether the following are known"),
            **{
                name: "uint32 hex" if name.endswith("address") else "uint32"
                for name in (
                    *("code_address", "code_size", "data_address", "data_size", "bss_address", "bss_size"),
                    "start_address",
                )
            },
            "exception_action": "uint16",
            "priority": "uint16",
            "main_task_id": "uint32 hex",
            "execution_counter": "uint32",
            "main_task_name": "char[20]",
            "child_tasks": "uint32",
        },
    ),
    "TO_LAB_HkTlm": ("Telemetry Output housekeeping", dict(_COUNTERS) | {"spare": "uint8[2]"}),
    "CI_LAB_HkTlm": (
        "Command Ingest housekeeping",
        {
            **dict(reversed(_COUNTERS.items())),
            "checksums_enabled": "bool",
            "socket_connected": "bool",
            "ingest_packets": ("uint32 @12", "datagrams taken in"),
            "ingest_errors": "uint32",
            "spare": "uint32",
        },
    ),
}
_WIRE_LAYOUTS: Final = {
    cfe.EVENT_MSG_ID: cfe.EVENT,
    cfe.SOFTWARE_BUS_HOUSEKEEPING_MSG_ID: cfe.SOFTWARE_BUS_HOUSEKEEPING,
}
"""Packets that the tables of ``wire`` describe, by MsgId of version 1; so do those of ``DATAGRAMS``."""


@cache
def shipped_layout(msg_ids: MsgIds = VERSION_1) -> shapes.StructLayout:
    """Return the layout of the packets that cFE itself sends and takes, with MsgIds of a version."""
    raw = {
        "enums": _ENUMS,
        "bind": {
            msg_id: name
            for msg_id, name in shapes.packets(msg_ids).items()
            if msg_ids.standard(msg_id) not in _WIRE_LAYOUTS
        },
        "structs": {
            name: {
                "doc": doc,
                "members": {
                    label: item if isinstance(item, str) else {"type": item[0], "doc": item[1]}
                    for label, item in members.items()
                },
            }
            for name, (doc, members) in _STRUCTS.items()
        },
    }
    layout = layout_of(raw, LAYOUT_NAME)
    structs, enums = dict(layout.structs), dict(layout.enums)
    bindings = dict(layout.bindings)
    for msg_id, header in _WIRE_LAYOUTS.items():
        name = shapes.PACKETS[msg_id]
        structs[name] = _of_header(name, header, enums)
        bindings[shapes.Key(msg_ids.of_known(msg_id))] = name
    for size, header in shapes.DATAGRAMS.items():
        structs[header.name] = _of_header(header.name, header, enums)
        bindings[shapes.Key(shapes.UDP_KEY, size)] = header.name
    for (msg_id, code), arguments in ARGUMENTS.items():
        if arguments.size and (msg_id, code) not in BARE_TOO:
            name = command_type(msg_id, arguments.title)
            command = _of_header(name, arguments, enums)
            structs[name] = replace(command, tail=TAILS.get((msg_id, arguments.title), 0))
            bindings[shapes.Key(msg_ids.of_known(msg_id), code)] = name
    return shapes.StructLayout(structs, enums, bindings, origin=LAYOUT_NAME)


def command_type(msg_id: int, title: str) -> str:
    """Return the struct name of a command, as ``CFE_ES_StopAppCmd``.

    Args:
        msg_id: MsgId of version 1.
        title: name of the command in its application.
    """
    return f"{SERVICES[msg_id][1]}_{title.title().replace('_', '')}Cmd"


def _of_header(name: str, header: wire.Layout, enums: dict[str, shapes.Enumeration]) -> shapes.Struct:
    """Return the table of a header, or of a command's arguments, as a struct, without spare bytes."""
    members = []
    for slot in header.slots:
        item, size = slot.field, slot.end - slot.start
        kind = shapes.BASIC["char"] if item.kind == "text" else shapes.BASIC.get(f"{item.kind}{item.bits}")
        if kind is None or item.name == "spare":
            continue
        enum = shapes.Enumeration(f"{name}_{item.name}", kind, item.names)
        if item.names:
            enums[enum.name] = enum
        members.append(
            shapes.Member(
                item.name,
                enum.name if item.names else kind,
                slot.start,
                (size,) if item.kind == "text" else (),
                base=item.base,
                doc=item.doc,
            )
        )
    return shapes.Struct(name, header.size, tuple(members), doc=header.title)
