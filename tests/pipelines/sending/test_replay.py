"""What of a recording is chosen to be sent, and what is changed in it."""

from __future__ import annotations

import struct

import pytest
from mcap.writer import Writer
from places import SAMPLES

from edoras_tools.errors import CaptureError, ConfigError, RouteError
from edoras_tools.io.formats.rosbag2.reader import open_rosbag
from edoras_tools.io.net.sockets import own_address
from edoras_tools.links.sbn import SBN
from edoras_tools.mission import Mission
from edoras_tools.model import Endpoint, Peer
from edoras_tools.pipelines.selection import Period, Selection
from edoras_tools.pipelines.sending.options import (
    Receiver,
    Role,
    SendOptions,
    check_allowed,
    check_target,
    fits,
    is_loopback,
)
from edoras_tools.pipelines.sending.replay import (
    ReplaySelection,
    changes_for,
    load_datagrams,
    load_topics,
    remapped,
)
from edoras_tools.pipelines.sending.run import Transmission
from edoras_tools.pipelines.workbench import Settings, open_files
from edoras_tools.sessions.outgoing import Changes
from edoras_tools.wire import cfe, sbn

ROOT = SAMPLES
MS = 1_000_000


def bench(*names):
    return Settings([ROOT / f"missions/{name}.yaml" for name in names]).workbench()


@pytest.fixture(scope="module")
def rover():
    return bench("rover_ground")


@pytest.fixture(scope="module")
def two_rovers():
    return bench("two_rovers_ground", "two_rovers_flight")


def loaded(name, workbench, to=Receiver.CI, choice=None, **options):
    placed = SendOptions(to=to, **options).placed(workbench.mission)
    return load_datagrams(
        open_files([ROOT / f"captures/{name}.pcap"]), workbench, placed, choice or ReplaySelection()
    )


@pytest.fixture(scope="module")
def payloads():
    """A function: payloads and times of a sample capture by ports, read without the code under test."""

    def read(name, **ports):
        data, at, found = (ROOT / f"captures/{name}.pcap").read_bytes(), 24, []
        while at < len(data):
            seconds, micros, length = struct.unpack_from("<III", data, at)
            frame = data[at + 16 : at + 16 + length]
            at += 16 + length
            source, destination, size = struct.unpack_from(">HHH", frame, 34)
            if ports.get("to", destination) == destination and ports.get("source", source) == source:
                found.append((seconds * 10**9 + micros * 1000, frame[42 : 34 + size]))
        return found

    return read


@pytest.mark.parametrize(
    ("name", "missions", "to", "options", "ports"),
    [
        ("a_rover", ["rover_ground"], Receiver.CI, {}, {"to": 1234}),
        ("e_ci_errors", ["rover_ground"], Receiver.CI, {}, {"to": 1234}),
        ("a_rover", ["rover_ground"], Receiver.GROUND, {}, {"to": 1235}),
        ("f_sbn_disconnect", ["two_rovers_flight"], Receiver.SBN, {"role": Role.CAPTURED}, {"to": 2234}),
        ("f_sbn_disconnect", [], Receiver.SBN, {"role": Role.CAPTURED}, {"to": 2234}),
    ],
)
def test_payloads_and_times_are_those_of_the_capture(name, missions, to, options, ports, payloads):
    out = loaded(name, bench(*missions), to, **options).out
    wanted = payloads(name, **ports)
    assert [out[row] for row in range(len(out))] == [payload for _, payload in wanted]
    assert out.time_ns.tolist() == [time_ns for time_ns, _ in wanted]
    assert out.link is to.link


def test_a_session_takes_application_messages_and_learns_the_subscriptions(two_rovers, payloads):
    found = loaded("f_sbn_disconnect", two_rovers, Receiver.SBN)
    every = [payload for _, payload in payloads("f_sbn_disconnect", to=2234)]
    wanted = [payload for payload in every if len(payload) >= 11 and payload[2] == 3]
    assert [found.out[row] for row in range(len(found.out))] == wanted
    assert found.subscriptions == (0x82A, 0x82B)


