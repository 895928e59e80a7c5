"""Sweeps of the emulated cFS, in simulated time and on sockets: the limits measured on the real one."""

from __future__ import annotations

import os
import re
import signal
import socket

import pytest
from msgspec.structs import replace
from places import MISSIONS
from waiting import HOST, free_ports

from edoras_tools.addons.lab.emulator import Served, Simulation
from edoras_tools.addons.lab.sweep import plan as sweep_plan
from edoras_tools.addons.lab.sweep import run as sweep_run
from edoras_tools.addons.lab.sweep.plan import (
    Observer,
    SweepPlan,
    command_receiver,
    echo,
    message,
    natural_size,
    route_of,
)
from edoras_tools.addons.lab.sweep.run import _size_notes, sweep
from edoras_tools.cfs.profile import GENERATOR_MSG_ID, SbnPeerConfig, SimProfile
from edoras_tools.decode import Options
from edoras_tools.errors import CaptureError, ConfigError, RouteError
from edoras_tools.links.bare import CI, TO
from edoras_tools.links.sbn import SBN
from edoras_tools.mission import Mission, Route
from edoras_tools.model import Endpoint, Peer
from edoras_tools.pipelines.sending.options import SendOptions
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire import cfe, sbn

TWO = ("two_rovers_ground", "two_rovers_flight")
ROVER = ("rover_ground",)


@pytest.fixture(scope="module")
def bench():
    made = {}

    def make(*names):
        if names not in made:
            made[names] = Settings([MISSIONS / f"{name}.yaml" for name in names]).workbench()
        return made[names]

    return make


def plan_of(
    bench, name, scenario=None, link=None, rates=(1, 1000), sizes=(0, 0), step_s=8, options=None, **more
):
    route = route_of(name, link, bench.mission)
    gate = "peer" if route.link is SBN else "to-enabled"
    options = replace(options or SendOptions(), to=command_receiver(route.link), wait_for=(gate,)).placed(
        bench.mission
    )
    plan = SweepPlan(route, rates, sizes, int(step_s * SECOND), options, scenario, **more)
    plan.check(bench)
    return plan


def run(bench, *arguments, **more):
    found = sweep(plan_of(bench, *arguments, **more), bench)
    assert found.failure is None
    return found.summary()


def counts(summary):
    return {step["rate_hz"]: (step["delivered"], step["lost"]) for step in summary["steps"]}


# The figures of WIRE.md and of the marks of c1_tlm_rate_limit4, a_rover


@pytest.mark.long
def test_telemetry_with_a_limit_of_4_ends_between_8_and_9_hz_as_captured(bench):
    summary = run(bench(*TWO), "/robot_1/ground/pose", "two-rovers")
    assert (summary["threshold_hz"], summary["first_loss_hz"]) == (8, 9)
    assert summary["limiting_hop"] == "TO_LAB_TLM_PIPE"
    assert summary["reason"] == (
        "7 of 72 messages on 0x0828 (/robot_1/ground/pose) lost at TO_LAB_TLM_PIPE: TO keeps 4 of this MsgId "
        "and sends every 500 ms: 8 a second get through (measured)"
    )
    captured = {1: (8, 0), 2: (17, 0), 4: (32, 0), 8: (64, 0), 9: (65, 7), 10: (65, 15), 12: (65, 31)}
    found = counts(summary)
    for rate, (received, msg_limit) in captured.items():
        assert found[rate] == (pytest.approx(received, abs=1), pytest.approx(msg_limit, abs=1)), rate


@pytest.mark.long
def test_telemetry_with_a_limit_of_255_ends_where_the_pipe_is_full(bench):
    summary = run(bench(*TWO), "/robot_1/ground/pose", "two-rovers", limit=255)
    assert 80 <= summary["threshold_hz"] < summary["first_loss_hz"] <= 91
    assert summary["limiting_hop"] == "TO_LAB_TLM_PIPE"
    assert "TO's pipe of 50 is emptied every 500 ms" in summary["reason"]


@pytest.mark.long
def test_cfs_to_an_sbn_peer_ends_at_about_40_hz(bench):
    summary = run(bench(*TWO), "/robot_1/cmd_vel", "two-rovers")
    assert 38 <= summary["threshold_hz"] < summary["first_loss_hz"] <= 42
    assert summary["limiting_hop"] == "SBN_3_66_Pipe"
    assert "it keeps 8 of this MsgId and SBN empties it every 200 ms" in summary["reason"]


