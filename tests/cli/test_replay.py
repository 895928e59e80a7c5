"""Replay and inject as people run them; loopback only, on ports that are free."""

import json
import signal
import struct
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import pytest
from schema import held
from waiting import HOST, Ear, Program, free_ports, until

from edoras_tools.addons.lab.emulator import Served, Simulation
from edoras_tools.cfs.profile import Ports, SimProfile
from edoras_tools.wire import cfe, sbn

TWIST = bytes.fromhex("1827")


@pytest.fixture
def receiver():
    """Somebody who listens: its port, and all that came so far."""
    with Ear() as ear:
        yield f"{HOST}:{ear.port}", ear.take


@pytest.fixture
def flight_side():
    """A function: an emulated cFS on free ports, in a thread; gives the simulation and the ports."""

    def run(scenario):
        profile = SimProfile().on(Ports(*free_ports(4)))
        simulation = Simulation(profile, scenario, bridges=False).boot()
        stack.enter_context(Served(simulation))
        return simulation

    with ExitStack() as stack:
        yield run


def commands(datagrams, path):
    return [item.payload for item in datagrams(path) if item.destination == 1234]


FAST = ("--max", "--no-listen", "-n", "500")
"""At once, and no more than the buffers of every system hold."""


def test_every_byte_of_every_command(call, captures, datagrams, receiver):
    target, take = receiver
    done = call("replay", captures("a_rover"), "--to", "ci", "--target", target, *FAST, "--json")
    wanted = commands(datagrams, captures("a_rover"))
    assert take() == wanted[:500]
    report = done.json()
    assert done.code == 0
    assert (report["sent"], report["send_errors"], report["rate_asked_hz"]) == (500, 0, None)
    assert report["lateness_us"] == {"p50": None, "p99": None, "max": None}
    assert report["seen"] == {"events": [], "counters": {}, "telemetry": [], "sbn": {}, "answers": 0}


@pytest.mark.parametrize("through", ["x.mcap", "x.pcapng"])
def test_a_recording_of_a_capture_sends_the_same(through, call, captures, datagrams, receiver, tmp_path):
    assert call("record", "-q", "-r", captures("e_ci_errors"), "-o", tmp_path / through).code == 0
    target, take = receiver
    call("replay", tmp_path / through, "--to", "ci", "--target", target, *FAST, "-q")
    assert take() == commands(datagrams, captures("e_ci_errors"))[:500]


def test_pace_and_report(call, captures, receiver):
    target, take = receiver
    options = ["--rate", "200", "-n", "101", "--loop", "2", "--no-listen", "--json"]
    done = call("replay", captures("a_rover"), "--to", "ci", "--target", target, *options)
    report = done.json()
    assert len(take()) == report["sent"] == 202
    assert report["rate_asked_hz"] == 200
    # Never early; how late, the first one too, is the machine's.
    assert report["rate_achieved_hz"] > 0
    assert report["duration_s"] + report["lateness_us"]["max"] / 1e6 > 1.0
    assert report["lateness_us"]["p50"] <= report["lateness_us"]["p99"] <= report["lateness_us"]["max"]


@pytest.mark.each(2)
@pytest.mark.parametrize(
    ("build", "headers"), [("extended", cfe.WITH_EXTENDED), ("extended-v2", cfe.WITH_EXTENDED_2)]
)
def test_a_usual_capture_into_another_build_and_what_was_sent_back(
    build, headers, call, captures, missions, datagrams, receiver, tmp_path
):
    """Commands of a usual cFS, sent to one with extended headers, recorded, and sent to the usual again."""
    (target, take), there = receiver, str(tmp_path / "there.mcap")
    to = ("--to", "ci", "--target", target, *FAST, "-q")
    call("replay", captures("a_rover"), *missions("rover_ground"), *to, "--write-headers", build, "-o", there)
    wanted = [
        cfe.with_headers(item, cfe.STANDARD, headers)
        for item in commands(datagrams, captures("a_rover"))[:500]
    ]
    assert take() == wanted
    port = ("--port", f"ci:{target.rpartition(':')[2]}")
    call("replay", there, *port, *to, "--write-headers", "16")  # it remembers what it was written with
    assert take() == [cfe.with_headers(item, headers, cfe.STANDARD) for item in wanted]


