"""What is shipped for cFE's own services, held to the wire's measured sizes and to flights that ran."""

import re
from contextlib import closing
from functools import partial

import numpy as np
import pytest
from places import CAPTURES

from edoras_tools.cfs.arguments import ARGUMENTS, BARE_TOO, TAILS
from edoras_tools.decode import ColumnDecoder, Context
from edoras_tools.io.formats.open import open_file
from edoras_tools.ros.library import STRINGS, parse_definition
from edoras_tools.structs import shipped_structs
from edoras_tools.structs.bindings import payloads
from edoras_tools.structs.files import shipped_layout as layout
from edoras_tools.structs.shapes import COMMANDED, PACKETS

CAPTURES = sorted((CAPTURES).glob("*.pcap*"))
MEASURED = {
    0x0800: 164,
    0x0801: 160,
    0x0803: 44,
    0x0804: 300,
    0x0805: 48,
    0x0806: 216,
    0x080A: 844,
    0x080B: 200,
    0x0808: 172,
    0x0880: 20,
    0x0884: 40,
}
"""Bytes of the whole packets, header included, as they were on a wire."""
CORE = (0x0800, 0x0801, 0x0803, 0x0804, 0x0805)
FALLING = re.compile(r"command_(error_)?counter|message_send_error_counter")
"""What a ground command resets, and what 8 bits hold for less than a second when a link goes wrong; all other
counters only grow, or wrap around."""


def test_every_packet_that_is_listed_is_described():
    bound = layout().bindings.items()
    assert {key.msg_id: name for key, name in bound if key.function_code is None} == PACKETS
    commands = {key.msg_id for key, _ in bound if key.function_code is not None and key.port is None}
    assert commands == {*COMMANDED}
    taken = {(key.msg_id, key.function_code) for key, _ in bound if key.msg_id in commands}
    assert taken == {key for key, item in ARGUMENTS.items() if item.size} - BARE_TOO
    robots = {48: "robot_command", 56: "robot_pose", 64: "robot_state"}
    assert {key.function_code: name for key, name in bound if key.port is not None} == robots


@pytest.mark.parametrize("bound", shipped_structs().all, ids=lambda bound: bound.name)
def test_sizes_are_those_on_the_wire(bound):
    key = bound.key
    size = key.function_code or MEASURED.get(key.msg_id, 0) - 16
    if bound.command:
        arguments = ARGUMENTS[key.msg_id, key.function_code]
        size = arguments.size + TAILS.get((key.msg_id, arguments.title), 0)
    assert bound.fits(size)
    assert not bound.fits(size + 1)
    assert not bound.fits(0 if bound.command else 3)


def messages(path):
    """Yield (MsgId, where from, values) of every packet of cFE's own."""
    decoder = ColumnDecoder(Context())
    with closing(open_file(path)) as source:
        for batch in source.batches():
            columns = decoder.decode(batch)
            column = partial(getattr, columns)
            found = payloads(shipped_structs(), column, partial(getattr, batch), batch.data)
            for held in shipped_structs().payloads_of(found, column, batch.data):
                encoded = held.encode()
                for row, start, size in zip(held.rows, encoded.start, encoded.size, strict=True):
                    origin = int(columns.link[row]), int(columns.processor_id[row])
                    cdr = encoded.data[start : start + size].tobytes()
                    yield held.bound, origin, shipped_structs().types.decode(held.bound.type, cdr)


@pytest.mark.each(3)
@pytest.mark.long("d3_cpu1_cpu2*", "c1_tlm*")
@pytest.mark.parametrize("path", CAPTURES, ids=lambda path: path.stem)
def test_values_make_sense_all_along(path):
    last, seen = {}, {}
    for bound, origin, values in messages(path):
        key = bound.key.msg_id, origin
        seen[key] = seen.get(key, 0) + 1
        before = last.get(key, values)
        if before["header"]["sequence_count"] > values["header"]["sequence_count"]:
            before = values  # it was started anew
        for name, value in values.items():
            if isinstance(value, str):
                assert value.replace("\n", "").isprintable(), (bound.name, name, value)
            if name.endswith(("_counter", "_sent", "_entries", "ingest_packets")) and isinstance(value, int):
                grown = value - before[name]
                if str(bound.member([name]).type) == "uint8":
                    grown = (grown + 128) % 256 - 128
                assert grown >= 0 or FALLING.fullmatch(name), (bound.name, name, before[name], value)
        last[key] = values
    assert {msg_id for msg_id, _ in seen} >= set(CORE)
    for (msg_id, _), values in last.items():
        SENSIBLE.get(msg_id, lambda _: None)(values)


def executive(it):
    assert (it["registered_core_apps"], it["max_processor_resets"]) == (5, 2)
    assert 0 < it["system_log_bytes_used"] <= it["system_log_size"] == 3072
    assert it["registered_tasks"] >= it["registered_core_apps"] + it["registered_external_apps"]
    assert (it["cfe_major"], it["osal_major"], it["psp_major"]) == (6, 5, 1)


def events(it):
    apps = [item for item in it["app_data"] if item["app_id"]]
    assert it["message_format"] == 1
    assert len(it["app_data"]) == 16
    assert len(apps) >= 8
    assert all(item["app_id"] >> 16 == 0x11 and item["enabled"] for item in apps)
    assert 0 < sum(item["messages_sent"] for item in apps) <= it["messages_sent"] + 8


def bus(it):
    assert it["memory_in_use"] < it["unmarked_memory"] < 1 << 20
    assert it["memory_pool_handle"] >> 16 == 0x14


def tables(it):
    assert 0 < it["tables"] < 20
    assert re.fullmatch(r"\w+\.\w+", it["last_updated_table"])
    assert 1_000_000 <= it["last_update_time"]["seconds"] < 1_010_000


def time(it):
    assert (it["clock_state"], it["leap_seconds"], it["stcf_seconds"]) == (-1, 37, 1_000_000)
    assert 0 < it["met_seconds"] < 1_000_000


SENSIBLE = {0x0800: executive, 0x0801: events, 0x0803: bus, 0x0804: tables, 0x0805: time}


def test_time_goes_on_a_second_a_second():
    seconds = [
        values["met_seconds"] + values["met_subseconds"] / 2**32
        for bound, _, values in messages(CAPTURES[0])
        if bound.key.msg_id == 0x0805
    ]
    assert len(seconds) > 50
    assert np.allclose(np.diff(seconds), 1, atol=0.05)


def test_names_are_such_as_ros_takes():
    for name, definition in shipped_structs().definitions.items():
        package, _, last = name.partition("/msg/")
        assert re.fullmatch(r"[a-z][a-z0-9_]*", package)
        assert re.fullmatch(r"[A-Z][A-Za-z0-9]*", last)
        for item in definition.fields:
            assert re.fullmatch(r"[a-z](?!.*__)(?:[a-z0-9_]*[a-z0-9])?", item.name), (name, item.name)
            assert item.type in STRINGS or "/" not in item.type or item.type in shipped_structs().definitions
        for item in definition.constants:
            assert re.fullmatch(r"[A-Z](?:[A-Z0-9_]*[A-Z0-9])?", item.name), item.name


def test_msg_files_say_what_the_definitions_say():
    from edoras_tools.structs.bindings import Bindings

    made = Bindings([layout()])
    for name, text in made.texts.items():
        assert parse_definition(name, text, name) == made.definitions[name]
