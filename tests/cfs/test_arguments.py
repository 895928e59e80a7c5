"""The arguments of commands: as real commands in captures have them, and both ways."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.cfs.arguments import ARGUMENTS, CHANGES, arguments_of, command_text
from edoras_tools.cfs.names import COMMANDS

REAL = [
    # What was sent to a real cFS, and obeyed.
    (0x1880, 2, "2708000000000100", {"stream": 0x827, "priority": 0, "reliability": 0, "limit": 1}),
    (0x1880, 2, "2708000000001400", {"stream": 0x827, "priority": 0, "reliability": 0, "limit": 20}),
    (0x1880, 4, "29080000", {"stream": 0x829}),
    (0x1880, 5, "", {}),
    (0x1880, 6, "3132372e302e302e3100000000000000", {"address": "127.0.0.1"}),
    (0x1801, 14, "4346455f53420000000000000000000000000000", {"application": "CFE_SB"}),
    (0x1806, 5, "53424e0000000000000000000000000000000000", {"application": "SBN"}),
    (0x1806, 6, "45444f5241535f41505000000000000000000000", {"application": "EDORAS_APP"}),
    (0x1805, 11, "100e000000000000", {"seconds": 3600, "microseconds": 0}),
    (0x1805, 12, "201c000000000000", {"seconds": 7200, "microseconds": 0}),
    (0x1805, 8, "0000000000000000", {"seconds": 0, "microseconds": 0}),
    (0x18FA, 110, "00000000", {"parameter": 0}),
    (
        0x1806,
        4,
        b"SBN".ljust(20, b"\0").hex()
        + b"SBN_AppMain".ljust(20, b"\0").hex()
        # stack size, exception action and priority as a real start had them
        + b"/cf/sbn.so".ljust(64, b"\0").hex()
        + "a086010000003200",
        {
            "application": "SBN",
            "entry_point": "SBN_AppMain",
            "file_name": "/cf/sbn.so",
            "stack_size": 100_000,
            "exception_action": 0,
            "priority": 50,
        },
    ),
]


@pytest.mark.parametrize(("msg_id", "code", "payload", "values"), REAL)
def test_real_commands(msg_id, code, payload, values):
    assert arguments_of(msg_id, code, bytes.fromhex(payload)) == values
    assert ARGUMENTS[msg_id, code].size == len(payload) // 2
    assert ARGUMENTS[msg_id, code].emit(values).hex() == payload


def test_names_and_lengths_are_those_of_the_table_of_commands():
    for (msg_id, code), layout in ARGUMENTS.items():
        if msg_id in COMMANDS:
            command = COMMANDS[msg_id][code]
            assert command.name == layout.title
            assert not command.lengths or 8 + layout.size in command.lengths


@pytest.mark.parametrize(
    ("msg_id", "code", "values", "text"),
    [
        (0x1880, 2, {"stream": 0x827, "limit": 1}, "ADD_PKT 0x0827, limit 1"),
        (0x1880, 5, {}, "REMOVE_ALL"),
        (0x1880, 6, {"address": "10.0.0.1"}, "ENABLE_OUTPUT 10.0.0.1"),
        (0x1805, 12, {"seconds": 7200, "microseconds": 0}, "SUB_ADJUST 7200 s"),
        (0x1805, 11, {"seconds": 1, "microseconds": 500_000}, "ADD_ADJUST 1.5 s"),
        (0x1806, 2, {"restart_type": 1}, "RESTART restart type processor (1)"),
        (0x1806, 5, {"application": "SBN"}, "STOP_APP SBN"),
    ],
)
def test_a_command_in_words(msg_id, code, values, text):
    assert command_text(msg_id, code, values) == text


def test_an_entry_with_a_packet_size_has_its_limit_behind_that():
    sized = arguments_of(0x1880, 2, struct.pack("<IHBBB3x", 0x827, 116, 0, 1, 12))
    assert sized == {"stream": 0x827, "priority": 0, "reliability": 1, "limit": 12}


@given(st.sampled_from(sorted(ARGUMENTS)), st.binary(max_size=160), st.booleans())
def test_any_bytes_are_arguments_or_none(key, payload, big_endian):
    values = arguments_of(*key, payload, big_endian=big_endian)
    assert (values is None) == (key not in CHANGES)
    if values is not None:
        assert command_text(*key, values).startswith(ARGUMENTS[key].title)
        names = [slot.field.name for slot in ARGUMENTS[key].slots if slot.field.name != "spare"]
        assert list(values) == names[: len(values)]
        assert len(payload) < ARGUMENTS[key].size or len(values) == len(names)


def test_a_big_endian_flight_computer():
    assert arguments_of(0x1805, 7, bytes.fromhex("0000000f00000000"), big_endian=True)["seconds"] == 15
    assert arguments_of(0x1805, 7, b"\0\0") == {}


def test_a_name_that_is_whole_in_a_cut_frame():
    name = b"TO_LAB_APP\0"
    assert arguments_of(0x1806, 4, name, cut=True) == {"application": "TO_LAB_APP"}
    assert arguments_of(0x1806, 4, name[:-1], cut=True) == {}
    assert arguments_of(0x1806, 4, name[:-1]) == {"application": "TO_LAB_APP"}