@pytest.mark.quick("missions0*")
@pytest.mark.parametrize(
    ("missions", "name", "scenario"), [(ROVER, "/cmd_vel", "rover"), (TWO, "0x1827", "two-rovers")]
)
def test_commands_end_between_8_and_10_hz(bench, missions, name, scenario):
    summary = run(bench(*missions), name, scenario, link=CI)
    assert 8 <= summary["threshold_hz"] < summary["first_loss_hz"] <= 10
    assert summary["limiting_hop"] == "EDORAS_APP_PIPE"
    assert "it keeps 4 of one MsgId, and CI hands over a burst every 500 ms" in summary["reason"]


def test_at_10_hz_for_a_minute_commands_are_lost_as_by_the_real_rover(bench):
    summary = run(bench(*ROVER), "/cmd_vel", "rover", rates=(10, 10), step_s=60)
    assert summary["steps"][0]["sent"] == 600
    assert 70 <= summary["steps"][0]["lost"] <= 120  # 92 in flight


@pytest.mark.long
def test_a_peer_s_states_reach_cfs_at_any_rate_and_what_they_cause_elsewhere_is_told(bench):
    summary = run(bench(*TWO), "/robot_1/pose", "two-rovers", rates=(1, 128))
    assert (summary["threshold_hz"], summary["limiting_hop"], summary["to_cfs"]) == (None, None, True)
    assert all(step["lost"] == 0 for step in summary["steps"])
    assert "0x0828 (/robot_1/ground/pose) was lost too, at TO_LAB_TLM_PIPE" in summary["notes"]


@pytest.mark.long
def test_who_publishes_the_route_already_is_counted_in(bench):
    summary = run(bench(*ROVER), "/telemetry_pose", "rover", rates=(1, 16))
    assert 6 <= summary["threshold_hz"] <= 8
    assert "already published at 1 Hz" in summary["notes"][0]
    assert counts(summary)[4] == (pytest.approx(32, abs=3), 0)


@pytest.mark.long
def test_the_socket_is_the_limit_where_the_pipe_is_not(bench):
    summary = run(bench(*ROVER), "/cmd_vel", "rover", rates=(16, 64), limit=255)
    assert summary["limiting_hop"] == "CI_LAB_APP socket"
    assert "CI reads 11 a wake-up" in summary["reason"]
    assert summary["steps"][2]["evidence"]["not_ingested"] == summary["steps"][2]["lost"] > 0
    assert "from 32 Hz on cFS is too slow" in summary["notes"][0]


# Sizes


@pytest.mark.long
def test_ci_cuts_at_768_bytes_and_the_echo_shows_it(bench):
    summary = run(bench(*ROVER), "/cmd_vel", "rover", rates=(2, 2), sizes=(76, 2000))
    assert (summary["threshold_bytes"], summary["first_loss_bytes"]) == (768, 769)
    assert summary["limiting_hop"] == "CI_LAB_APP"
    assert "longer than CI's 768 bytes" in summary["reason"]


@pytest.mark.long
def test_the_software_bus_takes_32768_bytes(bench):
    summary = run(
        bench(*TWO), "/robot_1/ground/pose", "two-rovers", rates=(2, 2), sizes=(20000, 40000), step_s=4
    )
    assert (summary["threshold_bytes"], summary["first_loss_bytes"]) == (32768, 32769)
    assert summary["limiting_hop"] == "software bus"
    assert "Msg Too Big MsgId=0x828" in summary["reason"]
    assert "1,024 bytes" in summary["notes"][0]


@pytest.mark.long
def test_cfs_is_left_as_it_was_found(bench, monkeypatch):
    """What was asked of Telemetry Output and of the generator is undone, whatever happens."""
    wires = []

    class Wire(sweep_run.SimulatedWire):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            self.sent = []
            wires.append(self)

        def put(self, payload):
            self.sent.append(payload)
            return super().put(payload)

    monkeypatch.setattr(sweep_run, "SimulatedWire", Wire)
    run(bench(*ROVER), "/cmd_vel", "rover", rates=(2, 2), sizes=(76, 100), step_s=2)
    assert [item for item in wires[0].sent if item in echo(0x1827)] == [*echo(0x1827)]
    run(bench(*TWO), "/robot_1/cmd_vel", "two-rovers", rates=(2, 2), step_s=2)
    assert wires[1].sent[-2][11:13] == b"\x18\xf0"
    assert wires[1].sent[-2][-8:-4] == bytes([0x2A, 0x08, 0, 0])  # little-endian: the MsgId, at 0 Hz
    assert wires[1].sent[-1][2] == sbn.MsgType.DISCONNECT


