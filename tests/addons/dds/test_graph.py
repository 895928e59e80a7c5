"""A node on DDS against another program, whose classes are written by hand; rosbags judges the bytes."""

import json
import os
import signal
import subprocess
import sys
import threading
from contextlib import ExitStack
from random import Random

import numpy as np
import pytest
from cyclonedds.domain import DomainParticipant
from dds_loopback import OPTIONS, URI
from places import SUPPORT
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore
from waiting import PATIENCE_S

from edoras_tools.addons.dds import endpoints
from edoras_tools.addons.dds.graph import open_graph
from edoras_tools.errors import ConfigError, WireError
from edoras_tools.middleware import Qos
from edoras_tools.pipelines.sending.inject import arbitrary
from edoras_tools.ros import TypeStore

pytestmark = pytest.mark.own_network

PEER = SUPPORT / "dds_peer.py"
TYPES = TypeStore()
ROSBAGS = get_typestore(Stores.ROS2_JAZZY)
STRING = "std_msgs/msg/String"
HEADER = {"stamp": {"sec": 7, "nanosec": 8}, "frame_id": "map"}
CASES = {
    STRING: {"data": "hello"},
    "geometry_msgs/msg/Twist": {
        "linear": {"x": 0.5, "y": -1.0, "z": 0.0},
        "angular": {"x": 0.0, "y": 1e300, "z": 0.25},
    },
    "geometry_msgs/msg/PoseStamped": {
        "header": HEADER,
        "pose": {
            "position": {"x": 1.0, "y": 2.0, "z": 3.0},
            "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
        },
    },
    "sensor_msgs/msg/JointState": {
        "header": HEADER,
        "name": ["elbow", "wrist"],
        "position": [0.0, 1.5],
        "velocity": [],
        "effort": [0.0],
    },
}
"""Ends of all kinds: with padding, with zeros that are none, with numbers."""


