"""Many messages at once must say what one at a time says."""

from __future__ import annotations

import numpy as np
import pytest
from effort import examples
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from edoras_tools.errors import WireError
from edoras_tools.ros import Ragged
from edoras_tools.ros.cdr import bulk

TYPES = [
    "geometry_msgs/msg/Twist",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseArray",
    "sensor_msgs/msg/JointState",
    "sensor_msgs/msg/PointCloud2",
    "sensor_msgs/msg/MultiDOFJointState",
    "sensor_msgs/msg/JoyFeedbackArray",
    "nav_msgs/msg/Odometry",
    "diagnostic_msgs/msg/DiagnosticArray",
    "rcl_interfaces/msg/ParameterEvent",
    "rmw_dds_common/msg/ParticipantEntitiesInfo",
    "tf2_msgs/msg/TFMessage",
    "std_msgs/msg/Empty",
    "std_msgs/msg/Bool",
    "std_msgs/msg/String",
    "odd_msgs/msg/Gaps",
    "odd_msgs/msg/Bounds",
    "odd_msgs/msg/Wide",
    "odd_msgs/msg/Empties",
    "odd_msgs/msg/Deep",
]
FEW = settings(max_examples=examples(20, least=4), deadline=None, suppress_health_check=list(HealthCheck))


@pytest.fixture(autouse=True, params=[0, 2], ids=["together", "few alone"])
def _few(request, monkeypatch):
    """Small batches are read one by one; here they are to go both ways."""
    monkeypatch.setattr(bulk, "FEW", request.param)


def laid_out(messages, gaps=()):
    """Messages in one buffer, in order, with some bytes between them."""
    data, offset = bytearray(), []
    for index, message in enumerate(messages):
        data += b"\xa5" * (gaps[index] if index < len(gaps) else 0)
        offset.append(len(data))
        data += message
    return (
        np.frombuffer(bytes(data), np.uint8),
        np.array(offset, np.int64),
        np.array([len(message) for message in messages], np.int32),
    )


def accepted(store, name, cdr):
    try:
        store.decode(name, cdr)
    except WireError:
        return False
    return True


