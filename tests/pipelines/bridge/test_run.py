"""Bridges at work: between a graph in this process and sockets, or the emulated cFS."""

from __future__ import annotations

import re
import socket
import threading
import time
from contextlib import ExitStack
from itertools import count

import pytest
from msgspec.structs import replace
from places import MISSIONS
from waiting import HOST, PATIENCE_S, free_ports, until

from edoras_tools.addons.lab.demo.local_graph import open_graph
from edoras_tools.addons.lab.emulator import Served, Simulation
from edoras_tools.cfs.profile import Ports, SimProfile
from edoras_tools.errors import CaptureError, RouteError
from edoras_tools.middleware import Qos
from edoras_tools.middleware.graph import TopicState
from edoras_tools.model import Peer
from edoras_tools.pipelines.bridge.plan import BridgeRequest, plan_bridges
from edoras_tools.pipelines.bridge.run import Bridges
from edoras_tools.pipelines.capture.record import Target
from edoras_tools.pipelines.recorder import RelayRecorder
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire import cfe, envelope, sbn

CDR = bytes.fromhex("00010000") + bytes(range(48))
DOMAINS = count(1000)


class Room:
    """Free ports, mission files that name them, bridges and a graph; ended in the right order."""

    def __init__(self, stack, folder):
        self.stack, self.folder = stack, folder
        self.domain = next(DOMAINS)
        self.ports = dict(zip(("1234", "1235", "2234", "2236"), free_ports(4), strict=True))
        self.node = self.join()

    def join(self):
        graph = open_graph(self.store, "tests", domain=self.domain)
        self.stack.callback(graph.close)
        return graph

    @property
    def store(self):
        return Settings().workbench().types

    def file(self, name, *changes):
        text = (MISSIONS / f"{name}.yaml").read_text()
        text = re.sub(r"(?<=: )\d{4}\b", lambda found: str(self.ports[found[0]]), text)
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        path = self.folder / f"{name}.yaml"
        path.write_text(text)
        return path

    def bridges(self, *files, request=None, output=None, run=True):
        request = request or BridgeRequest()
        plan = plan_bridges(Settings(files), request)
        made = Bridges(
            plan,
            request,
            domain=self.domain,
            recorder=output and (lambda: RelayRecorder(Target(output), plan.workbench(), "test", "bridge")),
        )
        thread = threading.Thread(target=made.run)

        def end():
            made.stop()
            if thread.ident:
                thread.join(PATIENCE_S)
                assert not thread.is_alive()
            made.close()

        made.end = end
        self.stack.callback(end)
        if run:
            thread.start()
        return made

    def socket(self, port):
        opened = self.stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8 << 20)
        opened.bind((HOST, self.ports[port]))
        opened.settimeout(PATIENCE_S)
        return opened

    def simulation(self, scenario, **changes):
        """The emulated cFS on these ports; hasty, unless told otherwise."""
        fast = 5 * MILLISECOND
        profile = replace(
            SimProfile(
                ci_wake_ns=fast,
                to_wake_ns=fast,
                sbn_wake_ns=fast,
                wakeup_ns=fast,
                housekeeping_ns=40 * fast,
            ).on(Ports(*(self.ports[usual] for usual in ("1234", "1235", "2234", "2236")))),
            **changes,
        )
        made = Simulation(profile, scenario, bridges=False)
        served = ExitStack()
        served.enter_context(Served(made))
        self.stack.callback(served.close)
        made.end = served.close
        return made


@pytest.fixture
def room(tmp_path):
    with ExitStack() as stack:
        yield Room(stack, tmp_path)


def command(ci):
    """The next that is no request to Telemetry Output, which is asked again and again."""
    return until(lambda: (data := ci.recv(2048))[:2] != b"\x18\x80" and data)


def routes(bridges):
    return {row["topic"]: row for item in bridges.summary()["bridges"] for row in item["routes"]}