def test_what_is_changed_on_the_way(call, captures, missions, receiver):
    target, take = receiver
    options = ["--remap", "0x1827:=0x1829", "--sequence", "count", "--checksum", "fix", "--route", "cmd_vel"]
    call(
        *("replay", captures("a_rover"), *missions("rover_ground"), "--to", "ci", "--target", target),
        *(*options, *FAST, "-q"),
    )
    sent = take()
    assert len(sent) == 500
    for index, packet in enumerate(sent):
        assert struct.unpack_from(">HH", packet) == (0x1829, 0xC000 | index)
        check = 0xFF
        for octet in packet:
            check ^= octet
        assert check == 0


def test_messages_of_another_tool(call, captures, missions, receiver, datagrams, tmp_path):
    bag = tmp_path / "bag"
    call("record", "-q", "-r", captures("a_rover"), *missions("rover_ground"), "--rosbag2", "-o", bag)
    target, take = receiver
    done = call(
        *("replay", bag, "--from-topics", *missions("rover_ground"), "--to", "ci", "--target", target),
        *(*FAST, "-q"),
    )
    assert done.code == 0
    wanted = [item for item in commands(datagrams, captures("a_rover")) if item[:2] == TWIST]
    assert take() == wanted[:500]


def test_faults_strike_the_same_ones_every_time(call, captures, datagrams, receiver, recording, tmp_path):
    target, take = receiver
    rounds = []
    for name in ("a.mcap", "b.mcap"):
        done = call(
            *("replay", captures("a_rover"), "--to", "ci", "--target", target, *FAST, "--json"),
            *("--fault", "drop:0.2", "--seed", "5", "-o", tmp_path / name),
        )
        rounds.append((take(), done.json()["faults"]))
    assert rounds[0] == rounds[1]
    sent, faults = rounds[0]
    assert faults == {"drop": 500 - len(sent)}
    assert 60 < faults["drop"] < 140
    counts = recording(tmp_path / "a.mcap").counts
    assert (counts["/edoras/faults"], counts["/edoras/datagrams"]) == (faults["drop"], len(sent))


def test_into_the_emulated_cfs_and_what_comes_back(call, captures, missions, flight_side):
    simulation = flight_side("rover")
    profile = simulation.cfs.profile
    done = call(
        *("replay", captures("a_rover"), *missions("rover_ground"), "--to", "ci", "--route", "0x1827"),
        *("--target", f"{HOST}:{profile.ci_port}", "--listen", f"{HOST}:{profile.to_port}"),
        *("--rate", "40", "-n", "30", "--wait-for", "to-enabled", "--json"),
    )
    report = done.json()
    lost = simulation.cfs.bus.counters.msg_limits
    assert 0 < lost < 30
    assert done.code == 3
    assert report["sent"] == 30
    assert report["ingest"] == {"state": "all", "sent": 30, "read": 30, "missing": 0}
    assert report["seen"]["counters"]["message_limit_error_counter"]["gained"] == lost
    told = {event["message"] for event in report["seen"]["events"]}
    assert "Msg Limit Err,MsgId 0x1827,pipe EDORAS_APP_PIPE,sender CI_LAB_APP" in told
    assert {row["topic"] for row in report["seen"]["telemetry"]} >= {"/telemetry_pose"}


def test_as_a_peer_of_the_emulated_cfs(call, missions, flight_side):
    simulation = flight_side("two-rovers")
    profile = simulation.cfs.profile
    done = call(
        *("inject", "/robot_1/pose", "{pose: {position: {x: 2}}}", *missions("two_rovers_flight")),
        *("--target", f"{HOST}:{profile.sbn_port}", "--listen", f"{HOST}:{profile.sbn_peers[0].port}"),
        *("--hz", "20", "-n", "3", "--linger", "500ms", "--json"),
    )
    assert (done.code, done.json()["sent"]) == (0, 3)
    assert done.json()["seen"]["sbn"]["PROTO"] >= 1

    def told():
        return [text.partition("SBN ")[2] for _, text in list(simulation.cfs.console) if "66:3" in text]

    until(lambda: told()[-1:] == ["5: Disconnected from peer 66:3."], told)
    assert "5: Peer 66:3 connected." in told()


