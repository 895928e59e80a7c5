"""Against real ROS 2: Jazzy and Kilted from their wheels, which ``make ros`` installs below ``.ros``.

Where the wheels cannot be had, the tests are skipped with what ``make ros`` said.
"""

import json
import os
import signal
import site
import socket
import subprocess
import sys
import threading
import time
from contextlib import ExitStack, contextmanager
from random import Random

import pytest
from effort import LONG
from namespace import ip
from places import ROOT, SUPPORT
from ros_round_trip import topics
from ros_wheels import APART, HOME, INSTALLED, Talk, python
from waiting import PATIENCE_S, free_ports, until

from edoras_tools.pipelines.bridge.plan import BridgeRequest, plan_bridges
from edoras_tools.pipelines.bridge.run import Bridges
from edoras_tools.pipelines.sending.inject import arbitrary
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.ros import TypeStore
from edoras_tools.ros.type_hash import type_hash
from edoras_tools.wire import cfe, envelope

GRAPHS = ("dds", "rclpy")
HASHES = {"jazzy": 132, "kilted": 131}
"""How many types of each distribution have a hash in its wheels and a definition here."""
PACKAGES = ("geometry_msgs", "sensor_msgs", "nav_msgs", "std_msgs", "diagnostic_msgs", "rcl_interfaces")
BRIDGED = (
    *(
        f"geometry_msgs/msg/{name}"
        for name in ("Accel", "Point", "Polygon", "Pose", "PoseArray", "Quaternion")
    ),
    *(f"geometry_msgs/msg/{name}" for name in ("PoseStamped", "PoseWithCovariance", "Transform", "Twist")),
    *(f"geometry_msgs/msg/{name}" for name in ("TransformStamped", "TwistStamped", "Vector3", "Wrench")),
    *(
        f"sensor_msgs/msg/{name}"
        for name in ("BatteryState", "CameraInfo", "CompressedImage", "Image", "Imu")
    ),
    *(f"sensor_msgs/msg/{name}" for name in ("JointState", "Joy", "LaserScan", "MagneticField", "NavSatFix")),
    *(f"sensor_msgs/msg/{name}" for name in ("PointCloud2", "Range", "Temperature")),
    *(f"nav_msgs/msg/{name}" for name in ("Odometry", "Path", "OccupancyGrid", "MapMetaData")),
    *(f"std_msgs/msg/{name}" for name in ("String", "Header", "Float64MultiArray", "Empty")),
    "diagnostic_msgs/msg/DiagnosticArray",
)
"""36 types: of all sizes, with and without sequences, arrays and strings."""