def test_a_message_goes_to_ci_and_telemetry_comes_back_byte_for_byte(room):
    ci = room.socket("1234")
    bridges = room.bridges(room.file("rover_ground"), request=BridgeRequest(checksum=True, sequence=True))
    enable = ci.recv(2048)
    assert (enable[:8].hex()[:4], enable[6], cfe.checksum(enable)) == ("1880", 6, 0)
    heard = []
    room.node.subscribe("/telemetry_pose", "geometry_msgs/msg/PoseStamped", Qos(), heard.append)
    publish = room.node.advertise("/cmd_vel", "geometry_msgs/msg/Twist", Qos())
    for number in range(3):
        publish(CDR)
        assert command(ci) == cfe.emit_command(0x1827, 1, envelope.DEFAULT.emit(CDR), sequence_count=number)
    pose = room.store.encode("geometry_msgs/msg/PoseStamped", {"header": {"frame_id": "map"}})
    packet = cfe.emit_telemetry(0x0827, envelope.DEFAULT.emit(pose) + bytes(33))
    ci.sendto(packet, (HOST, room.ports["1235"]))
    until(lambda: heard)
    assert heard == [pose]
    bridges.end()
    summary = bridges.summary()
    assert [(row["in"], row["out"]) for row in summary["bridges"][0]["routes"]] == [(3, 3), (1, 1)]
    assert summary["lost"] == 0
    assert summary["bridges"][0]["to_cfs"]["latency_us"]["p50"] > 0
    assert summary["bridges"][0]["from_cfs"]["latency_us"]["p50"] > 0


def test_a_peer_is_answered_and_told_goodbye(room):
    cfs = room.socket("2234")
    bridges = room.bridges(room.file("two_rovers_flight"))
    assert [cfs.recv(99)[2] for _ in range(2)] == [sbn.MsgType.DISCONNECT, sbn.MsgType.PROTO]
    us, own = (HOST, room.ports["2236"]), Peer(0x42, 1)
    cfs.sendto(sbn.emit(sbn.MsgType.PROTO, own, sbn.emit_proto()), us)
    until(lambda: "flight_conversion_node: connected to peer 66:1" in bridges.notes)
    publish = room.node.advertise("/robot_1/pose", "geometry_msgs/msg/PoseStamped", Qos())
    publish(CDR)
    kinds = []

    def gone():
        kinds.append(cfs.recv(2048)[2])
        if kinds[-1] == sbn.MsgType.APP:
            bridges.end()
        return kinds[-1] == sbn.MsgType.DISCONNECT

    until(gone, lambda: kinds)
    assert [kind for kind in kinds if kind not in {sbn.MsgType.PROTO, sbn.MsgType.HEARTBEAT}] == [
        sbn.MsgType.SUB,
        sbn.MsgType.APP,
        sbn.MsgType.UNSUB,
        sbn.MsgType.DISCONNECT,
    ]


DEMOS = {
    "rover": (["rover_ground"], "/cmd_vel", "/telemetry_pose"),
    "arm": (["single_arm_ground"], "/command_pose", "/telemetry_joint_state"),
}


@pytest.mark.parametrize("scenario", DEMOS)
def test_an_order_moves_the_robot_and_its_state_comes_back(room, scenario):
    files, order, state = DEMOS[scenario]
    room.simulation(scenario)
    bridges = room.bridges(*map(room.file, files))
    types = {route.topic: route.type for item in bridges.plan.stations for route in item.bridge.routes}
    heard = []
    room.node.subscribe(state, types[state], Qos(), heard.append)
    until(lambda: heard)
    first = room.store.decode(types[state], heard[0])
    values = (
        {"linear": {"x": 1.0}}
        if scenario == "rover"
        else {"position": {"x": 0.4, "y": 0.2, "z": 0.6}, "orientation": {"w": 1.0}}
    )
    publish = room.node.advertise(order, types[order], Qos())

    def moved():
        publish(room.store.encode(types[order], values))
        last = room.store.decode(types[state], heard[-1])
        key = "pose" if scenario == "rover" else "position"
        return last[key] != first[key]

    until(moved)
    assert routes(bridges)[order]["refused"] == {}


