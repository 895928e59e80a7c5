"""Applications stop, start and restart by command, as on the console of a real cFS."""

from __future__ import annotations

from string import Formatter

import pytest

from edoras_tools.addons.lab.emulator import Simulation
from edoras_tools.addons.lab.emulator.services.applications import CORE
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire import cfe, sbn


class Console:
    """An emulated cFS that gets commands, and what it says after each."""

    def __init__(self):
        self.simulation = Simulation(scenario="rover", bridges=False)
        list(self.simulation.run(2 * SECOND))

    def says(self, function_code, payload=b"", wait_ns=8 * SECOND, msg_id=0x1806):
        simulation = self.simulation
        before = len(simulation.cfs.console)
        packet = cfe.emit_command(msg_id, function_code, payload)
        simulation.feed(simulation.now, simulation.cfs.ci_endpoint, packet)
        self.sent = list(simulation.run(simulation.now + wait_ns))
        return [text.partition("66/1/")[2] or text for _, text in list(simulation.cfs.console)[before:]]


@pytest.fixture
def console():
    return Console()


def name(app):
    return app.encode().ljust(20, b"\0")


def start(app, file):
    return name(app) + name("Main") + file.encode().ljust(64, b"\0") + bytes(8)


def test_an_application_stops_and_starts_again(console):
    assert console.says(5, name("EDORAS_GEN")) == ["CFE_ES 8: Stop Application EDORAS_GEN Completed."]
    assert "EDORAS_GEN_PIPE" not in console.simulation.cfs.bus.pipes
    assert console.says(5, name("EDORAS_GEN")) == [
        "CFE_ES 36: Stop Application EDORAS_GEN, GetAppIDByName failed. RC = 0xC4000002."
    ]
    assert console.says(4, start("EDORAS_GEN", "/cf/edoras_gen.so")) == [
        "EDORAS_GEN 1: EDORAS_GEN initialized, command MID 0x18F0",
        "CFE_ES 6: Started EDORAS_GEN from /cf/edoras_gen.so, AppID = 1114124",
    ]
    assert console.says(4, start("EDORAS_GEN", "/cf/edoras_gen.so")) == [
        "CFE_ES 26: Failed to start EDORAS_GEN from /cf/edoras_gen.so, RC = 0xC400002E"
    ]
    assert console.says(4, start("NEW", "/cf/new.so")) == [
        "CFE_ES 26: Failed to start NEW from /cf/new.so, RC = 0xC4000009"
    ]


@pytest.mark.parametrize(
    ("code", "verb", "refused", "unknown"),
    [(5, "Stop", 35, 36), (6, "Restart", 38, 39), (7, "Reload", 42, 43)],
)
def test_what_cannot_end_says_why(console, code, verb, refused, unknown):
    assert console.says(code, name("CFE_SB"), SECOND) == [
        f"CFE_ES {refused}: {verb} Application CFE_SB Failed, RC = 0xC4000001"
    ]
    assert console.says(code, name("NOBODY"), SECOND) == [
        f"CFE_ES {unknown}: {verb} Application NOBODY, GetAppIDByName failed. RC = 0xC4000002."
    ]


def test_command_ingest_restarts_and_what_is_in_its_socket_is_lost(console):
    simulation, simple = console.simulation, cfe.emit_command(0x1884, 0)
    first = simulation.apps.ci
    for after_ns in (3 * SECOND, 7 * SECOND):
        simulation.feed(simulation.now + after_ns, simulation.cfs.ci_endpoint, simple)
    said = console.says(6, name("CI_LAB_APP"), 9 * SECOND)
    assert [text for text in said if "CFE_SB 17" not in text] == [
        "CFE_ES 10: Restart Application CI_LAB_APP Completed, AppID=1114124",
        "CI_LAB_APP 3: CI Lab Initialized. Emulated",
        "CI_LAB_APP 5: CI: NOOP command",
    ]
    assert simulation.apps.ci is not first
    assert simulation.apps.ci.ingest_packets == 1


