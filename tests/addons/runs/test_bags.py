"""Bags recorded on both sides of an emulated cFS, with losses inside the bridges: each found where it was."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest
from mcap.writer import Writer
from places import ROOT
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from rosbags.typesys import Stores, get_typestore

from edoras_tools.addons.lab.emulator import Simulation
from edoras_tools.addons.runs.comparison import against_bag, against_capture, bridge_counts
from edoras_tools.diagnosis.balance import PEER_TO_ROBOT, PUBLISHER, chains
from edoras_tools.errors import CaptureError, ConfigError
from edoras_tools.io.formats.open import open_file
from edoras_tools.io.formats.rosbag2.reader import open_rosbag
from edoras_tools.pipelines.doctor import Scope, examine
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.units import MILLISECOND, SECOND

MISSIONS = [ROOT / f"samples/missions/two_rovers_{side}.yaml" for side in ("ground", "flight")]
TWIST, POSE = "geometry_msgs/msg/Twist", "geometry_msgs/msg/PoseStamped"
CI, TO, SBN_FROM, SBN_TO = 8, 16, 11 + 16, 11 + 8
TOPICS = {  # by MsgId: topic, type, header bytes, delay in the bridge, which is negative towards cFS
    0x1827: ("/robot_1/ground/cmd_vel", TWIST, CI, -2),
    0x1828: ("/robot_2/ground/cmd_vel", TWIST, CI, -2),
    0x0828: ("/robot_1/ground/pose", POSE, TO, 7),
    0x0829: ("/robot_2/ground/pose", POSE, TO, 7),
    0x1829: ("/robot_1/pose", POSE, SBN_TO, -3),
    0x182A: ("/robot_2/pose", POSE, SBN_TO, -3),
    0x082A: ("/robot_1/cmd_vel", TWIST, SBN_FROM, 11),
    0x082B: ("/robot_2/cmd_vel", TWIST, SBN_FROM, 11),
}
EVERY = {0x1827: 5, 0x0829: 7, 0x182A: 6, 0x082A: 9}
"""Of these every so many-th message is lost inside its bridge."""
AHEAD_NS = 3 * SECOND + 250 * MILLISECOND
START_NS = 1_790_000_000 * SECOND


def msg_id_of(item):
    at = 11 if {item.source.port, item.destination.port} <= {2234, 2236} else 0
    if at and (len(item.payload) < 13 or item.payload[2] != 3):
        return None
    return int.from_bytes(item.payload[at : at + 2], "big")


def twist(x):
    return b"\0\1\0\0" + struct.pack("<6d", x, *range(5))


def cdr_of(payload, header):
    """Return the CDR of a packet, by the offsets of the envelope alone."""
    (size,) = struct.unpack_from("<Q", payload, header)
    return payload[header + 16 : header + 16 + size]


def write_pcap(path, items):
    with path.open("wb") as file:
        file.write(struct.pack("<IHHiIII", 0xA1B23C4D, 2, 4, 0, 0, 65535, 101))
        for number, (time_ns, source, destination, payload) in enumerate(items):
            udp = struct.pack(">HHHH", source.port, destination.port, 8 + len(payload), 0) + payload
            hosts = bytes(int(part) for end in (source, destination) for part in end.address.split("."))
            head = struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(udp), number & 0xFFFF, 0, 64, 17, 0)
            frame = head + hosts + udp
            file.write(struct.pack("<IIII", *divmod(time_ns, SECOND), len(frame), len(frame)) + frame)


def write_mcap(path, messages):
    """Write (time, topic, type, CDR) with the mcap library."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "a recorder")
        channels = {}
        for time_ns, topic, kind, cdr in sorted(messages):
            if topic not in channels:
                channels[topic] = writer.register_channel(
                    topic, "cdr", writer.register_schema(kind, "ros2msg", b"")
                )
            writer.add_message(channels[topic], time_ns, cdr, time_ns)
        writer.finish()
    return path


def write_rosbag(path, messages):
    """Write the same as a rosbag2 folder with rosbags."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    with BagWriter(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        made = {}
        for time_ns, topic, kind, cdr in sorted(messages):
            if topic not in made:
                made[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(made[topic], time_ns, cdr)
    return path


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Return a folder with a capture, two bags beside it, and by topic what was lost, and what crossed."""
    folder = tmp_path_factory.mktemp("bags")
    simulation = Simulation(scenario="two-rovers", start_ns=START_NS)
    wire, bags, lost, crossed, count, gone = [], ([], []), {}, {}, {}, set()
    for item in simulation.run(START_NS + 24 * SECOND):
        msg_id = msg_id_of(item)
        if msg_id not in TOPICS or len(item.payload) < 60:
            wire.append(item)
            continue
        topic, kind, header, delay = TOPICS[msg_id]
        cdr = cdr_of(item.payload, header)
        if delay > 0 and cdr in gone:
            continue  # what did not reach cFS does not come out of it
        count[msg_id] = count.get(msg_id, 0) + 1
        inside = 2 * SECOND < item.time_ns - START_NS < 22 * SECOND
        drop = inside and msg_id in EVERY and count[msg_id] % EVERY[msg_id] == 0
        gone |= {cdr} if drop and delay < 0 else set()
        lost[topic] = lost.get(topic, 0) + drop
        crossed[topic] = crossed.get(topic, 0) + (not drop)
        if not drop or delay > 0:
            wire.append(item)
        if not drop or delay < 0:
            robot = header >= SBN_TO
            time_ns = item.time_ns + delay * MILLISECOND + robot * AHEAD_NS
            bags[robot].append((time_ns, topic, kind, cdr))
    write_pcap(folder / "wire.pcap", wire)
    write_mcap(folder / "ground.mcap", bags[0])
    write_rosbag(folder / "robot", bags[1])
    return folder, lost, crossed