@pytest.mark.parametrize("scenario", ["two-rovers", "two-arms"])
def test_an_order_crosses_both_bridges_and_state_comes_back_the_same(room, scenario):
    name = scenario.replace("-", "_")
    room.simulation(scenario)
    bridges = room.bridges(room.file(f"{name}_ground"), room.file(f"{name}_flight"))
    ground, flight = (item.bridge for item in bridges.plan.stations)
    orders = [route for route in ground.routes if route.to_cfs]
    states = [route for route in flight.routes if route.to_cfs]
    heard = {}

    def hear(route):
        room.node.subscribe(
            route.topic, route.type, Qos(), lambda cdr: heard.setdefault(route.topic, []).append(cdr)
        )

    for route in (*ground.routes, *flight.routes):
        if not route.to_cfs:
            hear(route)
    until(lambda: all(item.machine.link.ready for item in bridges.stations))
    sent = {}
    for route in (*orders, *states):
        # Every value differs from its default: bytes that are equal are no accident.
        values = {
            "geometry_msgs/msg/Twist": {"linear": {"x": 0.25, "y": -1.5}, "angular": {"z": 3.25}},
            "geometry_msgs/msg/Pose": {"position": {"x": 1.5}, "orientation": {"w": 1.0}},
            "geometry_msgs/msg/PoseStamped": {
                "header": {"frame_id": "map"},
                "pose": {"position": {"y": 7.0}},
            },
            "sensor_msgs/msg/JointState": {"name": ["a", "b"], "position": [1.0, -2.5]},
        }[route.type]
        sent[route] = room.store.encode(route.type, values)
    publish = {route: room.node.advertise(route.topic, route.type, Qos()) for route in sent}
    out = [route.topic for route in (*ground.routes, *flight.routes) if not route.to_cfs]

    def arrived():
        for route, cdr in sent.items():
            publish[route](cdr)
        return all(heard.get(topic) for topic in out)

    until(arrived)
    wanted = {*sent.values()}
    assert {cdr for topic in out for cdr in heard[topic]} <= wanted
    for topic in out:
        kind = next(r.type for r in (*ground.routes, *flight.routes) if r.topic == topic)
        assert heard[topic][0] in {cdr for route, cdr in sent.items() if route.type == kind}


def test_250_hz_of_state_reach_cfs_at_the_rate_that_the_file_allows(room):
    cfs = room.socket("2234")
    file = room.file("two_rovers_flight", ("mid: 0x1829", "mid: 0x1829\n      max_rate: 30"))
    bridges = room.bridges(file)
    own = Peer(0x42, 1)
    cfs.sendto(sbn.emit(sbn.MsgType.PROTO, own, sbn.emit_proto()), (HOST, room.ports["2236"]))
    until(lambda: bridges.stations[0].machine.link.ready)
    publish = room.node.advertise("/robot_1/pose", "geometry_msgs/msg/PoseStamped", Qos())
    began = time.monotonic()
    for number in range(250):
        publish(bytes.fromhex("00010000") + number.to_bytes(4, "little"))
        time.sleep(0.004)
    took = time.monotonic() - began
    until(lambda: routes(bridges)["/robot_1/pose"]["waiting"] == 0)
    row = routes(bridges)["/robot_1/pose"]
    assert (row["in"], row["in"]) == (250, row["out"] + row["held"])
    assert row["out"] <= 30 * (took + 0.1) + 2
    got = []

    def last():
        data = cfs.recv(2048)
        if data[2] == sbn.MsgType.APP:
            got.append(int.from_bytes(data[-4:], "little"))
        return got[-1:] == [249]

    until(last, lambda: got)
    assert got == sorted(got)
    assert len(got) == row["out"]


def test_what_the_file_wants_in_telemetry_output_s_table_is_not_lost_there(room):
    room.simulation("two-rovers", to_wake_ns=200 * MILLISECOND, app_msg_limit=32, app_pipe_depth=64)
    wanted = ("mid: 0x828", "mid: 0x828\n      to_limit: 255")
    bridges = room.bridges(room.file("two_rovers_ground", wanted), room.file("two_rovers_flight"))
    kind, heard = "geometry_msgs/msg/PoseStamped", []
    room.node.subscribe("/robot_1/ground/pose", kind, Qos(), heard.append)
    until(lambda: all(item["connected"] for item in bridges.summary()["bridges"]))
    publish = room.node.advertise("/robot_1/pose", kind, Qos())
    sent = [room.store.encode(kind, {"pose": {"position": {"x": float(number)}}}) for number in range(12)]
    for cdr in sent:
        publish(cdr)
    until(lambda: len(heard) == len(sent))  # four is what Telemetry Output keeps of one MsgId otherwise
    assert heard == sent