LOCAL = (
    {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"},
    {"ROS_AUTOMATIC_DISCOVERY_RANGE": "", "ROS_LOCALHOST_ONLY": "1"},
)


RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"


@contextmanager
def peer(name, types, **variables):
    """Run a real node that gives back what it hears of some types.

    Yields:
        Its environment, and what asks it on which topics our node publishes, with the hash of each type.
    """
    environ = os.environ | {RANGE: "LOCALHOST", "ROS_DOMAIN_ID": "14"} | variables
    routes = [word for item in types for word in (item, *topics(item))]
    command = [python(name), SUPPORT / "ros_peer.py", "peer", *routes]
    process = subprocess.Popen(
        command, env=environ, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout.readline() == "ready\n", process.stderr.read()

        def seen():
            process.stdin.write("round_trip\n")
            process.stdin.flush()
            return json.loads(process.stdout.readline())

        yield environ, seen
    finally:
        _, said = process.communicate(timeout=PATIENCE_S)
    # rcl itself warns that ROS_LOCALHOST_ONLY is deprecated.
    assert not [line for line in said.splitlines() if "localhost_only" not in line.casefold()]


def round_trip(ros, name, types, environ, meanwhile=lambda: None):
    """Return what ``ros_round_trip.py`` says, and what it said beside that; do something before it ends."""
    ours = {"PYTHONPATH": os.pathsep.join([str(ROOT), *site.getsitepackages()])} if ros == "rclpy" else {}
    runner = python(name) if ros == "rclpy" else sys.executable
    command = [runner, SUPPORT / "ros_round_trip.py", ros, name, *types]
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    process = subprocess.Popen(command, env=environ | ours, text=True, **pipes)
    try:
        told = process.stdout.readline()
        meanwhile()
    finally:
        _, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, said
    return json.loads(told), said


def check(name, types, told):
    """Check that a message of each type came back with the values that went out."""
    store = TypeStore(name)
    missing = [item for item in types if item not in told["back"]]
    assert not missing
    for item in types:
        sent, back = (store.decode(item, bytes.fromhex(told[way][item])) for way in ("sent", "back"))
        assert sent == back, item


@pytest.mark.parametrize("name", APART if LONG else APART[-1:])
def test_every_type_both_ways(name):
    assert len(BRIDGED) == 36
    store = TypeStore(name)
    expected = {topics(item)[0]: type_hash(store, item) for item in BRIDGED}
    with peer(name, BRIDGED) as (environ, seen):
        for ros in GRAPHS:
            told, said = round_trip(
                ros, name, BRIDGED, environ, lambda: until(lambda: seen() == expected, lambda: str(seen()))
            )
            check(name, BRIDGED, told)
            assert (told["notes"], said) == ([], "")


@pytest.mark.long
@pytest.mark.parametrize("variables", LOCAL if LONG else LOCAL[:1])
@pytest.mark.parametrize("name", APART if LONG else APART[:1])
def test_on_this_machine_only_nothing_leaves_it(name, variables):
    """The namespace has another interface, with an address and the default route; its far end is watched."""
    ip("link", "add", "leaving", "type", "veth", "peer", "name", "far")
    try:
        for end in ("leaving", "far"):
            ip("link", "set", end, "addrgenmode", "none", "up")
        ip("addr", "add", "10.9.0.1/24", "dev", "leaving")
        ip("route", "add", "default", "via", "10.9.0.2")
        with socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(3)) as watched:
            watched.bind(("far", 0))
            watched.setblocking(False)
            some = BRIDGED if LONG else BRIDGED[:3]
            theirs = variables if name == "jazzy" else {}  # Kilted no longer knows ROS_LOCALHOST_ONLY
            with peer(name, some, **theirs) as (environ, _):
                check(name, some, round_trip("dds", name, some, environ | variables)[0])
            with pytest.raises(BlockingIOError):
                watched.recv(2048)
    finally:
        ip("link", "del", "leaving")


@pytest.mark.parametrize("name", APART if LONG else APART[:1])
def test_a_node_of_this_machine_only_finds_ours_at_its_default(name):
    """Ours is on another interface then, and listens where such a node looks for others."""
    ip("link", "add", "outside", "type", "veth", "peer", "name", "far")
    try:
        for end in ("outside", "far"):
            ip("link", "set", end, "up")
        ip("addr", "add", "10.9.0.1/24", "dev", "outside")
        some = BRIDGED[:1]
        with peer(name, some) as (environ, _):
            check(name, some, round_trip("dds", name, some, environ | {RANGE: "SUBNET"})[0])
    finally:
        ip("link", "del", "outside")


def known(name):
    """Return the types of a distribution's wheels, and a store: our own definitions, but for test_msgs."""
    share = HOME / name / "share"
    store = TypeStore(name, [share / "test_msgs"])
    found = (f"{path.parts[-3]}/msg/{path.stem}" for path in sorted(share.glob("*/msg/*.json")))
    return [item for item in found if item.startswith((*PACKAGES, "test_msgs", "builtin_interfaces"))], store


@pytest.mark.quick("kilted")
@pytest.mark.parametrize("name", INSTALLED)
def test_every_message_is_what_rclpy_reads_and_writes(name):
    names, store = known(name)
    assert not [item for item in names if store.check(item)]
    dice = Random(7)
    values = {item: arbitrary(store, item, dice) for item in names}
    cdrs = {item: store.encode(item, values[item]).hex() for item in names}
    command = [python(name), SUPPORT / "ros_values.py"]
    done = subprocess.run(
        command, input=json.dumps(cdrs), capture_output=True, text=True, check=False, timeout=300
    )
    assert done.returncode == 0, done.stderr
    for item, told in json.loads(done.stdout).items():
        assert store.decode(item, bytes.fromhex(cdrs[item])) == without_placeholder(told["values"]), item
        for cdr, expected in ((told["again"], told["values"]), (told["default_cdr"], told["default"])):
            written = bytes.fromhex(cdr)
            assert store.decode(item, written) == without_placeholder(expected), item
            assert len(written) - store.extent(item, written) <= store.most_trailing(item), item
        assert store.decode(item, store.encode(item, {})) == without_placeholder(told["default"]), item


def without_placeholder(values):
    """Return values without the member that an empty message has in C."""
    if isinstance(values, dict):
        left = {key: without_placeholder(value) for key, value in values.items()}
        left.pop("structure_needs_at_least_one_member", None)
        return left
    return [without_placeholder(item) for item in values] if isinstance(values, list) else values


@pytest.mark.parametrize("name", INSTALLED)
def test_type_hashes_are_those_of_the_distribution(name):
    compared = 0
    store = TypeStore(name, [HOME / name / "share/test_msgs"])
    for path in sorted((HOME / name / "share").glob("*/msg/*.json")):
        item = f"{path.parts[-3]}/msg/{path.stem}"
        if not store.has(item):
            continue
        hashes = {
            told["type_name"]: told["hash_string"] for told in json.loads(path.read_text())["type_hashes"]
        }
        assert type_hash(store, item) == hashes[item]
        compared += 1
    assert compared >= HASHES[name]


STRING = "std_msgs/msg/String"
TOPICS, EACH, PER_SECOND = 50, 160, 2000
MISSION = """/robot_1/bridge:
  ros__parameters:
    communication: {bridge_port: %d, fsw_port: %d, fsw_ip: 127.0.0.1, telemetry_ip: 127.0.0.1}
    command: [%s]
    telemetry: [%s]
"""


def mission(folder, ports):
    """Write a mission of 50 topics each way, relative to the node's namespace; return its path."""
    ways = {"c": ("in", 0x1800), "t": ("out", 0x0800)}
    keys = [", ".join(f"{way}{number}" for number in range(TOPICS)) for way in ways]
    lines = [
        f"    {way}{number}: {{type: {STRING}, topic: {name}{number}, mid: {first + 1 + number}}}\n"
        for way, (name, first) in ways.items()
        for number in range(TOPICS)
    ]
    path = folder / "m.yaml"
    path.write_text(MISSION % (*ports, *keys) + "".join(lines))
    return path


@contextmanager
def busy(count=2):
    """Keep processors busy."""
    loops = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()


@pytest.mark.long
@pytest.mark.parametrize("name", APART)
def test_8000_messages_each_way_on_50_topics_beside_busy_loops(name, tmp_path, monkeypatch):
    """None is lost, or it is counted where."""
    monkeypatch.setenv(RANGE, "LOCALHOST")
    ports = free_ports(2)
    request = BridgeRequest(enable=False)
    plan = plan_bridges(Settings((mission(tmp_path, ports),), distro=name), request)
    numbers = {"from": 0, "to": EACH}
    inward, outward = ([f"/robot_1/{way}{number}" for number in range(TOPICS)] for way in ("in", "out"))
    with Talk(name) as talk, ExitStack() as stack:
        ci = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        ci.bind(("127.0.0.1", ports[1]))
        bridges = Bridges(plan, request, ros="dds", domain=14)
        stack.callback(bridges.close)
        thread = threading.Thread(target=bridges.run)
        thread.start()
        stack.callback(thread.join)
        stack.callback(bridges.stop)
        for topic in inward:
            talk.tell(speak=topic)
        for topic in outward:
            talk.tell(hear=topic, depth=EACH)

        def matched():
            told = talk.tell(ask=True)
            return all(told["subscriptions"].values()) and all(told["publishers"].values())

        until(matched)
        until(lambda: all(len(item.matched_sub) for _, item in bridges.stations[0]._graph._writers))
        cdrs = [TypeStore(name).encode(STRING, {"data": str(item)}) for item in range(EACH)]
        with busy():
            talk.begin(say=inward, rate=PER_SECOND, **numbers)
            began, count = time.monotonic(), 0
            for cdr in cdrs:
                for number in range(TOPICS):
                    packet = cfe.emit_telemetry(0x0801 + number, envelope.DEFAULT.emit(cdr))
                    ci.sendto(packet, ("127.0.0.1", ports[0]))
                    count += 1
                    time.sleep(max(began + count / PER_SECOND - time.monotonic(), 0))
            talk.answer()

            def settled():
                told = talk.tell(ask=True)
                rows = {row["topic"]: row for row in bridges.summary()["bridges"][0]["routes"]}
                came = sum(rows[topic]["in"] for topic in inward)
                heard = sum(len(told["heard"].get(topic, [])) for topic in outward)
                sent = sum(rows[topic]["out"] for topic in outward)
                drops = bridges.stations[0].drops
                lost = sum(rows[topic]["overwritten"] for topic in outward) + sum(told["lost"].values())
                figures = {"came": came, "heard": heard, "sent": sent, "drops": drops, "lost": lost}
                figures["dropped"] = bridges.summary()["bridges"][0]["graph_drops"]
                complete = (
                    came + figures["dropped"] >= TOPICS * EACH
                    and sent + drops == TOPICS * EACH
                    and heard + lost >= sent
                )
                return complete and figures

            figures = until(
                settled, lambda: str((settled(), bridges.summary(), talk.tell(ask=True)["lost"]))[:4000]
            )
    print(name, figures)


@contextmanager
def follower(ros, name, **variables):
    """Run ``ros_follow.py``; yield the process and what asks it."""
    environ = os.environ | {RANGE: "LOCALHOST", "ROS_DOMAIN_ID": "14"} | variables
    if ros == "rclpy":
        environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), *site.getsitepackages()])
    runner = python(name) if ros == "rclpy" else sys.executable
    command = [runner, SUPPORT / "ros_follow.py", ros, name, "/in"]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    process = subprocess.Popen(command, env=environ, text=True, **pipes)

    def ask():
        process.stdin.write("\n")
        process.stdin.flush()
        return json.loads(process.stdout.readline())

    try:
        yield process, ask
    finally:
        process.communicate(timeout=PATIENCE_S)