def flattened(value, path=""):
    """Values by dotted name, all those below a sequence in one list, as MessageColumns has them."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from flattened(item, f"{path}.{key}" if path else key)
    elif isinstance(value, (list, bytes)):
        for item in value:
            yield from flattened(item, path)
    else:
        yield path, value


def same(left, right):
    """Equal to the bit; a float32 column against the double that it reads as."""
    if isinstance(right, float):
        return np.float64(left).tobytes() == np.float64(right).tobytes()
    return bool(left == right)


def check(store, name, cdrs, data, offset, length):
    verdict = store.valid(name, data, offset, length)
    assert verdict.tolist() == [accepted(store, name, cdr) for cdr in cdrs]
    columns = store.columns(name, data, offset, length)
    assert columns.valid.tolist() == verdict.tolist()
    assert len(columns) == len(cdrs)
    for row, cdr in enumerate(cdrs):
        expected = {}
        if verdict[row]:
            for path, value in flattened(store.decode(name, cdr)):
                expected.setdefault(path, []).append(value)
        for field, column in columns.fields.items():
            if field.endswith("at_least_one_member"):
                continue
            found = column[row]
            values = found.reshape(-1).tolist() if isinstance(found, np.ndarray) else [found]
            blank = [] if isinstance(column, Ragged) else [type(values[0])()] * len(values)
            wanted = expected.pop(field, blank if not verdict[row] or isinstance(column, Ragged) else None)
            assert len(values) == len(wanted), field
            assert all(same(left, right) for left, right in zip(values, wanted, strict=True)), field
        assert not expected


def damaged(draw, cdr):
    """A message, perhaps cut, extended, or with a few bits or a length changed."""
    cdr = bytearray(cdr)
    kind = draw(st.sampled_from(["whole", "whole", "cut", "longer", "bit", "length"]))
    if kind == "cut":
        del cdr[draw(st.integers(0, len(cdr))) :]
    elif kind == "longer":
        cdr += draw(st.binary(min_size=1, max_size=9))
    elif kind == "bit":
        for _ in range(draw(st.integers(1, 4))):
            cdr[draw(st.integers(0, len(cdr) - 1))] ^= 1 << draw(st.integers(0, 7))
    elif kind == "length" and len(cdr) >= 8:
        place = draw(st.integers(1, len(cdr) // 4 - 1)) * 4
        cdr[place : place + 4] = draw(
            st.sampled_from([0, 1, 2, 5, 255, 65536, 2**31 - 1, 2**31, 2**32 - 1])
        ).to_bytes(4, draw(st.sampled_from(["little", "big"])))
    return bytes(cdr)


@pytest.mark.each(3)
@pytest.mark.quick("together-*")
@pytest.mark.parametrize("name", TYPES)
@FEW
@given(data=st.data())
def test_mixed_batches(store, tools, name, data):
    values = data.draw(st.lists(tools.messages(store, name), min_size=1, max_size=4))
    order = data.draw(st.lists(st.tuples(st.sampled_from(values), st.booleans()), max_size=6))
    cdrs = [damaged(data.draw, store.encode(name, item, big_endian=big)) for item, big in order]
    check(store, name, cdrs, *laid_out(cdrs, data.draw(st.lists(st.integers(0, 5), max_size=6))))


@pytest.mark.each(3)
@pytest.mark.quick("together-*")
@pytest.mark.parametrize("name", TYPES)
@FEW
@given(garbage=st.lists(st.binary(max_size=60), max_size=6), plain=st.booleans())
def test_garbage(store, name, garbage, plain):
    cdrs = [b"\0\1\0\0" + item for item in garbage] if plain else garbage
    check(store, name, cdrs, *laid_out(cdrs))


@pytest.mark.each(3)
@pytest.mark.quick("together-*")
@pytest.mark.parametrize("name", TYPES)
@FEW
@given(
    places=st.lists(
        st.tuples(st.integers(-(2**40), 2**40) | st.integers(-4, 90), st.integers(-(2**31), 2**31 - 1))
    )
)
def test_places_outside_the_buffer(store, name, places):
    data = np.frombuffer(store.encode(name, {}) * 2, np.uint8)
    offset = np.array([offset for offset, _ in places], np.int64)
    length = np.array([length for _, length in places], np.int32)
    inside = [
        data[start : start + size].tobytes()
        if start >= 0 and size >= 0 and start + size <= len(data)
        else b""
        for start, size in places
    ]
    check(store, name, inside, data, offset, length)


@pytest.mark.parametrize(
    "name", ["geometry_msgs/msg/PoseStamped", "sensor_msgs/msg/JointState", "tf2_msgs/msg/TFMessage"]
)
def test_more_than_one_chunk(store, name, monkeypatch):
    monkeypatch.setattr(bulk, "_CHUNK_ROWS", 32)
    stamped = {"header": {"frame_id": "map"}}
    shapes = {
        "geometry_msgs/msg/PoseStamped": [stamped, {"header": {"frame_id": "odom_of_the_robot"}}],
        "sensor_msgs/msg/JointState": [
            stamped | {"name": ["a", "bcd"], "position": [1.0, 2.0]},
            stamped | {"name": ["x", "yzw"], "position": [3.0, 4.0]},
            {"name": [f"long_joint_name_{index}" for index in range(9)], "effort": [0.5] * 9},
        ],
        "tf2_msgs/msg/TFMessage": [{"transforms": [stamped] * count} for count in range(4)],
    }[name]
    good = [store.encode(name, shape) for shape in shapes]
    bad = [good[-1][:-9], good[-1].replace(b"\0", b"\1"), good[0] + bytes(4), b"\0\2\0\0" + good[0][4:]]
    for cdrs in (
        good[:1] * 200,
        [*bad[:1], *good[:1] * 199],
        (good[:1] * 7 + bad) * 20,
        (good + bad) * 25,
        bad[1:2] * 100,
        [good[0]] * 64 + [good[-1]] * 64,
    ):
        data, offset, length = laid_out(cdrs)
        wanted = [accepted(store, name, cdr) for cdr in cdrs]
        assert store.valid(name, data, offset, length).tolist() == wanted
        backwards = store.valid(name, data, offset[::-1], length[::-1])
        assert backwards.tolist() == wanted[::-1]


def test_a_shared_shape_is_no_pass_for_other_bytes(store):
    name = "std_msgs/msg/String"
    good = store.encode(name, {"data": "hello"})
    unended = good[:-1] + b"x"
    shorter = good.replace(b"\6\0\0\0", b"\5\0\0\0")
    cdrs = [good] * 50 + [unended, shorter, good.replace(b"hello", b"jelly")]
    assert store.valid(name, *laid_out(cdrs)).tolist() == [True] * 50 + [False, False, True]


def test_columns_are_made_for_use(store):
    cdrs = [
        store.encode("geometry_msgs/msg/PoseStamped", {"pose": {"position": {"x": x}}}) for x in (1.0, 2.5)
    ]
    columns = store.columns("geometry_msgs/msg/PoseStamped", *laid_out([*cdrs, b""]))
    assert list(columns.fields)[:4] == [
        "header.stamp.sec",
        "header.stamp.nanosec",
        "header.frame_id",
        "pose.position.x",
    ]
    x = columns.fields["pose.position.x"]
    assert x.dtype == np.float64
    assert x.tolist() == [1.0, 2.5, 0.0]
    assert columns.fields["pose.position.x"] is x
    assert columns.fields["header.frame_id"].dtype == object
    with pytest.raises(KeyError):
        columns.fields["nothing"]


def test_ragged_rows(store):
    name = "sensor_msgs/msg/JointState"
    cdrs = [store.encode(name, {"name": ["a"] * count, "position": [0.5] * count}) for count in (2, 0, 3)]
    column = store.columns(name, *laid_out(cdrs)).fields["position"]
    assert column.offsets.tolist() == [0, 2, 2, 5]
    assert [len(column[row]) for row in range(len(column))] == [2, 0, 3]
    assert column[-1].tolist() == [0.5] * 3
    with pytest.raises(IndexError):
        column[3]


def test_fixed_arrays_keep_their_shape(store):
    columns = store.columns(
        "nav_msgs/msg/Odometry", *laid_out([store.encode("nav_msgs/msg/Odometry", {})] * 3)
    )
    assert columns.fields["pose.covariance"].shape == (3, 36)


def test_an_empty_batch(store):
    columns = store.columns("sensor_msgs/msg/JointState", *laid_out([]))
    assert len(columns) == 0
    assert len(columns.fields["position"]) == 0
    assert columns.fields["header.stamp.sec"].tolist() == []


def test_a_batch_that_may_not_be_written_to(store):
    data, offset, length = laid_out([store.encode("std_msgs/msg/Int32", {"data": 7}, big_endian=True)])
    assert not data.flags.writeable
    assert store.columns("std_msgs/msg/Int32", data, offset, length).fields["data"].tolist() == [7]
    assert data.tobytes() == b"\0\0\0\0\0\0\0\7"


def test_a_string_without_length_at_the_very_end(store):
    cdr = b"\0\1\0\0" + bytes(4)
    data, offset, length = laid_out([cdr, cdr])
    assert store.valid("std_msgs/msg/String", data, offset, length).tolist() == [True, True]
    assert store.columns("std_msgs/msg/String", data, offset, length).fields["data"].tolist() == ["", ""]
    assert store.decode("std_msgs/msg/String", cdr) == {"data": ""}


def test_messages_with_more_deciding_bytes_than_are_noted(store):
    good = store.encode("sensor_msgs/msg/JointState", {"name": ["joint"] * (bulk.MOST_SEEN + 1)})
    bad = good[:-15] + b"\1" + good[-14:]  # the NUL of the last name
    cdrs = [good] * 20 + [bad, good[:-4]] + [good] * 3
    verdict = store.valid("sensor_msgs/msg/JointState", *laid_out(cdrs))
    assert verdict.tolist() == [accepted(store, "sensor_msgs/msg/JointState", cdr) for cdr in cdrs]
    assert verdict.sum() == 23