def compared(folder, *bags, configs=MISSIONS):
    source = open_file(folder / "wire.pcap")
    bench = Settings(configs).workbench(source.info)
    return against_capture(source, [folder / bag for bag in bags], bench, Scope())


def test_each_loss_is_found_in_its_bridge(recorded):
    folder, lost, crossed = recorded
    found = compared(folder, "ground.mcap", "robot")
    rows = {row.topic: row for item in found for row in item.comparison.routes}
    assert {topic: row.lost for topic, row in rows.items()} == lost
    assert sum(lost.values()) > 40
    assert len([number for number in lost.values() if number]) == len(EVERY)
    assert {topic: row.same for topic, row in rows.items()} == crossed
    for row in rows.values():
        sent, came = (row.second, row.first) if row.back else (row.first, row.second)
        assert (row.same + row.lost, row.same) == (sent, came)
        assert (row.extra, row.altered, row.doubled) == (0, 0, 0)
        assert row.back == (TOPICS[row.msg_id][3] < 0)


def test_the_chain_of_each_command_has_what_each_bridge_lost(recorded):
    """Every command of the ground, from its publisher to the robot, with losses in both bridges."""
    folder, lost, crossed = recorded
    counts = bridge_counts(compared(folder, "ground.mcap", "robot"))
    source = open_file(folder / "wire.pcap")
    found = examine(source, Settings(MISSIONS).workbench(source.info)).diagnosis
    every = chains(found.balance, found.topics, counts)
    ways = [item for item in every if item.hops[0].hop == PUBLISHER]
    back = {item.topic: item.hops[-1] for item in every if item not in ways}
    assert {(hop.hop, topic, hop.lost) for topic, hop in back.items()} == {
        ("ground bridge to subscriber", topic, lost[topic]) for topic in back
    }
    assert len(back) == 2
    assert {item.topic for item in ways} == {"/robot_1/ground/cmd_vel", "/robot_2/ground/cmd_vel"}
    for chain in ways:
        publisher, *inside, robot = chain.hops
        to_robot = chain.topic.replace("/ground", "")
        assert (publisher.hop, robot.hop) == (PUBLISHER, PEER_TO_ROBOT)
        assert (publisher.lost, publisher.out) == (lost[chain.topic], crossed[chain.topic])
        assert (robot.lost, robot.out) == (lost[to_robot], crossed[to_robot])
        assert [hop.hop for hop in inside[:3]] == ["CI", "software bus", "application"]
        for one, following in zip(chain.hops, chain.hops[1:], strict=False):
            assert one.out == following.came, following.hop
    assert sum(chain.hops[0].lost + chain.hops[-1].lost for chain in ways) > 20


def test_delays_are_those_of_each_bridge_and_clocks_are_aligned(recorded):
    ground, robot = (item.comparison for item in compared(recorded[0], "ground.mcap", "robot"))
    assert ground.offset_ns == 0  # clocks that may be equal are taken as equal
    assert {row.latency.p50 for row in ground.routes} == {2, 7}
    # Of another clock the offset is known within the shortest way there and back: 14 ms.
    assert abs(robot.offset_ns - AHEAD_NS) <= 11 * MILLISECOND
    there, back = ({row.latency.p50 for row in robot.routes if row.back is way} for way in (False, True))
    assert len(there) == len(back) == 1
    assert there.pop() + back.pop() == pytest.approx(14, abs=0.01)


def test_what_does_not_fit_its_type_is_counted_and_not_called_lost(recorded, tmp_path):
    folder, lost, _ = recorded
    topic = "/robot_1/ground/cmd_vel"
    kept = list(open_rosbag(folder / "ground.mcap").messages({topic}))
    whole = [(item.time_ns, topic, TWIST, item.cdr) for item in kept]
    short = [(kept[40].time_ns + number, topic, TWIST, b"\0\1\0\0" + bytes(7)) for number in range(3)]
    write_mcap(tmp_path / "bag.mcap", [*whole, *short])
    (item,) = compared(folder, tmp_path / "bag.mcap")
    assert (item.left_out, item.comparison.lost) == (3, lost[topic])
    assert item.comparison.routes[0].second == len(whole)