def test_telemetry_output_restarts_forgets_its_destination_and_has_another_port(console):
    enable = cfe.emit_command(0x1880, 6, b"127.0.0.1".ljust(16, b"\0"))
    simulation = console.simulation
    simulation.feed(simulation.now, simulation.cfs.ci_endpoint, enable)
    before = {item.source for item in simulation.run(simulation.now + 3 * SECOND)}
    console.says(6, name("TO_LAB_APP"), 2 * SECOND)
    console.says(0, wait_ns=10 * SECOND)
    assert console.sent == []
    console.says(6, b"127.0.0.1".ljust(16, b"\0"), 3 * SECOND, msg_id=0x1880)
    after = {item.source for item in console.sent}
    assert len(before) == len(after) == 1
    assert before != after


def test_the_processor_restarts(console):
    assert console.says(2, b"\7\0", SECOND) == ["CFE_ES 24: Invalid cFE restart type: 7"]
    simulation = console.simulation
    simulation.cfs.bus.counters.msg_limits = 5
    told = console.says(2, b"\1\0", 1500 * MILLISECOND)
    assert told == []
    told = console.says(0, wait_ns=2 * SECOND)
    assert any("cFE ES Initialized" in text for text in told)
    assert any("No-op" in text for text in told) is False  # nobody listened when it came
    assert simulation.cfs.bus.counters.msg_limits == 0
    assert simulation.cfs.boots == 2
    assert any("No-op" in text for text in console.says(0))


@pytest.mark.parametrize(
    ("msg_id", "says"),
    [
        (0x1806, "CFE_ES 22: Invalid ground command code: ID = 0x1806, CC = 100"),
        (0x1801, "CFE_EVS 15: Invalid command code -- ID = 0x00001801, CC = 100"),
        (0x1803, "CFE_SB 42: Invalid Cmd, Unexpected Command Code 100"),
        (0x1805, "CFE_TIME 27: Invalid command code -- ID = 0x1805, CC = 100"),
        (0x1804, "CFE_TBL 51: Invalid command code -- ID = 0x1804, CC = 100"),
    ],
)
def test_a_code_that_a_core_application_does_not_have(console, msg_id, says):
    assert console.says(100, wait_ns=SECOND, msg_id=msg_id) == [says]


EVENTS = [event for app in CORE for event in (app.initialized, app.no_op, app.bad_length) if event]


@pytest.mark.parametrize("event", EVENTS, ids=lambda item: f"{item.app} {item.event_id}")
def test_a_pattern_reads_what_the_text_writes(event):
    fields = [(name, form or "") for _, name, form, _ in Formatter().parse(event.text) if name]
    values = {name: 0x1827 + at if form else f"APP_{at}" for at, (name, form) in enumerate(fields)}
    found = event.pattern.fullmatch(event.text.format(**values))
    bases = {name: 10 if form.endswith("d") else 16 for name, form in fields if form}
    assert values == {
        name: int(text, bases[name]) if name in bases else text for name, text in found.groupdict().items()
    }
    assert len(event.phrase) > 5


def test_what_answers_by_an_event_does_so_here():
    run = Simulation(scenario="rover", bridges=False, start_ns=0).boot()
    start_s = run.now // SECOND
    sent = [
        (0x1827, 0, b""),
        (0x1806, 1, b""),
        (0x1801, 9, b"CFE_SB"),
        (0x1801, 9, b"CFE_SB".ljust(20, b"\0")),
    ]
    for at, (msg_id, code, payload) in enumerate(sent, 1):
        packet = cfe.emit_command(msg_id, code, payload)
        run.feed((start_s + at) * SECOND, run.cfs.ci_endpoint, packet)
    before = len(run.cfs.console)
    list(run.run((start_s + 8) * SECOND))
    said = [text.partition("66/1/")[2] for _, text in list(run.cfs.console)[before:]]
    assert said == [
        "EDORAS_APP 3: Edoras App: NOOP command Emulated",
        "CFE_ES 4: Reset Counters command",
        "CFE_EVS 43: Invalid msg length: ID = 0x1801,  CC = 9, Len = 14, Expected = 28",
    ]


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