# Ends


@pytest.mark.long
def test_two_runs_are_the_same(bench):
    one, two = (run(bench(*TWO), "/robot_1/cmd_vel", "two-rovers", rates=(30, 50)) for _ in range(2))
    assert one == two


@pytest.mark.each(2)
@pytest.mark.parametrize(
    ("name", "why"),
    [("0x18ee", "without a subscriber in cFS"), ("0x08f1", "CFE_SB 14: No subscribers for MsgId 0x8f1")],
)
def test_what_nobody_subscribes_to_is_lost_at_once(bench, name, why):
    summary = run(bench(*ROVER), name, "rover")
    assert (summary["threshold_hz"], summary["first_loss_hz"]) == (None, 1)
    assert summary["limiting_hop"] == "software bus"
    assert why in summary["reason"]
    assert summary["notes"] == []


def test_ctrl_c_in_the_middle_keeps_the_steps_that_are_whole(bench):
    plan, tried = plan_of(bench(*ROVER), "/cmd_vel", "rover"), []

    def trying(text):
        tried.append(int(text.partition(" Hz, ")[0]))
        if len(tried) == 3:
            os.kill(os.getpid(), signal.SIGINT)

    found = sweep(plan, bench(*ROVER), trying=trying)
    assert (found.interrupted, found.failure, tried) == (True, None, [1, 2, 4])
    assert [step.rate_hz for step in found.steps] == [1, 2]


def test_without_a_generator_it_says_so_at_once(bench, monkeypatch):
    profile_of = sweep_run.profile_of

    def without(plan, mission):
        return replace(profile_of(plan, mission), generator_msg_id=0)

    monkeypatch.setattr(sweep_run, "profile_of", without)
    found = sweep(plan_of(bench(*ROVER), "/telemetry_pose", "rover", generator=0x18EE), bench(*ROVER))
    assert found.steps == []
    said = r"\(cFS says: No subscribers for MsgId 0x18ee\): .*'edoras codegen generator'.*--watch"
    assert re.match(f"no telemetry generator answers on 0x18ee {said}", str(found.failure))


def test_what_telemetry_output_does_not_send_has_a_remedy(bench):
    summary = run(bench(*ROVER), "0x08f9", "rover", TO, rates=(4, 8))
    assert (summary["threshold_hz"], summary["limiting_hop"]) == (None, "software bus")
    assert "CFE_SB 14: No subscribers for MsgId 0x8f9" in summary["reason"]
    assert summary["reason"].endswith("edoras inject to-add 0x08f9")


@pytest.mark.long
def test_a_generator_of_another_msg_id(bench):
    summary = run(bench(*TWO), "/robot_1/ground/pose", "two-rovers", generator=0x18F4, rates=(8, 9))
    assert [(step["rate_hz"], step["lost"]) for step in summary["steps"]] == [(8, 0), (9, 7)]


def test_watching_what_is_published(bench):
    summary = run(bench(*ROVER), "/telemetry_pose", "rover", watch=True, watch_ns=24 * SECOND)
    assert summary["watched"]
    assert [(step["rate_hz"], step["lost"]) for step in summary["steps"]] == [(1.0, 0)] * 3
    assert summary["steps"][0]["size"] == 116


@pytest.mark.parametrize(
    ("name", "sizes", "notes"),
    [
        ("/robot_1/ground/pose", (116, 1000), []),
        ("/robot_1/ground/pose", (116, 1100), ["the ground bridge receives into 1,024 bytes"]),
        ("/robot_1/cmd_vel", (100, 240), []),
        ("/robot_1/cmd_vel", (100, 250), ["keeps lengths in one byte: it drops packets of 245 to 255 bytes"]),
        ("/robot_1/cmd_vel", (255, 300), ["keeps lengths in one byte: it drops packets of 245 to 255 bytes"]),
        ("/robot_1/cmd_vel", (256, 500), []),
        ("/robot_1/cmd_vel", (256, 4086), ["drops packets of 501 to 511 bytes", "receives into 4,096 bytes"]),
        ("/robot_1/pose", (200, 5000), ["messages of an SBN peer are not echoed"]),
    ],
)
def test_notes_on_sizes_name_the_bridge_of_the_link(bench, name, sizes, notes):
    told = list(_size_notes(plan_of(bench(*TWO), name, "two-rovers", sizes=sizes)))
    assert len(told) == len(notes)
    assert all(note in text for note, text in zip(notes, told, strict=True))