def test_of_routes_with_one_topic_that_is_taken_which_the_messages_crossed(recorded, tmp_path):
    """A ground and a flight bridge on two ROS networks, each with its own /robot_1/pose."""
    folder, lost, _ = recorded
    texts = [path.read_text().replace("/ground/pose", "/pose") for path in MISSIONS]
    configs = [tmp_path / f"{number}.yaml" for number in range(2)]
    for path, text in zip(configs, texts, strict=True):
        path.write_text(text)
    (item,) = compared(folder, "robot", configs=configs)
    rows = {(row.link.label, row.topic): row.lost for row in item.comparison.routes}
    assert rows == {("sbn", topic): lost[topic] for topic in lost if "ground" not in topic}


def test_two_bags_alone(recorded, tmp_path):
    folder, _, _ = recorded
    messages = [(START_NS + row * 100 * MILLISECOND, "/cmd_vel", TWIST, twist(row)) for row in range(100)]
    first = write_mcap(tmp_path / "a.mcap", messages)
    late = [(time_ns + 4 * MILLISECOND, *rest) for time_ns, *rest in messages if rest[-1][4:12] != bytes(8)]
    second = write_rosbag(tmp_path / "b", [item for row, item in enumerate(late) if row not in {20, 21, 50}])
    (item,) = against_bag(first, [second], Settings().workbench().types)
    (row,) = item.as_json()["routes"]
    assert (row["topic"], row["first"], row["second"], row["lost"]) == ("/cmd_vel", 100, 96, 3)
    assert (row["link"], row["msg_id"], row["direction"]) == (None, None, "first to second")
    with pytest.raises(CaptureError, match=r"no message in common with .*a.mcap"):
        against_bag(first, [folder / "ground.mcap"], Settings().workbench().types)


def test_topics_of_two_bags_are_the_same_by_what_is_on_them(recorded):
    """From the ground to the robots and back, through cFS: other names, the same values."""
    folder, lost, crossed = recorded
    (item,) = against_bag(folder / "ground.mcap", [folder / "robot"], Settings().workbench().types)
    rows = {row.topic: row for row in item.comparison.routes}
    pairs = ("ground/cmd_vel", "cmd_vel"), ("ground/pose", "pose")
    assert rows.keys() == {f"/robot_{n}/{a}, /robot_{n}/{b}" for n in (1, 2) for a, b in pairs}
    for topic, row in rows.items():
        ground, robot = topic.split(", ")
        heard = crossed[ground] + lost[ground] * (ground.endswith("cmd_vel"))
        assert row.first == heard, topic
        assert row.second == crossed[robot] + lost[robot] * robot.endswith("pose"), topic
        assert row.same <= min(row.first, row.second)


def test_equal_values_are_counted_all_the_same(recorded, tmp_path):
    """A stick that is held still: every message has the same bytes."""
    times = [START_NS + row * 100 * MILLISECOND for row in range(100)]
    first = write_mcap(tmp_path / "a.mcap", [(at, "/cmd_vel", TWIST, twist(0.5)) for at in times])
    kept = [at + MILLISECOND for row, at in enumerate(times) if row not in {30, 31, 32, 70}]
    second = write_mcap(tmp_path / "b.mcap", [(at, "/cmd_vel", TWIST, twist(0.5)) for at in kept])
    (item,) = against_bag(first, [second], Settings().workbench().types)
    assert (item.comparison.lost, item.comparison.routes[0].same, item.comparison.routes[0].extra) == (
        4,
        96,
        0,
    )


def test_bad_input_is_one_line_each(recorded, tmp_path):
    folder, _, _ = recorded
    with pytest.raises(ConfigError, match=r"^--bag needs a mission"):
        compared(folder, "ground.mcap", configs=[])
    other = write_mcap(tmp_path / "other.mcap", [(START_NS, "/scan", "sensor_msgs/msg/LaserScan", bytes(40))])
    cases = {
        other: "has none of the topics .*; it has /scan$",
        write_mcap(tmp_path / "empty.mcap", []): "has none of the topics .*; it is empty$",
        tmp_path / "absent": "cannot be opened: No such file or directory$",
        MISSIONS[0]: "contains no ROS messages",
    }
    cmd = "/robot_1/ground/cmd_vel"
    cases[write_mcap(tmp_path / "type.mcap", [(START_NS, cmd, POSE, bytes(60))])] = (
        "cmd_vel is .*PoseStamped, and"
    )
    early = [(SECOND, cmd, TWIST, twist(7))]
    cases[write_mcap(tmp_path / "early.mcap", early)] = "no message in common with .*wire.pcap"
    cut = tmp_path / "cut.mcap"
    whole = (folder / "ground.mcap").read_bytes()
    cut.write_bytes(whole[: len(whole) // 2])
    cases[cut] = r"is cut off at byte \d+ of \d+$"
    for path, told in cases.items():
        with pytest.raises(CaptureError, match=told) as error:
            compared(folder, Path(path))
        assert "\n" not in str(error.value)
        assert str(path) in str(error.value)