class Peer:
    """The other program."""

    def __init__(self):
        self.process = subprocess.Popen(
            [sys.executable, PEER],
            env=os.environ | {"CYCLONEDDS_URI": URI},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.lines = []
        self.thread = threading.Thread(target=self._read)
        self.thread.start()

    def _read(self):
        self.lines.extend(map(json.loads, self.process.stdout))

    def ask(self, **line):
        self.process.stdin.write(json.dumps(line) + "\n")
        self.process.stdin.flush()

    def heard(self, topic):
        return [line for line in self.lines if line.get("heard") == topic]

    def matched(self, graph, *topics):
        """Tell whether both sides know of each other: the one may long before the other."""
        ours = [
            *(bool(reader.matched_pub) for name, reader in graph._readers if "rt" + name in topics),
            *(bool(writer.matched_sub) for name, writer in graph._writers if "rt" + name in topics),
        ]
        told = all({"matched": topic} in self.lines for topic in topics)
        return len(ours) == len(topics) and all(ours) and told

    def close(self):
        self.process.stdin.close()
        self.process.wait(PATIENCE_S)
        self.thread.join(PATIENCE_S)
        self.process.stdout.close()


@pytest.fixture
def peer():
    other = Peer()
    yield other
    other.close()


@pytest.fixture
def node():
    """Open a node, closed when the test ends."""
    with ExitStack() as stack:

        def opened(name="bridge", **options):
            graph = open_graph(TYPES, name, **({"options": OPTIONS} | options))
            stack.callback(graph.close)
            return graph

        yield opened


def as_rosbags(name, values):
    """Return nested dicts as a message of rosbags'."""

    def one(kind, value):
        if kind[0] is Nodetype.NAME:
            return as_rosbags(kind[1], value)
        numbers = kind[0] is Nodetype.SEQUENCE and kind[1][0][1][0] == "float64"
        return np.array(value, np.float64) if numbers else value

    return ROSBAGS.types[name](**{key: one(kind, values[key]) for key, kind in ROSBAGS.fielddefs[name][1]})


def judged(name, values):
    """Return a message as rosbags writes it."""
    return bytes(ROSBAGS.serialize_cdr(as_rosbags(name, values), name))


def topic_of(type_name):
    return "/" + type_name.rpartition("/")[2].lower()


def test_another_program_speaks_and_its_bytes_come_as_rosbags_writes_them(node, peer, until):
    heard = {name: [] for name in CASES}
    graph = node()
    for name in CASES:
        graph.subscribe(topic_of(name), name, Qos(), heard[name].append)
        peer.ask(speak="rt" + topic_of(name), type=name.rpartition("/")[2])
    until(lambda: peer.matched(graph, *("rt" + topic_of(name) for name in CASES)))
    for name, values in CASES.items():
        peer.ask(say="rt" + topic_of(name), values=values)
    until(lambda: all(heard.values()))
    assert heard == {name: [judged(name, values)] for name, values in CASES.items()}


def test_another_program_hears_what_rosbags_wrote(node, peer, until):
    graph = node()
    publish = {name: graph.advertise(topic_of(name), name, Qos()) for name in CASES}
    for name in CASES:
        peer.ask(hear="rt" + topic_of(name), type=name.rpartition("/")[2])
    until(lambda: peer.matched(graph, *("rt" + topic_of(name) for name in CASES)))
    for name, values in CASES.items():
        publish[name](judged(name, values))
        (line,) = until(lambda name=name: peer.heard("rt" + topic_of(name)))
        assert line["values"] == values
        assert bytes.fromhex(line["cdr"]) == judged(name, values)


@pytest.mark.long
def test_an_empty_message_is_one_byte(node, peer, until):
    graph, heard = node(), []
    graph.subscribe("/in", "std_msgs/msg/Empty", Qos(), heard.append)
    publish = graph.advertise("/out", "std_msgs/msg/Empty", Qos())
    peer.ask(speak="rt/in", type="Empty")
    peer.ask(hear="rt/out", type="Empty")
    until(lambda: peer.matched(graph, "rt/in", "rt/out"))
    peer.ask(say="rt/in", values={"structure_needs_at_least_one_member": 0})
    publish(TYPES.encode("std_msgs/msg/Empty", {}))
    assert until(lambda: heard) == [b"\0\1\0\0\0"]
    assert until(lambda: peer.heard("rt/out"))[0]["values"] == {"structure_needs_at_least_one_member": 0}


def test_what_offers_less_than_is_asked_for_is_not_heard_and_is_told(node, peer, until):
    graph, heard = node(), []
    unsure = graph.advertise("/unsure", STRING, Qos(reliable=False))
    peer.ask(hear="rt/unsure", type="String", reliable=True)
    peer.ask(hear="rt/sure", type="String", reliable=False)
    sure = graph.advertise("/sure", STRING, Qos())
    graph.subscribe("/late", STRING, Qos(transient_local=True), heard.append)
    peer.ask(speak="rt/late", type="String", transient_local=False)
    until(lambda: peer.matched(graph, "rt/sure"))
    told = []
    until(lambda: told.extend(graph.notes()) or len(told) == 2)
    line = "{}: a {} does not match: the {} differs; write qos: {{{}}} for this topic in the mission file"
    assert sorted(told) == [
        line.format("/late", "publisher", "durability", "durability: volatile"),
        line.format("/unsure", "subscriber", "reliability", "reliability: reliable"),
    ]
    assert graph.notes() == []
    unsure(judged(STRING, {"data": "not this"}))
    sure(judged(STRING, {"data": "this"}))
    peer.ask(say="rt/late", values={"data": "nor this"})
    assert until(lambda: peer.heard("rt/sure"))[0]["values"] == {"data": "this"}
    assert not peer.heard("rt/unsure")
    assert not heard


@pytest.mark.long
def test_a_late_subscriber_gets_the_last_messages_where_they_are_kept(node, peer, until):
    graph = node()
    kept = graph.advertise("/kept", STRING, Qos(transient_local=True, depth=3))
    gone = graph.advertise("/gone", STRING, Qos())
    for number in range(5):
        kept(judged(STRING, {"data": f"{number}"}))
        gone(judged(STRING, {"data": f"{number}"}))
    peer.ask(hear="rt/gone", type="String")
    peer.ask(hear="rt/kept", type="String", transient_local=True)
    until(lambda: peer.matched(graph, "rt/gone") and len(peer.heard("rt/kept")) == 3)
    gone(judged(STRING, {"data": "new"}))
    until(lambda: peer.heard("rt/gone"))
    assert [line["values"]["data"] for line in peer.heard("rt/kept")] == ["2", "3", "4"]
    assert [line["values"]["data"] for line in peer.heard("rt/gone")] == ["new"]


@pytest.mark.long
def test_a_late_subscriber_is_given_no_more_than_it_asked_for(node, peer, until):
    graph, heard = node(), []
    graph.subscribe("/kept", STRING, Qos(transient_local=True, depth=9), heard.append)
    peer.ask(speak="rt/kept", type="String", transient_local=True, depth=9)
    until(lambda: peer.matched(graph, "rt/kept"))
    for number in range(5):
        peer.ask(say="rt/kept", values={"data": f"{number}"})
    until(lambda: len(heard) == 5)
    late = []
    node("late").subscribe("/kept", STRING, Qos(transient_local=True, depth=5), late.append)
    until(lambda: len(late) == 5)
    assert late == heard


def test_a_node_hears_others_of_its_process_but_not_itself(node, until):
    one, other = node("one"), node("other")
    heard = {"one": [], "other": []}
    one.subscribe("/chat", STRING, Qos(), heard["one"].append)
    other.subscribe("/chat", STRING, Qos(), heard["other"].append)
    speak = {"one": one.advertise("/chat", STRING, Qos()), "other": other.advertise("/chat", STRING, Qos())}

    def everybody_hears():
        for name, publish in speak.items():
            publish(judged(STRING, {"data": name}))
        return all(heard.values())

    until(everybody_hears)
    assert set(heard["one"]) == {judged(STRING, {"data": "other"})}
    assert set(heard["other"]) == {judged(STRING, {"data": "one"})}


def test_others_see_the_node_and_what_it_has(node, peer, until):
    graph = node("/rover/bridge")
    peer.ask(hear="ros_discovery_info", type="ParticipantEntitiesInfo", transient_local=True, depth=100)
    graph.subscribe("/chat", STRING, Qos(), lambda _: None)
    graph.advertise("/said", STRING, Qos())

    def complete():
        assert graph.notes() == []  # and it learns that the identifiers of this peer have 24 bytes
        for line in peer.heard("ros_discovery_info"):
            (entities,) = line["values"]["node_entities_info_seq"]
            if entities["reader_gid_seq"] and entities["writer_gid_seq"]:
                return line["values"]["gid"], entities
        return None

    gid, entities = until(complete)
    until(lambda: {"user_data": "enclave=/;"} in peer.lines)
    assert (entities["node_namespace"], entities["node_name"]) == ("/rover", "bridge")
    gids = [gid, *entities["reader_gid_seq"], *entities["writer_gid_seq"]]
    prefixes = {bytes(item["data"][:12]) for item in gids}
    kinds = [item["data"][15] for item in gids]
    assert len(gids) == 3
    assert prefixes == {graph._participant.guid.bytes[:12]}
    assert kinds == [0xC1, 0x04, 0x03]  # a participant, a reader, a writer without key (RTPS 9.3.1.2)
    assert all(item["data"][16:] == [0] * 8 for item in gids)


@pytest.mark.long
def test_every_message_of_a_flood_arrives_in_order(node, until):
    count = 20_000
    one, other, heard = node("one"), node("other"), []
    other.subscribe("/flood", STRING, Qos(depth=0), heard.append)
    publish = one.advertise("/flood", STRING, Qos(depth=0))
    until(lambda: one._writers[0][1].matched_sub)
    sent = [judged(STRING, {"data": f"{number}"}) for number in range(count)]
    for cdr in sent:
        publish(cdr)
    until(lambda: len(heard) >= count)
    assert heard == sent


def test_a_subscriber_that_stands_still_holds_up_only_who_keeps_all(node, peer, until):
    graph, sent = node(), []
    usual = graph.advertise("/usual", STRING, Qos())
    whole = graph.advertise("/whole", STRING, Qos(depth=0))
    peer.ask(hear="rt/usual", type="String")
    peer.ask(hear="rt/whole", type="String", depth=0)
    until(lambda: peer.matched(graph, "rt/usual", "rt/whole"))
    cdr = judged(STRING, {"data": "x" * 10_000})

    def flood(publish):
        for _ in range(1000):
            publish(cdr)
            sent.append(publish)

    peer.process.send_signal(signal.SIGSTOP)
    try:
        flood(usual)
        with pytest.raises(WireError, match=r"/whole: .* is lost: a reliable subscriber did not keep up"):
            flood(whole)
    finally:
        peer.process.send_signal(signal.SIGCONT)
    assert sent.count(whole)
    until(lambda: len(peer.heard("rt/whole")) == sent.count(whole))


@pytest.mark.long
def test_large_messages_arrive_whole(node, peer, until):
    graph = node()
    publish = graph.advertise("/large", STRING, Qos())
    peer.ask(hear="rt/large", type="String")
    until(lambda: peer.matched(graph, "rt/large"))
    values = {"data": "ab" * 500_000}
    publish(judged(STRING, values))
    assert until(lambda: peer.heard("rt/large"))[0]["values"] == values


def test_what_may_be_read_but_not_sent_is_written_anew(node, until):
    one, other, heard = node("one"), node("other"), []
    other.subscribe("/chat", STRING, Qos(), heard.append)
    publish = one.advertise("/chat", STRING, Qos())
    until(lambda: one._writers[0][1].matched_sub)
    publish(TYPES.encode(STRING, {"data": "big"}, big_endian=True))
    publish(bytes.fromhex("00010000 00000000"))  # an empty string without its NUL, as some writers have it
    until(lambda: len(heard) == 2)
    assert heard == [judged(STRING, {"data": "big"}), judged(STRING, {"data": ""})]


@pytest.mark.parametrize(
    "cdr",
    [b"", b"\0\1\0\0", b"\0\1\0\0\x09\0\0\0short", b"\0\3\0\0\1\0\0\0\0"],
    ids=["nothing", "no_body", "cut", "no_cdr"],
)
def test_what_is_no_message_is_refused(node, cdr):
    publish = node().advertise("/chat", STRING, Qos())
    with pytest.raises(WireError, match=STRING):
        publish(cdr)


@pytest.mark.parametrize("way", ["written", "taken"])
def test_the_public_way_of_cyclonedds_gives_the_same_bytes(node, until, way, monkeypatch):
    names = ["sensor_msgs/msg/JointState", "geometry_msgs/msg/PoseStamped", "std_msgs/msg/Empty", STRING]
    if way == "written":
        monkeypatch.setattr(endpoints, "writer_of", endpoints.plain_writer_of)
    else:
        monkeypatch.setattr(endpoints, "info_taker_of", endpoints.plain_taker_of)
    one, other = node("one"), node("other")
    for name in names:
        heard = []
        other.subscribe(topic_of(name), name, Qos(), heard.append)
        publish = one.advertise(topic_of(name), name, Qos())
        until(lambda: one._writers[-1][1].matched_sub)
        sent = [TYPES.encode(name, arbitrary(TYPES, name, Random(seed))) for seed in range(8)]
        for cdr in sent:
            publish(cdr)
        until(lambda heard=heard: len(heard) >= 8)
        assert heard == sent
    if way == "written":
        with pytest.raises(WireError):
            publish(b"\0\1\0\0\x09\0\0\0short")


def test_where_cyclonedds_is_not_as_known_the_public_way_is_taken(node, until, monkeypatch):
    graph = node()
    graph.subscribe("/in", STRING, Qos(), lambda _: None)
    graph.advertise("/out", STRING, Qos())
    until(lambda: graph._readers)
    monkeypatch.delattr("cyclonedds._clayer.ddspy_take")
    monkeypatch.delattr("cyclonedds.internal.DDS._dll_handle")
    assert endpoints.info_taker_of(graph._readers[0][1]).__qualname__.startswith("plain_taker_of")
    assert endpoints.writer_of(graph._writers[0][1]).__qualname__.startswith("plain_writer_of")


@pytest.mark.long
def test_every_type_of_the_distribution_travels(node, until):
    one, other = node("one"), node("other")
    sent, heard = {}, {}
    for number, name in enumerate(name for name in TYPES.types() if TYPES.has(name)):
        heard[name] = []
        other.subscribe(f"/all/t{number}", name, Qos(transient_local=True), heard[name].append)
        publish = one.advertise(f"/all/t{number}", name, Qos(transient_local=True))
        sent[name] = [TYPES.encode(name, values) for values in ({}, arbitrary(TYPES, name, Random(name)))]
        for cdr in sent[name]:
            publish(cdr)
    until(lambda: all(len(cdrs) == 2 for cdrs in heard.values()))
    assert heard == sent


def test_a_closed_node_is_gone(node, until):
    one, other, heard = node("one"), node("other"), []
    other.subscribe("/chat", STRING, Qos(), heard.append)
    publish = one.advertise("/chat", STRING, Qos())
    until(lambda: one._writers[0][1].matched_sub)
    other.close()
    other.close()
    until(lambda: not one._writers[0][1].matched_sub)
    publish(judged(STRING, {"data": "nobody hears it"}))
    one.close()
    publish(judged(STRING, {"data": "nobody says it"}))
    assert not heard
    assert one.notes() == []
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("dds ")]
    with pytest.raises(ConfigError, match="/chat: the node one has left the graph"):
        one.advertise("/chat", STRING, Qos())