@pytest.mark.long
def test_watching_what_somebody_else_publishes_too_fast(bench, monkeypatch):
    class Busy(Simulation):
        def __init__(self, *arguments, **more):
            super().__init__(*arguments, **more)
            faster = sweep_plan.generator.set_command(0x828, 12, slot=3)
            self.inject(9 * SECOND, cfe.emit_command(0x18F0, 2, faster), "CI_LAB_APP")

    monkeypatch.setattr(sweep_run, "Simulation", Busy)
    plan = {"rates": (1, 16), "watch": True, "watch_ns": 30 * SECOND, "step_s": 5}
    summary = run(bench(*TWO), "/robot_1/ground/pose", "two-rovers", **plan)
    fast = [step for step in summary["steps"] if step["rate_hz"] > 11]
    assert {step["hop"] for step in fast} == {"TO_LAB_TLM_PIPE"}
    assert all(step["lost"] == pytest.approx(20, abs=3) for step in fast)  # 4 a second of 12
    assert len(fast) >= 3
    assert "TO keeps 4 of this MsgId and sends every 500 ms" in summary["reason"]


def test_nothing_to_watch(bench):
    found = sweep(plan_of(bench(*TWO), "/robot_1/ground/pose", "two-rovers", watch=True), bench(*TWO))
    assert "no 0x0828 (/robot_1/ground/pose) came in 60 s" in str(found.failure)


def test_who_is_no_peer_of_cfs_is_told_what_is_usually_wrong(bench, monkeypatch):
    def other(_peer, port):
        return SbnPeerConfig(Peer(66, 9), port)

    monkeypatch.setattr(sweep_run, "SbnPeerConfig", other)
    for name, why in (
        ("/robot_1/cmd_vel", "sent none of the messages"),
        ("/robot_1/pose", "sent none of the messages"),
    ):
        found = sweep(plan_of(bench(*TWO), name, "two-rovers"), bench(*TWO))
        assert why in str(found.failure)
        assert found.steps == []


# Sockets


@pytest.fixture
def ports():
    return free_ports(3)


@pytest.mark.long
def test_on_real_sockets_the_same_hop_is_found(bench, ports):
    """A hasty cFS, so that the test is quick: 400 Hz are 10 in 25 ms, and 4 may wait."""
    ci, to, own = ports
    fast = 25 * MILLISECOND
    profile = SimProfile(ci_port=ci, to_port=to, sbn_port=own, ci_wake_ns=fast, to_wake_ns=fast)
    simulation = Simulation(replace(profile, housekeeping_ns=200 * MILLISECOND), "rover", bridges=False)
    with Served(simulation):
        options = SendOptions(target=Endpoint(HOST, ci), listen=Endpoint(HOST, to))
        plan = plan_of(bench(*ROVER), "/cmd_vel", rates=(400, 400), step_s=1, options=options)
        found = sweep(plan, bench(*ROVER))
    assert found.failure is None
    step = found.steps[0]
    assert (step.outcome.sent, step.outcome.hop) == (400, "EDORAS_APP_PIPE")
    assert simulation.apps.edoras.robot_commands == step.outcome.delivered == 400 - step.lost < 400