def test_what_crosses_is_recorded(room, recording_of):
    ci = room.socket("1234")
    path = room.folder / "a.mcap"
    bridges = room.bridges(room.file("rover_ground"), request=BridgeRequest(enable=False), output=path)
    publish = room.node.advertise("/cmd_vel", "geometry_msgs/msg/Twist", Qos())
    publish(CDR)
    ci.recv(2048)
    pose = room.store.encode("geometry_msgs/msg/PoseStamped", {"header": {"frame_id": "map"}})
    ci.sendto(cfe.emit_telemetry(0x0827, envelope.DEFAULT.emit(pose)), (HOST, room.ports["1235"]))
    until(lambda: routes(bridges)["/telemetry_pose"]["out"] == 1)
    bridges.end()
    assert bridges.summary()["recorded"] == 2
    found = recording_of(path)
    assert (found["/cmd_vel"], found["/telemetry_pose"]) == ([CDR], [pose])
    assert len(found["/edoras/datagrams"]) == 2


@pytest.fixture
def recording_of():
    from mcap.reader import make_reader

    def read(path):
        topics = {}
        with path.open("rb") as file:
            for _, channel, message in make_reader(file).iter_messages():
                topics.setdefault(channel.topic, []).append(message.data)
        return topics

    return read


IN_USE = "cannot be bound: another program has port {} (a bridge?): stop it, or choose another bridge_port"


def test_topics_that_the_graph_refuses_are_told_and_the_other_bridge_goes_on(room):
    for topic in ("cmd_vel", "pose"):
        for robot in (1, 2):
            room.node.advertise(f"/robot_{robot}/ground/{topic}", "geometry_msgs/msg/Pose", Qos())
    bridges = room.bridges(room.file("two_rovers_ground"), room.file("two_rovers_flight"))
    assert [item.plan.kind for item in bridges.stations] == ["flight"]
    assert bridges.notes[0].startswith("conversion_node: /robot_1/ground/cmd_vel is left out: ")
    (note,) = bridges.notes[4:]
    assert note.startswith("conversion_node is left out: no topic of conversion_node can be joined; the last")
    room.socket("1235")


def test_a_port_in_use_is_told_and_the_other_bridge_goes_on(room):
    room.socket("1235")
    ground, flight = room.file("two_rovers_ground"), room.file("two_rovers_flight")
    bridges = room.bridges(ground, flight)
    assert [item.plan.kind for item in bridges.stations] == ["flight"]
    taken = room.ports["1235"]
    assert bridges.notes == [
        f"conversion_node is left out: {ground}:4: UDP {HOST}:{taken}: {IN_USE.format(taken)}"
    ]
    with pytest.raises(CaptureError, match="another program has port"):
        room.bridges(ground, run=False)


def test_a_topic_that_the_graph_refuses_is_left_out(room):
    room.node.advertise("/cmd_vel", "geometry_msgs/msg/Pose", Qos())
    room.socket("1234")
    bridges = room.bridges(room.file("rover_ground"))
    (note,) = [note for note in bridges.notes if "left out" in note]
    assert note.startswith(
        "conversion_node: /cmd_vel is left out: /cmd_vel is geometry_msgs/msg/Pose in this graph"
    )
    assert list(routes(bridges)) == ["/telemetry_pose"]
    room.node.advertise("/telemetry_pose", "geometry_msgs/msg/PoseStamped", Qos())


def test_no_topic_at_all_is_an_error_and_leaves_nothing_open(room):
    for topic in ("/cmd_vel", "/telemetry_pose"):
        room.node.advertise(topic, "geometry_msgs/msg/Pose", Qos())
    with pytest.raises(RouteError, match=r"no topic of conversion_node can be joined; .* in this graph"):
        room.bridges(room.file("rover_ground"), run=False)
    room.socket("1235")