def test_who_hears_may_close(node, until):
    one, other, heard = node("one"), node("other"), []

    def once(cdr):
        heard.append(cdr)
        other.close()

    other.subscribe("/chat", STRING, Qos(), once)
    publish = one.advertise("/chat", STRING, Qos())
    until(lambda: one._writers[0][1].matched_sub)
    for number in range(9):
        publish(judged(STRING, {"data": f"{number}"}))
    until(lambda: heard and not one._writers[0][1].matched_sub)
    assert heard == [judged(STRING, {"data": "0"})]


def test_domains_do_not_mix(node, until):
    here, there = node("here", domain=1), node("there", domain=2)
    heard = {"here": [], "there": []}
    node("other", domain=1).subscribe("/chat", STRING, Qos(), heard["here"].append)
    node("another", domain=2).subscribe("/chat", STRING, Qos(), heard["there"].append)
    for graph, text in (here, "here"), (there, "there"):
        publish = graph.advertise("/chat", STRING, Qos())
        until(lambda graph=graph: graph._writers[0][1].matched_sub)
        publish(judged(STRING, {"data": text}))
    until(lambda: all(heard.values()))
    assert heard == {name: [judged(STRING, {"data": name})] for name in heard}


@pytest.mark.parametrize(
    ("topic", "type_name", "said"),
    [
        ("/chat", "std_msgs/msg/Strin", "/chat: type 'std_msgs/msg/Strin' is not known to ROS 2 jazzy"),
        ("chat", STRING, "topic 'chat' is not a ROS name"),
        ("/taken", STRING, "/taken: is of type std_msgs::msg::dds_::Bool_ here"),
    ],
    ids=["type", "name", "taken"],
)
def test_what_cannot_be_is_said(node, topic, type_name, said):
    graph = node()
    graph.advertise("/taken", "std_msgs/msg/Bool", Qos())
    with pytest.raises(ConfigError, match=f"^{said}"):
        graph.advertise(topic, type_name, Qos())
    with pytest.raises(ConfigError, match=f"^{said}"):
        graph.subscribe(topic, type_name, Qos(), print)