@pytest.fixture
def as_peer(call, missions, tmp_path, flight_side):
    """Arguments that inject a pose into an emulated cFS as one of its SBN peers; its telemetry is enabled."""
    profile = flight_side("two-rovers").cfs.profile
    ci, peer = f"{HOST}:{profile.ci_port}", f"{HOST}:{profile.sbn_peers[0].port}"
    assert call("inject", "to-enable", "--target", ci, "--no-listen").code == 0
    ground = Path(missions("two_rovers_ground")[1]).read_text()
    (tmp_path / "ground.yaml").write_text(
        ground.replace("bridge_port: 1235", f"bridge_port: {profile.to_port}")
    )
    return (
        *("inject", "/robot_1/pose", *missions("two_rovers_flight"), "-c", tmp_path / "ground.yaml"),
        *("--target", f"{HOST}:{profile.sbn_port}", "--listen", peer, "--linger", "1ms"),
    )


def test_an_identity_that_cfs_does_not_know_is_told_by_its_own_event(call, as_peer):
    done = call(*as_peer, "--as", "66:9", "--timeout", "30s", "-q")
    assert (done.code, len(done.err)) == (1, 1)
    assert "cFS says 'SBN 259: ERROR: unknown peer 66:9': its SBN peer table has no such peer" in done.err[0]


def test_a_peer_can_be_waited_for(call, as_peer):
    done = call(*as_peer, "--wait-for", "peer", "--json")
    assert (done.code, done.json()["sent"], done.json()["ingest"]) == (0, 1, None)
    refused = call("inject", "noop", "ci", "--wait-for", "peer")
    assert (refused.code, len(refused.err)) == (2, 1)
    assert "--wait-for peer needs an SBN session: --to sbn" in refused.err[0]


def test_before_telemetry_is_enabled_nothing_can_answer(call, flight_side):
    profile = flight_side("rover").cfs.profile
    reach = ("--target", f"{HOST}:{profile.ci_port}", "--listen", f"{HOST}:{profile.to_port}")
    done = call("inject", "noop", "ci", *reach, "--linger", "100ms")
    assert done.code == 0
    said = " ".join(" ".join(done.err).split())
    assert f"no telemetry came to {HOST}:{profile.to_port}, so nothing can answer" in said
    assert "edoras inject to-enable" in said


def test_one_command_leaves_at_once_and_says_if_its_reading_is_not_known(call, flight_side):
    profile = flight_side("rover").cfs.profile
    reach = ("--target", f"{HOST}:{profile.ci_port}", "--listen", f"{HOST}:{profile.to_port}", "--json")
    call("inject", "noop", "es", *reach, "--wait-for", "to-enabled")
    done = call("inject", "noop", "ci", *reach).json()  # a report may come before CI reads it, or after
    said = ["whether Command Ingest read it is not known; --max-loss 0 waits for its count before and after"]
    assert (done["ingest"]["state"], done["notes"]) in [("unknown", said), ("all", [])]
    judged = call("inject", "noop", "ci", *reach, "--max-loss", "0").json()
    assert (judged["ingest"]["state"], judged["notes"]) == ("all", [])


def test_a_dry_run_sends_nothing(call, captures, receiver):
    target, take = receiver
    done = call("replay", captures("a_rover"), "--to", "ci", "--target", target, "--dry-run", "--json")
    assert (done.code, done.json()["datagrams"], take()) == (0, 601, [])
    text = call("replay", captures("a_rover"), "--to", "ci", "--target", target, "--dry-run")
    assert f"601 datagrams to ci at {target}" in text.out


