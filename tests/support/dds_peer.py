"""Another program on DDS: cyclonedds alone, its classes written by hand. JSON in and out, a line each.

In: {"hear": TOPIC, "type": NAME, QOS...}, {"speak": ...}, {"say": TOPIC, "values": {...}}.
Out: {"heard": TOPIC, "values": ..., "cdr": HEX}, {"matched": TOPIC}, {"user_data": TEXT}.
"""

import json
import sys
import threading
import time
from dataclasses import asdict, dataclass

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsParticipant
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import array, bounded_str, float64, int32, sequence, uint8, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration


@dataclass
class Time(IdlStruct, typename="builtin_interfaces.msg.dds_.Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs.msg.dds_.Header_"):
    stamp: Time
    frame_id: str


@dataclass
class String(IdlStruct, typename="std_msgs.msg.dds_.String_"):
    data: str


@dataclass
class Vector3(IdlStruct, typename="geometry_msgs.msg.dds_.Vector3_"):
    x: float64
    y: float64
    z: float64


@dataclass
class Twist(IdlStruct, typename="geometry_msgs.msg.dds_.Twist_"):
    linear: Vector3
    angular: Vector3


@dataclass
class Point(IdlStruct, typename="geometry_msgs.msg.dds_.Point_"):
    x: float64
    y: float64
    z: float64


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs.msg.dds_.Quaternion_"):
    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
class Pose(IdlStruct, typename="geometry_msgs.msg.dds_.Pose_"):
    position: Point
    orientation: Quaternion


@dataclass
class PoseStamped(IdlStruct, typename="geometry_msgs.msg.dds_.PoseStamped_"):
    header: Header
    pose: Pose


@dataclass
class JointState(IdlStruct, typename="sensor_msgs.msg.dds_.JointState_"):
    header: Header
    name: sequence[str]
    position: sequence[float64]
    velocity: sequence[float64]
    effort: sequence[float64]


@dataclass
class Empty(IdlStruct, typename="std_msgs.msg.dds_.Empty_"):
    structure_needs_at_least_one_member: uint8


@dataclass
class Gid(IdlStruct, typename="rmw_dds_common.msg.dds_.Gid_"):
    data: array[uint8, 24]


@dataclass
class NodeEntitiesInfo(IdlStruct, typename="rmw_dds_common.msg.dds_.NodeEntitiesInfo_"):
    node_namespace: bounded_str[256]
    node_name: bounded_str[256]
    reader_gid_seq: sequence[Gid]
    writer_gid_seq: sequence[Gid]


@dataclass
class ParticipantEntitiesInfo(IdlStruct, typename="rmw_dds_common.msg.dds_.ParticipantEntitiesInfo_"):
    gid: Gid
    node_entities_info_seq: sequence[NodeEntitiesInfo]


TYPES = {
    made.__name__: made
    for made in (String, Vector3, Twist, PoseStamped, JointState, Empty, ParticipantEntitiesInfo)
}


def build(made, values):
    """Make a sample from nested dicts."""
    parts = {
        name: build(kind, values[name])
        if isinstance(kind, type) and issubclass(kind, IdlStruct)
        else values[name]
        for name, kind in made.__annotations__.items()
    }
    return made(**parts)


def qos(line):
    depth = line.get("depth", 10)
    return Qos(
        Policy.Reliability.Reliable(duration(seconds=10))
        if line.get("reliable", True)
        else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if line.get("transient_local") else Policy.Durability.Volatile,
        Policy.History.KeepLast(depth) if depth else Policy.History.KeepAll,
        Policy.DurabilityService(0, Policy.History.KeepLast(depth or 1), -1, -1, -1),
    )


def plain(value):
    return list(value) if isinstance(value, bytes | bytearray) else value


def tell(**line):
    print(json.dumps(line, default=plain), flush=True)


def main():
    participant = DomainParticipant(int(sys.argv[1]) if len(sys.argv) > 1 else 0)
    people = BuiltinDataReader(participant, BuiltinTopicDcpsParticipant)
    readers, writers, matched, seen = {}, {}, set(), []
    lines, ended = [], threading.Event()

    def read():
        lines.extend(json.loads(line) for line in sys.stdin)
        ended.set()

    threading.Thread(target=read, daemon=True).start()
    while not ended.is_set() or lines:
        while lines:
            line = lines.pop(0)
            if "hear" in line:
                topic = Topic(participant, line["hear"], TYPES[line["type"]])
                readers[line["hear"]] = DataReader(participant, topic, qos(line))
            elif "speak" in line:
                topic = Topic(participant, line["speak"], TYPES[line["type"]])
                writers[line["speak"]] = DataWriter(participant, topic, qos(line))
            elif "say" in line:
                writer = writers[line["say"]]
                sample = build(writer.topic.data_type, line["values"])
                for _ in range(line.get("times", 1)):
                    writer.write(sample)
        for topic, reader in readers.items():
            if topic not in matched and reader.matched_pub:
                matched.add(topic)
                tell(matched=topic)
            for sample in reader.take(1000):
                if isinstance(sample, IdlStruct):
                    tell(heard=topic, values=asdict(sample), cdr=sample.serialize().hex())
        for topic, writer in writers.items():
            if topic not in matched and writer.matched_sub:
                matched.add(topic)
                tell(matched=topic)
        for person in people.take(100):
            if person.sample_info.valid_data and Policy.Userdata in person.qos:
                data = person.qos[Policy.Userdata].data.decode()
                if data and data not in seen:
                    seen.append(data)
                    tell(user_data=data)
        time.sleep(0.001)


if __name__ == "__main__":
    main()