def test_nobody_there_and_nobody_who_answers(bench, ports):
    ci, to, silent = ports
    options = SendOptions(target=Endpoint(HOST, ci), listen=Endpoint(HOST, to), timeout_ns=SECOND // 2)
    found = sweep(plan_of(bench(*ROVER), "/cmd_vel", options=options), bench(*ROVER))
    assert "refuses: no program listens there (ICMP port unreachable)" in str(found.failure)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind((HOST, silent))
        quiet = replace(options, target=Endpoint(HOST, silent))
        found = sweep(plan_of(bench(*ROVER), "/cmd_vel", options=quiet), bench(*ROVER))
        assert "no telemetry came to" in str(found.failure)
        taken = replace(options, listen=Endpoint(HOST, silent))
        with pytest.raises(CaptureError, match="another program has port"):
            sweep(plan_of(bench(*ROVER), "/cmd_vel", options=taken), bench(*ROVER))


# Plans


def test_routes_by_topic_key_and_msg_id(bench):
    mission = bench(*TWO).mission
    for name in ("/robot_1/cmd_vel", "robot_1/cmd_vel", "0x82a", "2090"):
        assert route_of(name, None, mission).msg_id == 0x82A
    assert route_of("0x828", SBN, mission) == Route("0x0828", "", 0x828, SBN, "telemetry")
    assert route_of("0x1fff", None, Mission()).link is CI
    for name, link, why in (
        ("/nope", None, "not configured"),
        ("/robot_1/cmd_vel", CI, "uses sbn, not ci"),
        ("0x2000", None, "not a MsgId"),
        ("twist_cmd_1", None, "names 2 routes"),
    ):
        with pytest.raises(RouteError, match=why):
            route_of(name, link, mission)


def test_messages_are_filled_up_to_their_size(bench):
    route = route_of("/cmd_vel", None, bench(*ROVER).mission)
    assert natural_size(route, bench(*ROVER)) == 76
    packet = message(route, bench(*ROVER), 100)
    assert (len(packet), int.from_bytes(packet[4:6], "big")) == (100, 93)
    assert packet[76:] == b"\xa5" * 24
    assert message(route, bench(*ROVER), 0) == packet[:4] + b"\0\x45" + packet[6:76]


@pytest.mark.parametrize(
    ("more", "why"),
    [
        ({"rates": (5, 2)}, "not a rising range"),
        ({"sizes": (10, 20)}, "has 76 bytes"),
        ({"sizes": (76, 65535)}, "holds 65,507"),
        ({"options": SendOptions(allow=("0x1828",))}, "not on the allow-list"),
        (
            {"options": SendOptions(target=Endpoint("192.0.2.1", 1)), "rates": (1, 1001)},
            "exceeds the limit of 1,000 Hz",
        ),
    ],
)
def test_plans_that_cannot_be(bench, more, why):
    with pytest.raises(ConfigError, match=why):
        plan_of(bench(*ROVER), "/cmd_vel", **more)


def test_a_dry_run_names_everything_that_would_be_sent(bench):
    summary = plan_of(bench(*ROVER), "/cmd_vel", rates=(2, 2), sizes=(76, 800)).as_json(bench(*ROVER))
    assert summary["sends"] == ["0x1801", "0x1827", "0x1880"]
    assert (summary["sizes"], summary["rates_hz"], summary["target"]) == ([76, 800], [2, 2], f"{HOST}:1234")


EXTENDED = {"options": SendOptions(headers=cfe.WITH_EXTENDED)}


@pytest.mark.long
@pytest.mark.parametrize("headers", [cfe.WITH_EXTENDED, cfe.WITH_EXTENDED_2], ids=lambda item: item.name)
@pytest.mark.parametrize(
    ("name", "rates", "threshold"),
    [
        ("/robot_1/ground/pose", (4, 12), 8),
        ("/robot_1/cmd_vel", (32, 44), 39),
        ("/robot_1/ground/cmd_vel", (6, 10), 8),
    ],
)
def test_a_cfe_with_extended_headers_has_the_same_limits(name, rates, threshold, headers):
    bench = Settings([MISSIONS / f"{file}.yaml" for file in TWO]).workbench().with_headers(headers)
    more = {"options": SendOptions(headers=headers), "generator": headers.msg_ids.of_known(GENERATOR_MSG_ID)}
    summary = run(bench, name, "two-rovers", rates=rates, **more)
    assert summary["threshold_hz"] == threshold


@pytest.mark.long
def test_ci_cuts_at_the_same_size_behind_extended_headers():
    settings = Settings([MISSIONS / "rover_ground.yaml"], options=Options(extended_header=True))
    summary = run(settings.workbench(), "/cmd_vel", "rover", rates=(2, 2), sizes=(84, 900), **EXTENDED)
    assert (summary["threshold_bytes"], summary["limiting_hop"]) == (768, "CI_LAB_APP")


def test_messages_that_nobody_takes_and_memory_in_use_do_not_keep_a_step_from_ending(bench):
    made = bench(*ROVER)
    observer = Observer(made, made.mission.find("/cmd_vel"))

    def counters(**more):
        values = dict.fromkeys(cfe.SOFTWARE_BUS_HOUSEKEEPING.by_name, 0) | more
        payload = cfe.SOFTWARE_BUS_HOUSEKEEPING.emit(values)
        observer.received(TO, cfe.emit_telemetry(cfe.SOFTWARE_BUS_HOUSEKEEPING_MSG_ID, payload), 0)
        return observer.mark().counters

    still = counters()
    assert counters(no_subscribers_counter=9, memory_in_use=3000) == still
    for name in ("pipe_overflow_error_counter", "message_limit_error_counter"):
        assert counters(**{name: 1}) != still
