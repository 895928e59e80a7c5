"""Recorded samples reach a reader of Cyclone DDS that is not ours, with the quality of service they had."""

import json
import os
import subprocess
import sys
import threading
from types import SimpleNamespace

import pytest
from cyclonedds.core import DDSException
from cyclonedds.pub import DataWriter
from dds_loopback import URI
from mcap.reader import make_reader
from places import ROOT, SUPPORT
from waiting import Program, until

from edoras_tools.addons.dds.graph import DdsGraph
from edoras_tools.addons.rtps.wire import read_announcement
from edoras_tools.pipelines.capture.record import Target, record
from edoras_tools.pipelines.workbench import Settings, open_files

CAPTURE = ROOT / "samples/rtps/cyclone_sender.pcap.gz"
TOPICS = {"/cmd_vel": "Twist", "/chatter": "String", "/joint_states": "JointState"}


class Readers:
    """Another program with a reader a topic."""

    def __init__(self, domain=0, **qos):
        self.process = subprocess.Popen(
            [sys.executable, SUPPORT / "dds_peer.py", str(domain)],
            env=os.environ | {"CYCLONEDDS_URI": URI},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.lines = []
        self.thread = threading.Thread(target=self._read)
        self.thread.start()
        for topic, type_name in TOPICS.items():
            line = {"hear": f"rt{topic}", "type": type_name, **qos.get(topic[1:], {"depth": 0})}
            self.process.stdin.write(json.dumps(line) + "\n")
        self.process.stdin.flush()

    def _read(self):
        self.lines.extend(map(json.loads, self.process.stdout))

    def heard(self, topic):
        return [bytes.fromhex(line["cdr"]) for line in self.lines if line.get("heard") == f"rt{topic}"]

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.stdin.close()
        self.process.wait(30)
        self.thread.join()
        self.process.stdout.close()


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """The messages of the capture by topic, as its recording has them."""
    target = tmp_path_factory.mktemp("rtps") / "run.mcap"
    source = open_files([CAPTURE])
    record(source, Settings().workbench(source.info), Target(target))
    by_topic = {topic: [] for topic in TOPICS}
    with target.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages(topics=[*TOPICS]):
            by_topic[channel.topic].append(message.data)
    return by_topic


@pytest.mark.own_network
def test_a_reader_of_another_program_hears_every_sample(call, recorded):
    with Readers(chatter={"depth": 0, "reliable": False}) as readers:
        done = call("replay", CAPTURE, "--to", "rtps", "--speed", "max", "--json")
        assert done.code == 0, done.err
        until(lambda: all(len(readers.heard(topic)) >= len(recorded[topic]) for topic in TOPICS))
        for topic in TOPICS:
            assert [item[4:] for item in readers.heard(topic)] == [item[4:] for item in recorded[topic]]
    counts = {topic: len(messages) for topic, messages in recorded.items()}
    assert counts == {"/cmd_vel": 100, "/chatter": 100, "/joint_states": 4}
    assert done.json()["sent"] == 204
    assert done.json()["notes"] == ["left out: 52 of no link (--to udp:HOST:PORT)"]


@pytest.mark.long
@pytest.mark.own_network
@pytest.mark.parametrize("name", ["jazzy", "kilted"])
def test_a_reader_of_ros_hears_every_sample(call, recorded, name):
    """rclpy with its default, Fast DDS."""
    python = ROOT / ".ros" / name / "bin/python"
    if not python.exists():
        pytest.skip(f"ROS 2 {name} is not installed: make ros")
    words = [python, SUPPORT / "ros_reader.py"]
    for topic, type_name in TOPICS.items():
        package = {"Twist": "geometry_msgs", "String": "std_msgs"}.get(type_name, "sensor_msgs")
        quality = "best_effort" if topic == "/chatter" else "reliable"
        words += [f"{package}/msg/{type_name}", topic, quality]
    environment = os.environ | {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": "0"}
    heard = {topic: [] for topic in TOPICS}
    with Program(*words, env=environment, stdin=subprocess.PIPE) as reader:
        assert json.loads(reader.line()) == {}
        done = call("replay", CAPTURE, "--to", "rtps", "--timeout", "60s", "--json")
        assert done.code == 0, done.err
        for _ in range(sum(map(len, recorded.values()))):
            line = json.loads(reader.line())
            heard[line["heard"]].append(bytes.fromhex(line["cdr"]))
    for topic, messages in recorded.items():
        assert [item[4 : len(own)] for item, own in zip(heard[topic], messages, strict=True)] == [
            item[4:] for item in messages
        ]


def test_what_is_not_acknowledged_yet_is_no_error(monkeypatch):
    """As cyclonedds 11.0.1 answers while a reader has not acknowledged."""
    graph = SimpleNamespace(_writers=[("/chatter", DataWriter.__new__(DataWriter))])
    monkeypatch.setattr(DataWriter, "_wait_for_acks", lambda *_: DDSException.DDS_RETCODE_TIMEOUT)
    monkeypatch.setattr(DataWriter, "_ref", 0, raising=False)
    assert DdsGraph.acknowledged(graph) is False
    monkeypatch.setattr(DataWriter, "_wait_for_acks", lambda *_: 0)
    assert DdsGraph.acknowledged(graph) is True


@pytest.mark.own_network
def test_a_writer_offers_what_was_recorded_and_a_reader_that_asks_for_more_is_named(call):
    """/chatter was written best effort: a reliable reader does not match it."""
    with Readers():
        alone = call("replay", CAPTURE, "--to", "rtps", "--topic", "/chatter", "--timeout", "3s")
    assert alone.code == 1
    assert "no subscriber of /chatter in domain 0; /chatter: a subscriber does not match" in alone.err[-1]


def test_the_port_says_the_domain(call):
    done = call("replay", CAPTURE, "--to", "rtps", "--target", "127.0.0.1:7401")
    assert done.code == 2
    assert "--target 127.0.0.1:7401: its port says the domain: 7400 + 250 x ROS_DOMAIN_ID" in done.err[-1]


def test_what_nobody_can_publish_is_refused_with_the_reason(call):
    """Fast DDS's own node announces itself with samples of a topic that is none of ROS's."""
    capture = ROOT / "samples/rtps/fastdds_sender.pcap.gz"
    notes = call("replay", capture, "--to", "rtps", "--dry-run", "--json").json()["notes"]
    assert any("of ros_discovery_info, which is no topic of ROS" in note for note in notes), notes


@pytest.mark.parametrize("order", ["little", "big"])
def test_the_quality_of_service_of_a_writer_is_read(order):
    """Parameters as table 9.18 has them, with the values of 9.3.2."""

    def parameter(number, *words):
        value = b"".join(item.to_bytes(4, order) for item in words)
        return number.to_bytes(2, order) + len(value).to_bytes(2, order) + value

    guid = bytes(range(1, 15)) + b"\0\3"
    head = (b"\0\3" if order == "little" else b"\0\2") + b"\0\0"
    owner = parameter(0x5A)[:2] + (16).to_bytes(2, order) + guid
    end = parameter(1)

    def read(*parameters):
        item = read_announcement(head + owner + b"".join(parameters) + end)
        return item.reliable, item.transient_local, item.depth

    assert read() == (True, False, 0)
    kept, all_kept = parameter(0x40, 0, 7), parameter(0x40, 1, 7)
    assert read(parameter(0x1A, 1, 0, 0), parameter(0x1D, 1), kept) == (False, True, 7)
    assert read(parameter(0x1A, 2, 0, 0), parameter(0x1D, 0), all_kept) == (True, False, 0)