@pytest.mark.long
@pytest.mark.parametrize("name", APART)
def test_rclpy_follows_what_publishes(name):
    with Talk(name) as talk, follower("rclpy", name) as (_, ask):
        number = 0
        for kind in ([True, True], [True, False], [False, True], [False, False]):
            talk.tell(speak="/in", reliable=kind[0], transient_local=kind[1])

            def followed(kind=kind):
                nonlocal number
                talk.tell(say=["/in"], **{"from": number, "to": number + 1})
                number += 1
                state = ask()
                return state["asked"] == [kind] and state["heard"][-1:] >= [number - 9]

            until(followed)
            talk.tell(hush="/in")
        heard = ask()["heard"]
        assert heard == sorted({*heard})


@pytest.mark.long
@pytest.mark.parametrize("name", APART)
def test_what_is_published_once_our_subscription_is_counted_comes(name):
    """The publisher was there before us, and says the first as soon as it counts us."""
    with Talk(name) as talk:
        talk.tell(speak="/in")
        with follower("dds", name) as (_, ask):
            until(lambda: talk.tell(ask=True)["subscriptions"]["/in"])
            talk.tell(say=["/in"], **{"from": 0, "to": 10})
            until(lambda: ask()["heard"] == [*range(10)], lambda: str(ask()))


@pytest.mark.long
@pytest.mark.parametrize("name", APART)
def test_what_a_history_of_theirs_overwrites_is_dropped_by_a_socket_of_ours(name):
    """We stand still, and more is published than the sockets of ours take: the kernel counts what went."""
    with Talk(name) as talk, follower("dds", name) as (process, ask):
        talk.tell(speak="/in")

        def matched():
            talk.tell(say=["/in"], **{"from": 0, "to": 1})
            return ask()["heard"]

        until(matched)
        assert ask()["dropped"] == 0
        last = 0
        for count in (2000, 40_000):  # that many fit, and do not
            os.kill(process.pid, signal.SIGSTOP)
            talk.tell(say=["/in"], **{"from": last + 1, "to": last + count + 1})
            os.kill(process.pid, signal.SIGCONT)
            last += count
            told = until(lambda last=last: (told := ask())["heard"][-1] == last and told)
            came = [item for item in told["heard"] if item]
            assert came == sorted({*came})
            print(name, count, len(came), told["dropped"])
            assert (len(came) < last) == (count == 40_000) == (told["dropped"] >= last - len(came) > 0)