@pytest.mark.parametrize(
    ("choice", "count"),
    [
        (ReplaySelection(count=7), 7),
        (ReplaySelection(routes=["cmd_*"]), 600),
        (ReplaySelection(routes=["/cmd_vel"]), 600),
        (ReplaySelection(routes=["0x18?0"]), 1),
        (ReplaySelection(routes=["0X1827", "0x1880"]), 601),
        (ReplaySelection(Selection(msg_ids=[0x1880])), 1),
        (ReplaySelection(Selection(topics=["/cmd*"]), routes=["0x1827"], count=5), 5),
        (ReplaySelection(Selection(where="function_code == 6")), 1),
    ],
)
def test_a_part_is_chosen(choice, count, rover):
    assert len(loaded("a_rover", rover, choice=choice).out) == count


@pytest.mark.parametrize(("start", "end"), [(30, 0), (0, 10), (10, 20)])
def test_times_count_from_the_first_datagram_of_the_recording(start, end, rover, payloads):
    every = payloads("a_rover")[0][0]
    elapsed = [(time_ns - every) / 1e9 for time_ns, _ in payloads("a_rover", to=1234)]
    wanted = [item for item in elapsed if item >= start and (not end or item < end)]
    choice = ReplaySelection(period=Period(start * 1000 * MS, end * 1000 * MS))
    assert 0 < len(loaded("a_rover", rover, choice=choice).out) == len(wanted) < 601


@pytest.mark.parametrize(
    ("to", "name", "choice", "words"),
    [
        (
            Receiver.SBN,
            "a_rover",
            ReplaySelection(),
            r"contains no SBN datagrams towards cFS; it has 601 of CI \(--to ci\), 582 of TO",
        ),
        (
            Receiver.CI,
            "a_rover",
            ReplaySelection(routes=["0x9"]),
            "none of its 601 commands to Command Ingest was selected",
        ),
        (Receiver.CI, "a_rover", ReplaySelection(period=Period(10**15)), "none of its 601"),
    ],
)
def test_a_recording_with_nothing_to_send_says_what_it_has(to, name, choice, words, rover):
    with pytest.raises(CaptureError, match=words):
        loaded(name, rover, to, choice)


def test_a_topic_that_is_not_configured_is_named(rover):
    with pytest.raises(RouteError, match="'/nope'"):
        loaded("a_rover", rover, choice=ReplaySelection(Selection(topics=["/nope"])))


def test_an_end_before_the_start():
    with pytest.raises(ConfigError, match="--end is not after --start"):
        Period(5, 5)


def test_remapping_by_msg_id_topic_and_key(two_rovers):
    mission = two_rovers.mission
    assert remapped([("0x1827", "0x1828")], mission) == {0x1827: 0x1828}
    assert remapped([("6183", "/robot_2/ground/cmd_vel")], mission) == {0x1827: 0x1828}
    for pair, words in {
        ("0x1827", "0x0828"): "their headers differ",
        ("0x0", "0x1"): "0x0 is not a MsgId",
        ("0xzz", "0x1"): "0xzz is not a MsgId",
    }.items():
        with pytest.raises(ConfigError, match=words):
            remapped([pair], mission)
    with pytest.raises(RouteError, match="'/nowhere'"):
        remapped([("/nowhere", "0x1827")], mission)
    pairs = [("0x1827", "0x1828"), ("0x1829", "0x0828")]
    assert remapped(pairs, mission, extended=True) == {0x1827: 0x1828, 0x1829: 0x0828}


