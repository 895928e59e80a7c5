"""What is read of payloads at once is what the layout's own reader gives of each."""

from __future__ import annotations

import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st

from edoras_tools.decode import ColumnDecoder, Context, Options
from edoras_tools.diagnosis.evidence.payloads import Payloads, events_in
from edoras_tools.io.frames.frame_batch import frames_of
from edoras_tools.io.frames.linklayer import Demux
from edoras_tools.model import Endpoint
from edoras_tools.wire import cfe

TO, GROUND = Endpoint("10.0.0.1", 2235), Endpoint("10.0.0.2", 1235)
OPTIONS = Options(telemetry_header=16, extended_header=False)
WHOLE = cfe.EVENT.emit(
    {"app_name": "SAMPLE_APP", "event_id": 7, "event_type": 3, "spacecraft_id": 66, "message": "hi \u00e9"}
)


@given(st.lists(st.binary(min_size=0, max_size=cfe.EVENT.size + 9), min_size=1, max_size=5))
@example([WHOLE, WHOLE[:-2], WHOLE[:-3], WHOLE + b"more"])
@example([b"a\0b" + bytes(17) + b"\xff" * 136, b" \t" * 78])
def test_events(payloads):
    """Events that are whole but for two bytes, with any text; what follows a short one is no part of it."""
    sent = [cfe.emit_telemetry(cfe.EVENT_MSG_ID, body) for body in payloads]
    batch = Demux().demux(frames_of([(at * 1000, TO, GROUND, data) for at, data in enumerate(sent)], 5))
    found = list(events_in(batch, ColumnDecoder(Context(options=OPTIONS)).decode(batch), base=40))
    wanted = [
        (row, cfe.EVENT.parse(body.ljust(cfe.EVENT.size, b"\0")))
        for row, body in enumerate(payloads)
        if len(body) >= cfe.EVENT.size - 2
    ]
    assert [
        (item.row, item.number, item.time_ns, item.app, item.event_id, item.event_type, item.sender)
        for item in found
    ] == [
        (
            40 + row,
            5 + row,
            row * 1000,
            read["app_name"],
            read["event_id"],
            read["event_type"],
            f"{read['spacecraft_id']}:{read['processor_id']}",
        )
        for row, read in wanted
    ]
    assert [item.message for item in found] == [read["message"].strip() for _, read in wanted]


def test_commands_that_change_what_a_cfs_does():
    """With their arguments, as far as they are there; not those that ask only."""
    ci = Endpoint("10.0.0.1", 1234)
    add = cfe.emit_command(0x1880, 2, bytes.fromhex("2708000000000100"))
    sent = [
        (GROUND, ci, cfe.emit_command(0x1806, 5, b"SBN".ljust(20, b"\0"))),
        (GROUND, ci, cfe.emit_command(0x1806, 5, b"SBN")),
        (GROUND, ci, cfe.emit_command(0x1806, 8, b"SBN".ljust(20, b"\0"))),
        (GROUND, ci, add),
        (GROUND, ci, cfe.emit_command(0x1827, 2, bytes(24))),
    ]
    batch = Demux().demux(frames_of([(at, *item) for at, item in enumerate(sent)], 1))
    payloads = Payloads()
    payloads.add(batch, ColumnDecoder(Context(options=OPTIONS)).decode(batch), base=40)
    assert [(item.row, str(item)) for item in payloads.commands] == [
        (40, "STOP_APP SBN"),
        (41, "STOP_APP SBN"),
        (43, "ADD_PKT 0x0827, limit 1"),
    ]
    assert [item.row for item in payloads.over(np.array([43]), 50).commands] == [0]