def test_a_message_that_cannot_be_published_is_counted(room):
    bridges = room.bridges(room.file("rover_ground"))

    def broken(_cdr):
        raise RuntimeError("no such luck\nat all")

    room.node.subscribe("/telemetry_pose", "geometry_msgs/msg/PoseStamped", Qos(), broken)
    cfs = room.socket("1234")
    pose = room.store.encode("geometry_msgs/msg/PoseStamped", {})
    cfs.sendto(cfe.emit_telemetry(0x0827, envelope.DEFAULT.emit(pose)), (HOST, room.ports["1235"]))
    until(lambda: routes(bridges)["/telemetry_pose"]["refused"])
    assert routes(bridges)["/telemetry_pose"]["refused"] == {"not published: no such luck": 1}


def test_nothing_is_lost_at_full_speed_both_ways(room):
    ci = room.socket("1234")
    bridges = room.bridges(room.file("rover_ground"), request=BridgeRequest(enable=False))
    heard = []
    room.node.subscribe("/telemetry_pose", "geometry_msgs/msg/PoseStamped", Qos(), heard.append)
    publish = room.node.advertise("/cmd_vel", "geometry_msgs/msg/Twist", Qos())
    cdr = room.store.encode("geometry_msgs/msg/PoseStamped", {})
    packet = cfe.emit_telemetry(0x0827, envelope.DEFAULT.emit(cdr))
    total, step = 4000, 200
    for first in range(0, total, step):
        for _ in range(step):
            publish(CDR)
            ci.sendto(packet, (HOST, room.ports["1235"]))
        for _ in range(step):
            assert len(ci.recv(2048)) == 76
        until(lambda first=first: len(heard) == first + step)
    bridges.end()
    summary = bridges.summary()
    assert [(row["in"], row["out"]) for row in summary["bridges"][0]["routes"]] == [(total, total)] * 2
    assert summary["lost"] == 0


def test_it_ends_by_itself_after_its_duration(room):
    bridges = room.bridges(room.file("rover_ground"), run=False)
    bridges.run(duration_ns=SECOND // 50)
    assert not bridges.interrupted
    bridges.close()


def test_bridges_behind_one_server_share_it(room, monkeypatch):
    opened = []

    def served(_ros, store, name, **_options):
        opened.append(name)
        return open_graph(store, name, domain=room.domain)

    monkeypatch.setattr("edoras_tools.pipelines.bridge.run.open_graph", served)
    plan = plan_bridges(
        Settings((room.file("two_rovers_ground"), room.file("two_rovers_flight"))), BridgeRequest()
    )
    bridges = Bridges(plan, ros="foxglove")
    bridges.run(duration_ns=MILLISECOND)
    bridges.close()
    assert (len(bridges.stations), opened) == (2, ["conversion_node"])


def test_quality_of_service_is_said_once_and_what_a_history_lost_is_counted(room, monkeypatch):
    """A sensor publishes best effort, and is heard; a middleware says what it lost."""
    room.socket("1234")
    bridges = room.bridges(room.file("rover_ground"))
    publish = room.node.advertise("/cmd_vel", "geometry_msgs/msg/Twist", Qos(reliable=False))
    until(lambda: publish(CDR) or routes(bridges)["/cmd_vel"]["in"])
    note = "conversion_node: automatic quality of service best_effort, volatile, depth 10: /cmd_vel"
    until(lambda: note in bridges.notes)
    row = routes(bridges)["/cmd_vel"]
    assert row["qos"] == [{"reliability": "best_effort", "durability": "volatile", "depth": 10}]
    assert (row["missed"], row["overwritten"], bridges.lost) == (0, 0, 0)
    states = {"/cmd_vel": TopicState((Qos(),), missed=3), "/telemetry_pose": TopicState((), overwritten=2)}
    monkeypatch.setattr(bridges.stations[0]._graph, "states", lambda: states)
    bridges.end()
    rows = routes(bridges)
    assert (rows["/cmd_vel"]["missed"], rows["/telemetry_pose"]["overwritten"]) == (3, 2)
    assert bridges.summary()["lost"] == 2
    assert bridges.notes.count(note) == 1