def test_restamp_knows_which_types_begin_with_a_header(two_rovers, rover):
    changes = changes_for(SendOptions(), {}, two_rovers.mission, two_rovers.types, restamp=True)
    stamped = {
        route.topic
        for route, is_stamped in zip(two_rovers.mission.routes, changes.restamp, strict=True)
        if is_stamped
    }
    assert stamped == {"/robot_1/ground/pose", "/robot_2/ground/pose", "/robot_1/pose", "/robot_2/pose"}
    assert changes_for(SendOptions(), {}, rover.mission, rover.types, restamp=False).restamp is None
    out = loaded(
        "f_sbn_disconnect", two_rovers, Receiver.SBN, ReplaySelection(routes=["0x1829"], count=3)
    ).out
    sent = changes.each(out, start_ns=5 * 10**9, due_ns=out.time_ns - out.time_ns[0])
    values = two_rovers.types.decode("geometry_msgs/msg/PoseStamped", sent[2][11 + 8 + 16 :][:84])
    assert values["header"]["stamp"] == {"sec": 5, "nanosec": int(out.time_ns[2] - out.time_ns[0])}


def test_restamp_needs_something_to_stamp():
    empty = bench()
    with pytest.raises(ConfigError, match="--restamp"):
        changes_for(SendOptions(), {}, empty.mission, empty.types, restamp=True)


def test_only_what_is_allowed_is_sent(rover):
    found = loaded("a_rover", rover)
    for allow in ((), ("0x18*",), ("/cmd_vel", "0x1880"), ("*",)):
        check_allowed(found.out, allow, rover.mission)
    with pytest.raises(ConfigError, match=r"not on the allow-list \(/cmd_vel\): 0x1880; nothing was sent"):
        check_allowed(found.out, ("/cmd_vel",), rover.mission)
    placed = SendOptions(allow=("0x1827",)).placed(rover.mission)
    with pytest.raises(ConfigError, match="0x1828"):  # judged as it is sent, not as it was recorded
        Transmission.of(found, placed, rover.mission, Changes({0x1827: 0x1828}))


def test_fits(rover):
    mission = rover.mission
    assert all(fits(item, 0x1827, mission) for item in ("0x1827", "0x18*", "/cmd_vel", "cmd_vel", "*", "/c*"))
    assert not any(fits(item, 0x1827, mission) for item in ("0x827", "/cmd", "", "/CMD_VEL"))


@pytest.mark.parametrize("host", ["127.0.0.1", "127.9.9.9", "localhost", "::1"])
def test_loopback_needs_no_yes(host):
    assert is_loopback(host)
    check_target(Endpoint(host, 1), confirmed=False)


@pytest.mark.parametrize("host", ["192.0.2.7", "0.0.0.0", "no.such.host.invalid"])
def test_another_machine_needs_a_yes(host):
    target = Endpoint(host, 1)
    with pytest.raises(ConfigError, match="nothing was sent; confirm the target with --yes"):
        check_target(target, confirmed=False)
    with pytest.raises(ConfigError, match="nothing was sent"):
        check_target(target, confirmed=False, confirm=lambda _: False)
    check_target(target, confirmed=True)
    check_target(target, confirmed=False, confirm=lambda question: f"{host}:1" in question)


def test_other_machines_get_a_thousand_a_second_at_most(rover):
    found = loaded("a_rover", rover)
    far = Endpoint("192.0.2.7", 1234)

    def rate(**given):
        options = SendOptions(unpaced=True, **given).placed(rover.mission)
        return Transmission.of(found, options, rover.mission, Changes()).table.rate_hz

    assert rate() is None
    assert rate(target=far) == pytest.approx(1000)
    assert rate(target=far, max_rate_hz=50) == pytest.approx(50)
    assert rate(max_rate_hz=50) == pytest.approx(50)
    assert rate(target=far, unlimited=True) is None


