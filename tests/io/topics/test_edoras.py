from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from edoras_tools.io.topics.edoras import event_messages, software_bus_messages
from edoras_tools.io.topics.messages import RECORD_BYTES
from edoras_tools.links.bare import CI, TO
from edoras_tools.links.sbn import SBN
from edoras_tools.model import Columns, PacketBatch
from edoras_tools.wire.arrays import copy_rows

NOW = 1_795_000_000_250_000_000


def packets(*payloads, msg_id=0x0808, link=TO, header=16):
    """Telemetry packets one after another in a buffer; headers of 0xA5."""
    data = b"".join(b"\xa5" * header + payload for payload in payloads) + bytes(64)
    length = np.array([header + len(payload) for payload in payloads], dtype=np.int32)
    offset = np.cumsum(length, dtype=np.int64) - length
    count = len(payloads)
    blank = {
        name: np.zeros(count, dtype=np.int64)
        for name in PacketBatch.__struct_fields__
        if name not in {"data", "ipv6"}
    }
    batch = PacketBatch(
        **blank | {"data": np.frombuffer(data, dtype=np.uint8), "time_ns": np.full(count, NOW)}
    )
    columns = Columns(**{name: np.zeros(count, dtype=np.int64) for name in Columns.__struct_fields__})
    return batch, replace(
        columns,
        link=np.full(count, link, dtype=np.uint8),
        processor_id=np.full(count, 4, dtype=np.uint32),
        packet_offset=offset,
        packet_length=length,
        msg_id=np.full(count, msg_id, dtype=np.int32),
        header_length=np.full(count, header, dtype=np.uint8),
        sequence_count=np.arange(count, dtype=np.uint16),
    )


def event(name=b"CFE_SB", number=17, kind=3, spacecraft=66, processor=1, text=b"Msg Limit Err", size=156):
    return struct.pack("<20sHHII122s2x", name, number, kind, spacecraft, processor, text)[:size]


def decode(types, type_name, messages):
    """The values of each message, its bytes put together a row at a time."""
    found = []
    for row in range(len(messages)):
        start = int(messages.offset[row])
        body = messages.data[start : start + int(messages.length[row])].tobytes()
        record = messages.heads(slice(None))[row].tobytes() + body
        assert struct.unpack_from("<BQ", record) == (5, len(record) - 9)
        found.append(types.decode(type_name, record[RECORD_BYTES:]))
    return found


def events(types, batch, columns):
    messages = event_messages(batch, columns, 7, batch.time_ns)
    return decode(types, "rcl_interfaces/msg/Log", messages), messages


@pytest.mark.parametrize(
    ("kind", "level"), [(1, 10), (2, 20), (3, 40), (4, 50), (0, 30), (5, 30), (65535, 30)]
)
def test_levels(types, kind, level):
    (values,), _ = events(types, *packets(event(kind=kind)))
    assert values["level"] == level


def test_an_event_as_a_log(types):
    (values,), _ = events(types, *packets(event()))
    assert values == {
        "stamp": {"sec": 1_795_000_000, "nanosec": 250_000_000},
        "level": 40,
        "name": "CFE_SB",
        "msg": "Msg Limit Err",
        "file": "",
        "function": "66/1",
        "line": 17,
    }


TEXT = st.binary(max_size=122)


@given(
    st.lists(
        st.tuples(st.binary(max_size=20), TEXT, st.integers(0, 2**32 - 1), st.sampled_from([156, 154, 152]))
    )
)
def test_any_bytes_make_valid_logs(types, made):
    payloads = [
        event(name=name, text=text, processor=processor, size=size) for name, text, processor, size in made
    ]
    found, messages = events(types, *packets(*payloads))
    assert len(found) == len(made)
    for (name, text, processor, _), values in zip(made, found, strict=True):
        assert values["name"] == readable(name)
        assert values["msg"] == readable(text[:120])
        assert values["function"] == f"66/{processor}"
    assert messages.rows.tolist() == list(range(len(made)))


def readable(text):
    return "".join(chr(byte) if byte < 0x80 else "?" for byte in text.split(b"\0")[0])


def test_what_is_no_event(types):
    short = packets(event(size=151))
    command_link = packets(event(), link=CI)
    other = packets(event(), msg_id=0x0801)
    for case in (short, command_link, other):
        assert events(types, *case)[0] == []


@pytest.mark.parametrize("link", [TO, SBN])
@pytest.mark.parametrize(("header", "order"), [(12, "<"), (16, "<"), (20, "<"), (16, ">")])
def test_software_bus_housekeeping(types, link, header, order):
    payload = struct.pack(f"{order}11BxHHIII", *range(1, 12), 0x0102, 0x0304, 0x0A0B0C0D, 512, 1024)
    batch, columns = packets(payload, payload[:-1], msg_id=0x0803, link=link, header=header)
    messages = software_bus_messages(batch, columns, 3, batch.time_ns, big_endian=order == ">")
    (values,) = decode(types, "edoras_msgs/msg/SoftwareBusHousekeeping", messages)
    assert values == {
        "stamp": {"sec": 1_795_000_000, "nanosec": 250_000_000},
        "processor_id": 4,
        "memory_pool_handle": 0x0A0B0C0D,
        "memory_in_use": 512,
        "unmarked_memory": 1024,
        "pipe_overflow_error_counter": 0x0102,
        "message_limit_error_counter": 0x0304,
        "command_counter": 1,
        "command_error_counter": 2,
        "no_subscribers_counter": 3,
        "message_send_error_counter": 4,
        "message_receive_error_counter": 5,
        "internal_error_counter": 6,
        "create_pipe_error_counter": 7,
        "subscribe_error_counter": 8,
        "pipe_options_error_counter": 9,
        "duplicate_subscriptions_counter": 10,
        "get_pipe_id_by_name_error_counter": 11,
        "link": int(link),
    }


def test_copy_rows_of_no_rows():
    nothing = np.zeros(0, dtype=np.int64)
    copy_rows(np.zeros(0, np.uint8), nothing, np.zeros(0, np.uint8), nothing, nothing)
