"""The MsgIds that every cFS of this kind has, and the commands that its apps obey.

From the cFE, CI_LAB, TO_LAB and SBN sources; only values that they fix are listed. A length that varies is
absent.
"""

from __future__ import annotations

from typing import Final, NamedTuple


class Command(NamedTuple):
    """One function code of an app.

    Attributes:
        name: name in the app.
        lengths: total packet lengths that the app accepts; empty if it varies or is not fixed.
    """

    name: str
    lengths: tuple[int, ...] = ()


def _numbered(names: str, first: int = 0) -> dict[int, str]:
    """Number the words of a text; ``-`` leaves a number out."""
    return {code: name for code, name in enumerate(names.split(), first) if name != "-"}


def _commands(names: str, **lengths: tuple[int, ...]) -> dict[int, Command]:
    """Number commands from 0. No-op and counter reset are bare headers."""
    lengths = {"NOOP": (8,), "RESET_COUNTERS": (8,)} | lengths
    return {code: Command(name, lengths.get(name, ())) for code, name in _numbered(names).items()}


SIZED_ENTRY_BYTES: Final = 20
"""Length of TO_LAB's command to add an entry up to v2.5.0-rc4: it has a packet size, which is not used."""
ENABLE_OUTPUT_LENGTHS: Final = (24, 28)
"""TO_LAB's enable has a char[16]; the 20-byte string of some senders is accepted too."""

MSG_ID_NAMES: Final[dict[int, str]] = {
    0x0800: "ES_HK",
    0x0801: "EVS_HK",
    0x0803: "SB_HK",
    0x0804: "TBL_HK",
    0x0805: "TIME_HK",
    0x0806: "TIME_DIAG",
    0x0808: "EVS_LONG_EVENT",
    0x0809: "EVS_SHORT_EVENT",
    0x080A: "SB_STATS",
    0x080B: "ES_APP_INFO",
    0x080C: "TBL_REGISTRY",
    0x080D: "SB_ALL_SUBSCRIPTIONS",
    0x080E: "SB_ONE_SUBSCRIPTION",
    0x0810: "ES_MEMORY_STATS",
    0x0826: "EDORAS_APP_HK",
    0x0880: "TO_HK",
    0x0881: "TO_DATA_TYPES",
    0x0883: "SAMPLE_HK",
    0x0884: "CI_HK",
    0x08FA: "SBN_HK",
    0x1801: "EVS_CMD",
    0x1803: "SB_CMD",
    0x1804: "TBL_CMD",
    0x1805: "TIME_CMD",
    0x1806: "ES_CMD",
    0x1808: "ES_SEND_HK",
    0x1809: "EVS_SEND_HK",
    0x180B: "SB_SEND_HK",
    0x180C: "TBL_SEND_HK",
    0x180D: "TIME_SEND_HK",
    0x180E: "SB_REPORT_CONTROL",
    0x1810: "TIME_TONE",
    0x1811: "TIME_ONE_HZ",
    0x1860: "TIME_DATA",
    0x1862: "TIME_SEND",
    0x1880: "TO_CMD",
    0x1881: "TO_SEND_HK",
    0x1882: "SAMPLE_CMD",
    0x1883: "SAMPLE_SEND_HK",
    0x1884: "CI_CMD",
    0x1885: "CI_SEND_HK",
    0x1895: "SCH_CMD",
    0x18B3: "CF_CMD",
    0x18BB: "DS_CMD",
    0x18FA: "SBN_CMD",
}


def housekeeping_of(app: str) -> list[int]:
    """Return the MsgIds of an application's own housekeeping: 0x0884 (CI_HK) of CI_LAB_APP."""
    own = ((msg_id, name[:-2]) for msg_id, name in MSG_ID_NAMES.items() if name[-3:] == "_HK")
    return [msg_id for msg_id, name in own if f"{app}_".startswith(name)]