def test_a_rate_of_its_own_for_a_route(rover):
    found = loaded("a_rover", rover)
    options = SendOptions(rates=[("/cmd_vel", 50)]).placed(rover.mission)
    table = Transmission.of(found, options, rover.mission, Changes()).table
    first = int(found.out.time_ns[1] - found.out.time_ns[0])  # the command before it enables telemetry
    assert table.due_ns.tolist() == [0, *(first + index * 20 * MS for index in range(600))]
    for rates, error, words in (
        ([("/nope", 5)], RouteError, "no datagram to send matches"),
        ([("*", 5), ("/cmd_vel", 5)], ConfigError, "sets the interval of all messages"),
    ):
        with pytest.raises(error, match=words):
            SendOptions(rates=rates).placed(rover.mission).pacing(found.out, rover.mission)


def test_places_come_from_the_mission_and_stay_on_this_machine(two_rovers):
    ci = SendOptions().placed(two_rovers.mission)
    assert (str(ci.target), str(ci.listen)) == ("127.0.0.1:1234", "127.0.0.1:1235")
    peer = SendOptions(to=Receiver.SBN).placed(two_rovers.mission)
    assert (str(peer.target), str(peer.listen)) == ("127.0.0.1:2234", "127.0.0.1:2236")
    assert (peer.wait_for, peer.identity(two_rovers.mission)) == (("peer",), Peer(0x42, 3))
    assert SendOptions(to=Receiver.SBN, wait_for=("nothing",)).placed(two_rovers.mission).wait_for == (
        "nothing",
    )
    assert SendOptions(to=Receiver.SBN, role=Role.CAPTURED).placed(two_rovers.mission).wait_for == ()
    ground = SendOptions(to=Receiver.GROUND).placed(two_rovers.mission)
    assert (str(ground.target), ground.listen) == ("127.0.0.1:1235", None)
    deaf = SendOptions(no_listen=True).placed(two_rovers.mission)
    assert (deaf.listen, deaf.linger_ns) == (None, 10 * MS)
    distant = Endpoint("192.0.2.7", 1)
    deaf = SendOptions(no_listen=True, target=distant).placed(two_rovers.mission)
    assert (deaf.listen, deaf.linger_ns) == (None, 100 * MS)
    far = SendOptions(target=distant).placed(two_rovers.mission)
    assert far.listen == Endpoint(own_address(distant), 1235)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"wait_for": ["dinner"]}, "'dinner' is not known; there are peer"),
        ({"wait_for": ["peer"]}, "needs an SBN session"),
        ({"wait_for": ["peer"], "to": Receiver.SBN, "role": Role.CAPTURED}, "needs an SBN session"),
        ({"wait_for": ["to-enabled"], "to": Receiver.SBN}, "needs --to ci"),
        ({"wait_for": ["to-enabled"], "no_listen": True}, "leave --no-listen out"),
        ({"wait_for": ["event:x"], "no_listen": True}, "leave --no-listen out"),
        ({"unlimited": True, "max_rate_hz": 5}, "removes the limit"),
        ({"listen": Endpoint("127.0.0.1", 5), "no_listen": True}, "exclude each other"),
    ],
)
def test_options_that_cannot_be_meant(given, words):
    with pytest.raises(ConfigError, match=words):
        SendOptions(**given).placed(Mission())


def test_the_plan_of_a_dry_run(two_rovers):
    found = loaded("f_sbn_disconnect", two_rovers, Receiver.SBN, ReplaySelection(routes=["0x1829"]))
    options = SendOptions(to=Receiver.SBN, rates=[("*", 50)], passes=3).placed(two_rovers.mission)
    plan = Transmission.of(found, options, two_rovers.mission, Changes()).plan()
    count = len(found.out)
    assert (
        plan.items()
        >= {
            "datagrams": 3 * count,
            "target": "127.0.0.1:2234",
            "listen": "127.0.0.1:2236",
            "sender": "66:3",
            "wait_for": ["peer"],
            "rate_asked_hz": 50.0,
            "routes": [{"msg_id": "0x1829", "topic": "/robot_1/pose", "count": count}],
        }.items()
    )