def test_an_interface_that_is_not_there_is_said_and_leaves_nothing_behind(node, capfd):
    with pytest.raises(
        ConfigError, match=r"^dds: Cyclone DDS opens no domain 0: none0: [^\n]*; look at: options$"
    ):
        node(options={"interface": "none0"})
    assert capfd.readouterr().err == ""
    node()


def test_a_domain_has_one_configuration_a_process(node):
    first = node()
    with pytest.raises(ConfigError, match="dds: domain 0 is open in this process with other options"):
        node(options={})
    first.close()
    node(options={"interface": "lo"})


def test_the_user_s_configuration_is_obeyed(node, monkeypatch):
    monkeypatch.setenv("CYCLONEDDS_URI", "<CycloneDDS><Domain><Nonsense/></Domain></CycloneDDS>")
    with pytest.raises(
        ConfigError, match=r"Nonsense: unknown element.*; look at: \$CYCLONEDDS_URI, options$"
    ):
        node()
    monkeypatch.setenv("CYCLONEDDS_URI", URI)
    node(options={})


def test_a_domain_that_somebody_else_opened_will_do_without_options(node):
    participant = DomainParticipant(9)
    with pytest.raises(ConfigError, match="dds: domain 9 is open in this process without options"):
        node(domain=9)
    node(domain=9, options={})
    del participant
