from __future__ import annotations

import numpy as np
import pytest
from msgspec.structs import replace
from rosbags.typesys import Stores, get_typestore

from edoras_tools.io.topics.messages import TF_TYPE, Transforms, lay_out

CHANNEL = 7


def told(read, types):
    """Every transform of a capture, read by rosbags: (row's time, message)."""
    made, store, found = Transforms(read.mission, types), get_typestore(Stores.ROS2_JAZZY), []
    for batch, columns in read.pairs:
        records = lay_out([*made.messages(batch, columns, CHANNEL)], len(batch))
        assert {*records.channel_id.tolist()} <= {CHANNEL}
        for start, end, time_ns in zip(records.start, records.end, records.log_time, strict=True):
            cdr = bytes(records.data[start:end])
            (transform,) = store.deserialize_cdr(cdr, TF_TYPE).transforms
            assert types.encode(TF_TYPE, types.decode(TF_TYPE, cdr)) == cdr
            found.append((int(time_ns), transform))
    return found


def poses(read, types, topic):
    """Every pose of a topic, read one by one: (row's time, values)."""
    place = next(index for index, route in enumerate(read.mission.routes) if route.topic == topic)
    for batch, columns in read.pairs:
        for row in np.flatnonzero((columns.route == place) & (columns.cdr_length > 0)):
            start = columns.cdr_offset[row]
            cdr = bytes(batch.data[start : start + columns.cdr_length[row]])
            yield int(batch.time_ns[row]), types.decode("geometry_msgs/msg/PoseStamped", cdr)


def test_every_pose_is_a_transform_with_its_values(capture, types):
    rover = capture("a_rover", "rover_ground")
    found, expected = told(rover, types), list(poses(rover, types, "/telemetry_pose"))
    assert len(found) == len(expected) > 50
    for (time_ns, transform), (wanted_ns, pose) in zip(found, expected, strict=True):
        header, place, turned = pose["header"], pose["pose"]["position"], pose["pose"]["orientation"]
        assert time_ns == wanted_ns
        assert (transform.header.frame_id, transform.child_frame_id) == ("world", "telemetry_pose")
        stamp = transform.header.stamp
        assert (stamp.sec, stamp.nanosec) == (header["stamp"]["sec"], header["stamp"]["nanosec"])
        moved, rotated = transform.transform.translation, transform.transform.rotation
        assert (moved.x, moved.y, moved.z) == tuple(place[axis] for axis in "xyz")
        assert tuple(getattr(rotated, axis) for axis in "xyzw") == tuple(turned[axis] for axis in "xyzw")


def test_each_topic_has_a_frame_of_its_own(capture, types):
    rovers = capture("f_sbn_disconnect", "two_rovers_ground", "two_rovers_flight")
    frames = {transform.child_frame_id for _, transform in told(rovers, types)}
    assert frames == {"robot_1/ground/pose", "robot_1/pose"}


@pytest.mark.parametrize("frame", ["", "a", "abc", "abcd", "world_of_the_robot", "ä"])
def test_names_of_any_length_are_padded_right(capture, types, frame):
    rover = capture("a_rover", "rover_ground")
    batch, columns = rover.pairs[0]
    place = next(
        index for index, route in enumerate(rover.mission.routes) if route.topic == "/telemetry_pose"
    )
    row = int(np.flatnonzero(columns.route == place)[0])
    values = {"header": {"frame_id": frame}, "pose": {"position": {"x": 3.0}}}
    cdr = types.encode("geometry_msgs/msg/PoseStamped", values)
    batch, columns = batch.take(slice(row, row + 1)), columns.take(slice(row, row + 1))
    data = np.concatenate([batch.data, np.frombuffer(cdr, np.uint8)])
    columns.cdr_offset[:], columns.cdr_length[:] = len(batch.data), len(cdr)
    batch = replace(batch, data=data)
    messages = list(Transforms(rover.mission, types).messages(batch, columns, CHANNEL))
    assert len(messages) == bool(frame)
    if frame:
        records = lay_out(messages, 1)
        read = types.decode(TF_TYPE, bytes(records.data[records.start[0] : records.end[0]]))
        (transform,) = read["transforms"]
        assert (transform["header"]["frame_id"], transform["transform"]["translation"]["x"]) == (frame, 3.0)