@pytest.fixture
def bag(tmp_path, rover):
    """A recording of another tool: Twist on two topics, a String besides."""

    def write(names=("/cmd_vel", "/other_vel"), kind="geometry_msgs/msg/Twist"):
        with (tmp_path / "bag.mcap").open("wb") as file:
            writer = Writer(file)
            writer.start("ros2", "another tool")
            schema = writer.register_schema(kind, "ros2msg", b"")
            channels = [writer.register_channel(name, "cdr", schema) for name in names]
            for index in range(10):
                data = rover.types.encode("geometry_msgs/msg/Twist", {"linear": {"x": index}})
                time_ns = 10**18 + index * 100 * MS
                writer.add_message(channels[index % len(channels)], time_ns, data, time_ns)
            writer.finish()
        return open_rosbag(tmp_path / "bag.mcap")

    return write


def from_topics(bag, workbench, to=Receiver.CI, choice=None, rename=None):
    options = SendOptions(to=to).placed(workbench.mission)
    return load_topics(bag, workbench, options, choice or ReplaySelection(), rename or {}).out


def test_messages_become_the_packets_that_the_ground_bridge_sends(bag, rover):
    out = from_topics(bag(), rover)
    assert len(out) == 5
    body = rover.types.encode("geometry_msgs/msg/Twist", {"linear": {"x": 2}})
    assert out[1] == struct.pack(">HHHBB", 0x1827, 0, 69, 1, 0) + struct.pack("<QQ", 52, 52) + body
    assert (out.time_ns - out.time_ns[0]).tolist() == [index * 200 * MS for index in range(5)]
    captured = loaded("a_rover", rover, choice=ReplaySelection(routes=["0x1827"], count=1)).out
    assert (len(captured[0]), captured[0][:28]) == (len(out[0]), out[0][:28])


def test_a_topic_takes_another_s_place(bag, two_rovers):
    out = from_topics(bag(), two_rovers, rename={"/other_vel": "robot_2/ground/cmd_vel"})
    assert (len(out), set(out.msg_id.tolist())) == (5, {0x1828})


def test_onto_the_sbn_link_and_to_the_ground(bag, two_rovers):
    names = ["/robot_1/pose", "/robot_1/ground/pose"]
    made = bag(names, "geometry_msgs/msg/PoseStamped")
    peer = from_topics(made, two_rovers, Receiver.SBN)
    assert peer[0][:11] == sbn.emit(sbn.MsgType.APP, Peer(0x42, 3), bytes(len(peer[0]) - 11))[:11]
    assert peer.link is SBN
    ground = from_topics(made, two_rovers, Receiver.GROUND)
    assert ground[0][:2] == b"\x08\x28"
    assert cfe.TELEMETRY.parse(ground[0], 6)["seconds"] == 10**9 - 315_532_800


def test_a_part_of_the_messages(bag, rover):
    assert len(from_topics(bag(), rover, choice=ReplaySelection(count=2))) == 2
    assert len(from_topics(bag(), rover, choice=ReplaySelection(period=Period(300 * MS, 700 * MS)))) == 2


@pytest.mark.parametrize(
    ("given", "options", "error", "words"),
    [
        (
            {"names": ["/x"]},
            {},
            CaptureError,
            "none of its topics .*/x.* goes to ci; configured are /cmd_vel",
        ),
        ({"kind": "std_msgs/msg/String"}, {}, ConfigError, "/cmd_vel is std_msgs/msg/String, but /cmd_vel"),
        (
            {},
            {"choice": ReplaySelection(period=Period(10**15))},
            CaptureError,
            "contains no message on /cmd_vel in the selected time",
        ),
        ({}, {"to": Receiver.SBN}, RouteError, "no configured topic goes to sbn"),
        ({}, {"choice": ReplaySelection(routes=["0x1828"])}, CaptureError, "none of its topics"),
    ],
)
def test_messages_that_fit_nowhere(given, options, error, words, bag, rover):
    with pytest.raises(error, match=words):
        from_topics(bag(**given), rover, **options)