def test_another_machine_is_not_sent_to_without_a_yes(call, captures):
    for command in (["replay", captures("a_rover"), "--to", "ci"], ["inject", "noop", "ci"]):
        done = call(*command, "--target", "192.0.2.1:1234")
        assert (done.code, len(done.err)) == (2, 1)
        assert "192.0.2.1:1234 is not on this machine's loopback; nothing was sent" in done.err[0]
        assert call(*command, "--target", "192.0.2.1:1234", "--dry-run").code == 0


def test_a_target_that_refuses(call, captures):
    (closed,) = free_ports(1)
    target = f"{HOST}:{closed}"
    done = call("replay", captures("a_rover"), "--to", "ci", "--target", target, "--no-listen", "-q")
    assert (done.code, len(done.err)) == (1, 1)
    assert f"{target} refuses: no program listens there (ICMP port unreachable)" in done.err[0]
    once = call("inject", "noop", "ci", "--target", target, "--no-listen", "--json")
    assert once.code == 1
    assert (once.json()["sent"], once.json()["send_errors"]) == (0, 1)


def test_a_port_in_use(call, receiver, captures):
    taken, _ = receiver
    done = call("replay", captures("a_rover"), "--to", "ci", "--listen", taken)
    assert (done.code, len(done.err)) == (1, 1)
    assert f"UDP {taken}: cannot be bound: another program has port" in done.err[0]
    assert "--no-listen (edoras sim: --no-bridges)" in done.err[0]


def test_a_peer_that_never_answers(call, captures, receiver):
    target, take = receiver
    (own,) = free_ports(1)
    done = call(
        *("replay", captures("f_sbn_disconnect"), "--to", "sbn", "--target", target, "-q"),
        *("--listen", f"{HOST}:{own}", "--timeout", "1.5s", "--as", "0x42:7"),
    )
    assert (done.code, len(done.err)) == (1, 1)
    for words in (
        f"no SBN peer answered at {target} within ",
        f"tried PROTO and SUB, once a second, as 66:7 from {HOST}:{own}",
        "usually cFS is not running",
    ):
        assert words in done.err[0]
    tries = take()
    assert [data[2] for data in tries] == [sbn.MsgType.PROTO, sbn.MsgType.SUB] * (len(tries) // 2)
    assert 2 <= len(tries) <= 4  # the second only where the machine did not stand still


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (
            ["replay", "{a_rover}", "--to", "sbn"],
            1,
            "contains no SBN datagrams towards cFS; it has 601 of CI (--to ci)",
        ),
        (["replay", "{a_rover}", "--to", "moon"], 2, "'moon' is not one of ci, sbn, ground"),
        (["replay", "{a_rover}"], 2, "--to"),
        (["replay", "/nowhere.pcap", "--to", "ci"], 1, "/nowhere.pcap"),
        (["replay", "{a_rover}", "--to", "ci", "--rate", "fast"], 2, "'fast' is not a rate"),
        (["replay", "{a_rover}", "--to", "ci", "--speed", "0"], 2, "'0' is not a number above 0"),
        (["replay", "{a_rover}", "--to", "ci", "--remap", "a=b"], 2, "'a=b' is not A:=B"),
        (["replay", "{a_rover}", "--to", "ci", "--write-headers", "v2"], 2, "there are 16, 12, extended"),
        (["replay", "{a_rover}", "--to", "ci", "--speed", "2", "--max"], 2, "exclude each other"),
        (["replay", "{a_rover}", "--to", "ci", "--end", "5", "--duration", "5"], 2, "both say when to stop"),
        (["replay", "{a_rover}", "--to", "ci", "--as", "three"], 2, "'three' is not SC:CPU"),
        (["replay", "{a_rover}", "--to", "ci", "--target", "nohost:99999"], 2, "99999"),
        (["replay", "{a_rover}", "--to", "ci", "--allow", "0x1827"], 2, "not on the allow-list"),
        (["replay", "{a_rover}", "--to", "ci", "--restamp"], 2, "--restamp"),
        (["replay", "{a_rover}", "--to", "ci", "--fault", "gremlins"], 2, "gremlins"),
        (["replay", "{a_rover}", "--to", "ci", "--from-topics"], 1, "contains no ROS messages"),
        (["inject"], 2, "name one thing"),
        (["inject", "/cmd_vel"], 1, "no topic is configured; give mission files with -c"),
        (["inject", "/cmd_vel", "{linear: {y: a}}", "-c", "{rover}"], 1, "linear.y: takes a number"),
        (["inject", "--command", "0x1880", "six"], 2, "'six' is not a whole number"),
        (["inject", "--command", "0x1880", "6", "--hex", "xyz"], 2, "is not bytes in hex"),
        (["inject", "noop", "ci", "--hex", "00"], 2, "name --command too"),
    ],
)
def test_one_clear_line(arguments, code, words, call, captures, missions):
    names = {"a_rover": captures("a_rover"), "rover": missions("rover_ground")[1]}
    done = call(
        *(
            str(item).replace("{a_rover}", str(names["a_rover"])).replace("{rover}", names["rover"])
            for item in arguments
        )
    )
    assert (done.code, len(done.err)) == (code, 1), done.err
    assert words in done.err[0]
    assert done.out == ""


