"""Commands to Telemetry Output, held against its own counters in 0x880."""

from __future__ import annotations

import pytest

from edoras_tools.cfs import telemetry_output
from edoras_tools.wire import cfe
from tests.support.balance import wrong_rows

NOOP = cfe.emit_command(telemetry_output.COMMAND_MSG_ID, telemetry_output.NOOP, b"", sequence_flags=0)
UNKNOWN = cfe.emit_command(telemetry_output.COMMAND_MSG_ID, 77, b"", sequence_flags=0)


OTHER = cfe.emit_command(0x1806, 0, b"", sequence_flags=0)
"""A command to another application: CI counts it, and Telemetry Output does not."""


def commanded(lab, came, shown):
    """Return a rover to whose CI some commands came, and the capture that shows others in their place."""
    sent, _ = lab.simulate(
        seconds=30, hz=1.0, feeds=tuple((6.0 + at, 1234, packet) for at, packet in enumerate(came))
    )
    return lab.merged(
        sent, *(lab.at(6.0 + at, lab.ground, lab.ci, packet) for at, packet in enumerate(shown))
    )


def unaccounted(found):
    rows = [row for row in found.balance if row.msg_id == telemetry_output.COMMAND_MSG_ID]
    assert wrong_rows(rows) == []
    return {row.hop: row.unaccounted for row in rows if row.unaccounted}


@pytest.mark.parametrize("packet", [NOOP, UNKNOWN], ids=["taken", "refused"])
def test_commands_that_it_counted_arrived(packet, lab):
    found = lab.examine(commanded(lab, [packet] * 12, [packet] * 12))
    assert unaccounted(found) == {}
    fates = [
        item
        for item in found.case.commands.fates.values()
        if item.stream.msg_id == telemetry_output.COMMAND_MSG_ID
    ]
    assert [item.commanded for item in fates] == [12]


def test_commands_that_ci_took_and_it_did_not_count_are_unaccounted_for(lab):
    found = lab.examine(commanded(lab, [NOOP] * 9 + [OTHER] * 3, [NOOP] * 12))
    assert unaccounted(found) == {telemetry_output.NAME: 3}
    (verdict,) = [item for item in found.verdicts if item.rule == "crossing_loss"]
    assert "Telemetry Output counted 9 commands meanwhile" in verdict.reason
    assert found.unaccounted == 3


def test_a_counter_that_was_set_back_tells_nothing(lab):
    reset = cfe.emit_command(telemetry_output.COMMAND_MSG_ID, telemetry_output.RESET, b"", sequence_flags=0)
    packets = [NOOP] * 6 + [reset] + [NOOP] * 5
    assert unaccounted(lab.examine(commanded(lab, packets, packets))) == {}