COMMANDS: Final[dict[int, dict[int, Command]]] = {
    0x1806: _commands(
        "NOOP RESET_COUNTERS RESTART - START_APP STOP_APP RESTART_APP RELOAD_APP QUERY_ONE QUERY_ALL "
        "CLEAR_SYS_LOG WRITE_SYS_LOG CLEAR_ER_LOG WRITE_ER_LOG START_PERF_DATA STOP_PERF_DATA "
        "SET_PERF_FILTER_MASK SET_PERF_TRIGGER_MASK OVER_WRITE_SYS_LOG RESET_PR_COUNT SET_MAX_PR_COUNT "
        "DELETE_CDS SEND_MEM_POOL_STATS DUMP_CDS_REGISTRY QUERY_ALL_TASKS"
    ),
    0x1801: _commands(
        "NOOP RESET_COUNTERS ENABLE_EVENT_TYPE DISABLE_EVENT_TYPE SET_EVENT_FORMAT_MODE "
        "ENABLE_APP_EVENT_TYPE DISABLE_APP_EVENT_TYPE ENABLE_APP_EVENTS DISABLE_APP_EVENTS "
        "RESET_APP_COUNTER SET_FILTER ENABLE_PORTS DISABLE_PORTS RESET_FILTER RESET_ALL_FILTERS "
        "ADD_EVENT_FILTER DELETE_EVENT_FILTER WRITE_APP_DATA_FILE WRITE_LOG_DATA_FILE SET_LOG_MODE "
        "CLEAR_LOG"
    ),
    0x1803: _commands(
        "NOOP RESET_COUNTERS SEND_SB_STATS WRITE_ROUTING_INFO ENABLE_ROUTE DISABLE_ROUTE - "
        "WRITE_PIPE_INFO WRITE_MAP_INFO ENABLE_SUB_REPORTING DISABLE_SUB_REPORTING SEND_PREV_SUBS",
        SEND_SB_STATS=(8,),
    ),
    0x1804: _commands(
        "NOOP RESET_COUNTERS LOAD DUMP VALIDATE ACTIVATE DUMP_REGISTRY SEND_REGISTRY DELETE_CDS ABORT_LOAD"
    ),
    0x1805: _commands(
        "NOOP RESET_COUNTERS SEND_DIAGNOSTIC SET_SOURCE SET_STATE ADD_DELAY SUB_DELAY SET_TIME SET_MET "
        "SET_STCF SET_LEAP_SECONDS ADD_ADJUST SUB_ADJUST ADD_ONE_HZ SUB_ONE_HZ SET_SIGNAL",
        SEND_DIAGNOSTIC=(8,),
        **dict.fromkeys(("SET_SOURCE", "SET_STATE", "SET_LEAP_SECONDS", "SET_SIGNAL"), (10,)),
        **dict.fromkeys(("ADD_DELAY", "SUB_DELAY", "SET_TIME", "SET_MET", "SET_STCF"), (16,)),
        **dict.fromkeys(("ADD_ADJUST", "SUB_ADJUST", "ADD_ONE_HZ", "SUB_ONE_HZ"), (16,)),
    ),
    0x1880: _commands(
        "NOOP RESET_COUNTERS ADD_PKT SEND_DATA_TYPES REMOVE_PKT REMOVE_ALL ENABLE_OUTPUT",
        ADD_PKT=(16, SIZED_ENTRY_BYTES),
        SEND_DATA_TYPES=(8,),
        REMOVE_PKT=(12,),
        REMOVE_ALL=(8,),
        ENABLE_OUTPUT=ENABLE_OUTPUT_LENGTHS,
    ),
    0x1884: _commands("NOOP RESET_COUNTERS"),
}
"""Commands by function code, by command MsgId; an app in this table refuses every other code."""
_OTHERS: Final[dict[int, dict[int, str]]] = {
    0x1895: _numbered(
        "NOOP RESET_COUNTERS ENABLE DISABLE ENABLE_GROUP DISABLE_GROUP ENABLE_SYNC SEND_DIAGNOSTIC"
    ),
    0x18B3: {
        **_numbered("NOOP RESET_COUNTERS TX_FILE PLAYBACK_DIR FREEZE THAW SUSPEND RESUME CANCEL ABANDON"),
        **_numbered("SET_PARAM GET_PARAM", 10),
        **_numbered("WRITE_QUEUE ENABLE_DEQUEUE DISABLE_DEQUEUE ENABLE_DIR_POLLING DISABLE_DIR_POLLING", 15),
        **_numbered("PURGE_QUEUE ENABLE_ENGINE DISABLE_ENGINE", 21),
    },
    0x18BB: {
        **_numbered("NOOP RESET_COUNTERS SET_APP_STATE SET_FILTER_FILE SET_FILTER_TYPE SET_FILTER_PARMS"),
        **_numbered("SET_DEST_TYPE SET_DEST_STATE SET_DEST_PATH SET_DEST_BASE SET_DEST_EXT SET_DEST_SIZE", 6),
        **_numbered("SET_DEST_AGE SET_DEST_COUNT CLOSE_FILE GET_FILE_INFO ADD_MID REMOVE_MID CLOSE_ALL", 12),
    },
    0x18FA: {
        **_numbered("NOOP RESET_COUNTERS RESET_PEER"),  # the last two of older releases
        **_numbered("HK HK_NET HK_PEER HK_PEER_SUBS HK_MY_SUBS HK_RESET HK_RESET_PEER", 10),
        110: "RELOAD",
    },
}
"""Names of commands of applications that may have more codes in another release; others are not judged."""

_APPS: Final = "start, stop or replace an application"
_FILES: Final = "write a file on the flight computer"
PRIVILEGED: Final[dict[tuple[int, int], str]] = {
    (0x1806, 2): "restart the processor",
    **dict.fromkeys(((0x1806, code) for code in (4, 5, 6, 7)), _APPS),
    **dict.fromkeys(((0x1806, code) for code in (9, 11, 13, 15, 23, 24)), _FILES),
    (0x1806, 21): "delete what was kept over a restart",
    **dict.fromkeys(((0x1801, code) for code in (17, 18)), _FILES),
    **dict.fromkeys(((0x1801, code) for code in (3, 4, 6, 8, 12)), "silence or shorten events"),
    **dict.fromkeys(((0x1803, code) for code in (3, 7, 8)), _FILES),
    (0x1803, 5): "stop messages to an application",
    **dict.fromkeys(((0x1804, code) for code in (2, 5)), "replace a table"),
    **dict.fromkeys(((0x1804, code) for code in (3, 6)), _FILES),
    **dict.fromkeys(((0x1805, code) for code in (3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14)), "set the clock"),
    (0x1880, 5): "stop all telemetry",
}
"""Effects of commands that change the flight software itself, by command MsgId and function code."""

ROUTE_COMMANDS: Final[dict[int, Command]] = {0: Command("NOOP", (8,)), 1: Command("SET")}
"""Commands of an EDORAS flight app on the command MsgIds of its topics."""


def message_name(msg_id: int) -> str:
    """Return cFE's name for a MsgId, or an empty string."""
    return MSG_ID_NAMES.get(msg_id, "")


def function_code_names(msg_id: int) -> dict[int, str]:
    """Return an app's names for its function codes, of version 1."""
    own = COMMANDS.get(msg_id)
    return {code: item.name for code, item in own.items()} if own else _OTHERS.get(msg_id, {})


def command_name(msg_id: int, function_code: int) -> str:
    """Return an app's name for a function code, or an empty string."""
    return function_code_names(msg_id).get(function_code, "")