def test_ctrl_c_prints_the_report(command, captures, receiver, tmp_path):
    target, take = receiver
    arguments = ["replay", captures("a_rover"), "--to", "ci", "--target", target, "--no-listen", "--json"]
    with Program(command, *arguments, "-o", tmp_path / "x.mcap") as program:
        sent = []
        program.until(lambda: sent.extend(take()) or len(sent) >= 3, "it sends")
        report = held(json.loads(program.end(code=130)[0]), ["replay", "--json"])
    assert report["interrupted"]
    assert 3 <= report["sent"] == len(sent + take()) < 601
    port = f"ci:{target.rpartition(':')[2]}"
    asked = [command, "info", "--json", tmp_path / "x.mcap", "--port", port]
    info = subprocess.run(asked, capture_output=True, check=True)
    assert json.loads(info.stdout)["datagrams"] == report["sent"]


@pytest.mark.parametrize(("ends", "code"), [("q", 0), (signal.SIGINT, 130), (signal.SIGTERM, 130)])
def test_steps_from_a_pipe(command, captures, receiver, ends, code):
    target, take = receiver
    words = [
        "replay",
        captures("a_rover"),
        "--to",
        "ci",
        "--target",
        target,
        "--no-listen",
        "--step",
        "--json",
    ]
    with Program(command, *words, stdin=subprocess.PIPE) as program:
        keys = program.process.stdin
        keys.write("nnn")
        keys.flush()
        sent = []
        program.until(lambda: sent.extend(take()) or len(sent) >= 3, "it has sent three")
        if ends == "q":
            keys.write("q")
            keys.flush()
        report = json.loads(program.end(None if ends == "q" else ends, code=code)[0])
    assert (report["sent"], take(), report["interrupted"]) == (3, [], True)


@pytest.mark.long
def test_the_program_of_one_command(captures, receiver):
    target, take = receiver
    words = [captures("a_rover"), "--to", "ci", "--target", target, *FAST, "-q", "-n", "4"]
    done = subprocess.run(
        [sys.executable, "-c", "from edoras_tools.cli.programs import replay; replay()", *map(str, words)],
        check=False,
    )
    assert (done.returncode, len(take())) == (0, 4)


def test_inject_at_a_rate(call, missions, receiver):
    target, take = receiver
    done = call(
        *("inject", "/cmd_vel", "{linear: {x: 0.5}}", *missions("rover_ground"), "--target", target),
        *("--hz", "100", "-n", "50", "--sequence", "count", "--no-listen", "--json"),
    )
    sent = take()
    assert (done.code, len(sent), done.json()["sent"]) == (0, 50, 50)
    assert [packet[2] << 8 | packet[3] for packet in sent] == [0xC000 | index for index in range(50)]
    assert {packet[4:] for packet in sent} == {sent[0][4:]}
    assert struct.unpack_from("<d", sent[0], 28) == (0.5,)
    report = done.json()
    assert report["duration_s"] + report["lateness_us"]["max"] / 1e6 > 0.48  # never early
