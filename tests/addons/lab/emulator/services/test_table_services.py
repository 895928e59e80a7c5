"""What a real cFS (draco-rc4) said to the same commands in the same order."""

from __future__ import annotations

import pytest

from edoras_tools.addons.lab.emulator import Simulation
from edoras_tools.units import SECOND
from edoras_tools.wire import cfe, sbn

TO, SBN = "TO_LAB_APP.TO_LAB_Subs", "SBN.SBN_ConfTbl"
LOADED = "12: Successful load of '/cf/to_lab_sub.tbl' into 'TO_LAB_APP.TO_LAB_Subs' working buffer"
VALID = (
    "23: Tbl Services assumes 'TO_LAB_APP.TO_LAB_Subs' is valid. No Validation Function has been registered"
)
PENDING = "88: Attempted to load table 'TO_LAB_APP.TO_LAB_Subs' while previous load is still pending"
ABORTED = "21: Table Load Aborted for 'TO_LAB_APP.TO_LAB_Subs'"
NOT_ABORTED = "69: Cannot abort load of 'TO_LAB_APP.TO_LAB_Subs'. No load started."
NOT_ACTIVATED = "70: Cannot activate table 'TO_LAB_APP.TO_LAB_Subs'. No Inactive image available"


def load(name):
    return 2, name.encode().ljust(64, b"\0")


def of(code, table=TO, before=b""):
    return code, before + table.encode().ljust(40, b"\0")


VALIDATE, ACTIVATE, ABORT = of(4, before=bytes(2)), of(5), of(9)


@pytest.fixture(scope="module")
def simulation():
    simulation = Simulation(scenario="two-rovers", bridges=False).boot()
    list(simulation.run(until_ns=2 * SECOND))
    return simulation


def send(simulation, code, payload=b"", msg_id=0x1804):
    """Send a command to an emulated cFS; return what it says, without the bus' losses, and what it sends."""
    simulation.cfs.receive_datagram(simulation.cfs.ci_endpoint, cfe.emit_command(msg_id, code, payload))
    before = len(simulation.cfs.console)
    sent = list(simulation.run(until_ns=simulation.now + SECOND))
    texts = [text.removeprefix("EVS Port1 66/1/") for _, text in list(simulation.cfs.console)[before:]]
    return [text for text in texts if "Msg Limit Err" not in text], sent


@pytest.mark.parametrize(
    ("commands", "said"),
    [
        ([load("/cf/to_lab_sub.tbl"), VALIDATE, ACTIVATE, ACTIVATE], [LOADED, VALID]),
        (
            [load("/cf/to_lab_sub.tbl"), VALIDATE, ABORT, ABORT, ACTIVATE],
            [PENDING, VALID, ABORTED, NOT_ABORTED, NOT_ACTIVATED],
        ),
        ([VALIDATE], ["66: No Inactive Buffer for Table 'TO_LAB_APP.TO_LAB_Subs' present"]),
        ([of(4, before=b"\1\0")], [VALID]),
        ([load("/cf/to_lab_sub.tbl"), load("/cf/to_lab_sub.tbl"), ABORT], [LOADED, LOADED, ABORTED]),
        ([load("/cf/none.tbl")], ["53: Unable to open file '/cf/none.tbl' for table load, Status = -1"]),
        ([(2, b"/cf/x")], ["52: Invalid msg length -- ID = 0x1804, CC = 2, Len = 13, Expected = 72"]),
        (
            [of(4, "NO.Table", bytes(2)), of(5, "NO.Table"), of(9, "NO.Table")],
            ["57: Unable to locate 'NO.Table' in Table Registry"] * 3,
        ),
    ],
)
def test_it_answers_as_the_real_one(simulation, commands, said):
    texts = [text for command in commands for text in send(simulation, *command)[0]]
    assert texts == [f"CFE_TBL {text}" for text in said]


def test_a_load_ends_with_its_application():
    simulation = Simulation(bridges=False).boot()
    send(simulation, *load("/cf/to_lab_sub.tbl"))
    send(simulation, 6, b"TO_LAB_APP".ljust(20, b"\0"), msg_id=0x1806)
    list(simulation.run(until_ns=simulation.now + 8 * SECOND))
    assert send(simulation, *ACTIVATE)[0] == [f"CFE_TBL {NOT_ACTIVATED}"]


@pytest.fixture
def connected():
    """Return a cFS whose SBN is connected to the flight bridge, 66:3."""
    simulation = Simulation(scenario="two-rovers").boot()
    list(simulation.run(until_ns=8 * SECOND))
    return simulation


def disconnects(sent):
    return [
        item
        for item in sent
        if item.source.port == 2234 and item.payload[2:3] == bytes([sbn.MsgType.DISCONNECT])
    ]


def test_sbn_begins_anew_with_its_new_table(connected):
    send(connected, *load("/cf/sbn_conf_tbl.tbl"))
    texts, sent = send(connected, *of(5, SBN))
    texts = [text for text in texts if "version match" not in text]
    assert texts[:14] == [
        "SBN 7: invalid message length (Name=reloadtbl ID=0x006E CC=110 Len=12 Expected=8)",
        "SBN 7: reload tbl command",
        "SBN 4: re-initializing SBN with new configuration...",
        "SBN 4: unloading configuration",
        "SBN 259: unloaded peer: 0",
        "SBN 259: peer 66:3 - sending disconnect",
        "SBN 5: Disconnected from peer 66:3.",
        "SBN 259: unloaded peer: 1",
        "SBN 4: Terminated net: 0",
        "SBN 8: unsubscribed 0 message id's from ProcessorID 2",
        "SBN 5: ERROR: could not disconnect peer: already not connected to peer 66:2",
        "SBN 8: unsubscribed 0 message id's from ProcessorID 3",
        "SBN 5: ERROR: could not disconnect peer: already not connected to peer 66:3",
        "CFE_TBL 37: SBN Successfully Updated 'SBN.SBN_ConfTbl'",
    ]
    assert len(disconnects(sent)) == 1
    list(connected.run(until_ns=connected.now + 4 * SECOND))
    assert "SBN_3_66_Pipe" in connected.cfs.bus.pipes  # the bridge is connected again


def test_sbn_is_dead_after_a_reload_without_a_new_table(connected):
    """As in ``f2_sbn_announce_reload``: DISCONNECT, then three errors each wake-up, to the end."""
    assert any("wrong size" in text for text in send(connected, 110, msg_id=0x18FA)[0])
    texts, sent = send(connected, 110, bytes(4), msg_id=0x18FA)
    assert "SBN 5: ERROR: could not reload SBN configuration: could not clean up SBN" in texts
    assert len(disconnects(sent)) == 1
    texts, sent = send(connected, 0)
    errors = ["SBN 3: err from rcvmsg on sub pipe", "SBN 5: SBN_CheckSubscriptionPipe failed."]
    said = ["CFE_SB 19: Rcv Err:PipeId 1441805 does not exist,app SBN", *errors]
    assert texts.count(said[0]) == 5
    assert [item for item in texts if item in said][:3] == said
    assert not [item for item in sent if item.source.port == 2234]
