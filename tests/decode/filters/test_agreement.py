"""Filters on columns and filters on single packets are held to one answer: field by field, and whole."""

from contextlib import closing
from functools import cache
from itertools import cycle, product
from operator import itemgetter

import numpy as np
import pytest
from effort import LONG, examples, long_but
from hypothesis import HealthCheck, example, given, reject, settings
from hypothesis import strategies as st
from places import ROOT

from edoras_tools.decode import ColumnDecoder, Context, Dissector, Options
from edoras_tools.decode.filters.filter import Where
from edoras_tools.decode.filters.names import Names, Unknown
from edoras_tools.decode.filters.rows import ColumnRows, PacketRows
from edoras_tools.decode.filters.syntax import WhereError
from edoras_tools.io.formats.open import open_file
from edoras_tools.mission import Mission, load, loads
from edoras_tools.model import Finding, PacketBatch, Peer
from edoras_tools.ros import TypeStore
from edoras_tools.wire import cfe, sbn

CAPTURES = sorted((ROOT / "tests/captures").glob("*.pcap.zst"))
TYPES = TypeStore()
DEFAULT = Options()
LISTS = {
    0x182B: "sensor_msgs/msg/JointState",
    0x182C: "geometry_msgs/msg/PoseArray",
    0x182D: "trajectory_msgs/msg/JointTrajectory",
    0x182E: "geometry_msgs/msg/PoseWithCovariance",
    0x182F: "std_msgs/msg/UInt64",
    0x1830: "std_msgs/msg/Float32MultiArray",
    0x1831: "std_msgs/msg/Bool",
    0x1832: "std_msgs/msg/Empty",
}
"""Types with lists of every make, each a command of a flight bridge."""
MISSION_OF_LISTS = "\n".join(
    [
        "bridge:",
        "  ros__parameters:",
        "    communication: {peer_ip: 127.0.0.1, peer_port: 2234, peer_processor_id: 1,",
        "      peer_spacecraft_id: 66, udp_receive_port: 2236, udp_receive_ip: 0.0.0.0, processor_id: 3,",
        "      spacecraft_id: 66}",
        f"    command: [{', '.join(f'c{key}' for key in LISTS)}]",
        "    telemetry: [event]",
        "    event: {type: std_msgs/msg/UInt64, topic: /event, mid: 0x808}",
        *(f"    c{key}: {{type: {name}, topic: /c{key}, mid: {key}}}" for key, name in LISTS.items()),
    ]
)
MISSIONS = {
    "none": Mission(),
    "rover": load([ROOT / "samples/missions/rover_ground.yaml"]),
    "arm": load([ROOT / "samples/missions/single_arm_ground.yaml"]),
    "two rovers": load([ROOT / f"samples/missions/two_rovers_{side}.yaml" for side in ("ground", "flight")]),
    "two arms": load([ROOT / f"samples/missions/two_arms_{side}.yaml" for side in ("ground", "flight")]),
    "lists": loads({"lists.yaml": MISSION_OF_LISTS.encode()}),
}


def values(series):
    """Return a list of values per row, None where the row has not the field."""
    out = [None] * series.rows
    owner = range(series.rows) if series.owner is None else series.owner.tolist()
    for row in owner if series.holders is None else series.holders.tolist():
        out[row] = []
    for row, value in zip(owner, series.values.tolist(), strict=True):
        out[row].append(value if series.table is None else series.table[value])
    return out


def indexed(name):
    """Return the names that a name of nested lists can be written as with an index."""
    parts = name.split(".")
    for at in range(len(parts)):
        for index in ("[0]", "[1]", "[-1]", "[7]"):
            yield ".".join([*parts[:at], parts[at] + index, *parts[at + 1 :]])


@cache
def some_fields(mission, options, turn):
    """Return each ``TURNS``-th field of a mission, also with indices, also its length, once."""
    names = Names(Context(MISSIONS[mission], TYPES, options))
    return list(fields_of(names, list(all_names(names))[turn::TURNS]))


def all_names(names):
    """Return every name of a field and of what holds it, also with an index, each once."""
    return dict.fromkeys(
        name
        for plain in names.all()
        for name in (
            plain,
            *indexed(plain),
            *(plain.rsplit(".", at)[0] for at in range(1, plain.count(".") + 1)),
        )
    )


def fields_of(names, texts):
    for name in texts:
        try:
            found = names.find(name)
        except Unknown:
            continue
        for field in found:
            yield field
            if field.many:
                yield field.length()


def agree(batch, mission, options=DEFAULT, turn=0):
    context = Context(MISSIONS[mission], TYPES, options)
    columns = ColumnDecoder(context).decode(batch)
    packets = [Dissector(context, detail=False).dissect(batch[index]) for index in range(len(batch))]
    bulk = ColumnRows(context, 7, batch, columns)
    one_by_one = PacketRows(context, 7, packets)
    half = np.arange(0, len(batch), 2)
    part = bulk.take(half)
    fields = some_fields(mission, options, turn % TURNS)
    for field in fields:
        expected = values(field.series(one_by_one))
        found = values(field.series(bulk))
        if field.kind.name == "STRUCT":
            expected, found = ([item and len(item) for item in side] for side in (expected, found))
        assert repr(found) == repr(expected), field.name
        taken = values(field.series(part))
        if field.kind.name != "STRUCT":
            assert repr(taken) == repr([found[row] for row in half]), field.name
    return len(fields)


NAMES = ["rover", "arm", "two rovers"]
IN_TURNS = list(zip(CAPTURES, cycle(NAMES)))
TURNS = 1 if LONG else 16
"""``make test`` holds an eighth of the names to each capture, the next to the next; ``make long`` all."""


@pytest.mark.each(3)
@pytest.mark.parametrize(
    ("path", "name"),
    long_but(IN_TURNS[: len(NAMES)], list(product(CAPTURES, NAMES))),
    ids=lambda item: item if isinstance(item, str) else item.name.partition(".")[0],
)
def test_every_field_of_the_captures(path, name):
    with closing(open_file(path)) as source:
        batch = next(source.batches())
    rows = np.random.default_rng(1).choice(len(batch), min(len(batch), examples(250, 8)), replace=False)
    turn = CAPTURES.index(path) // len(NAMES)  # the captures before it had the other names
    assert agree(batch.take(np.sort(rows)), name, turn=turn) > 100 // TURNS


def batch_of(rows):
    """Make a batch of (payload, source port, destination port, findings)."""
    payloads = [row[0] for row in rows]
    lengths = np.array([len(payload) for payload in payloads], np.int32)
    offsets = np.array([0, *np.cumsum(lengths)], np.int64)[: len(rows)]
    return PacketBatch(
        data=np.frombuffer(b"".join(payloads) or b"\0", np.uint8),
        number=np.arange(1, len(rows) + 1),
        time_ns=np.arange(len(rows)) * 1000,
        link_type=np.full(len(rows), 101, np.uint16),
        frame_offset=offsets,
        frame_length=lengths,
        original_length=lengths,
        offset=offsets,
        length=lengths,
        source_address=np.full(len(rows), 0x7F000001, np.uint32),
        source_port=np.array([row[1] for row in rows], np.uint16),
        destination_address=np.arange(len(rows), dtype=np.uint32) % 3,
        destination_port=np.array([row[2] for row in rows], np.uint16),
        ip_version=np.full(len(rows), 4, np.uint8),
        capture_findings=np.array([row[3] for row in rows], np.uint32),
    )


def pool():
    """Return one payload of every kind that the sample captures hold, and a few that they do not."""
    found = {}
    for path in sorted((ROOT / "samples/captures").glob("*.pcap")):
        with closing(open_file(path)) as source:
            for batch in source.batches():
                for index in range(0, len(batch), 3):
                    payload = batch[index].payload
                    found.setdefault((len(payload), payload[:3]), payload)
    legacy = [bytes.fromhex("0000a000000003"), bytes.fromhex("00010400000003") + b"\x0b"]
    packet = cfe.emit_telemetry(0x0808, bytes(156))
    legacy.append(len(packet).to_bytes(2, "big") + bytes.fromhex("0300000003") + packet)
    listed = sbn.emit_subscriptions([sbn.Subscription(0x82A)])
    legacy.append(len(listed).to_bytes(2, "big") + bytes.fromhex("0100000003") + listed)
    return [*found.values(), *legacy, cfe.emit_command(0x1806, 0), b""]


POOL = pool()


@st.composite
def messages(draw):
    """A message with lists, in an SBN datagram, from the bridge."""
    msg_id = draw(st.sampled_from(sorted(LISTS)))
    number = st.floats(width=32) | st.integers(-3, 3).map(float)
    few = st.lists(number, max_size=3)
    pose = st.fixed_dictionaries({"position": st.fixed_dictionaries({"x": number})})
    point = st.fixed_dictionaries({"positions": few, "effort": few})
    texts = st.lists(st.text(max_size=3), max_size=3)
    dimension = st.fixed_dictionaries({"label": st.text(max_size=2), "size": st.integers(0, 9)})
    value = draw(
        {
            0x182B: st.fixed_dictionaries({"name": texts, "position": few}),
            0x182C: st.fixed_dictionaries({"poses": st.lists(pose, max_size=3)}),
            0x182D: st.fixed_dictionaries({"joint_names": texts, "points": st.lists(point, max_size=3)}),
            0x182E: st.fixed_dictionaries({"covariance": st.lists(number, min_size=36, max_size=36)}),
            0x182F: st.fixed_dictionaries({"data": st.integers(0, 2**64 - 1)}),
            0x1830: st.fixed_dictionaries(
                {"data": few, "layout": st.fixed_dictionaries({"dim": st.lists(dimension, max_size=2)})}
            ),
            0x1831: st.fixed_dictionaries({"data": st.booleans()}),
            0x1832: st.just({}),
        }[msg_id]
    )
    return message(msg_id, value, big_endian=draw(st.booleans()), padding=draw(st.sampled_from([0, 9])))


def message(msg_id, value, *, big_endian=False, padding=0):
    """Return a message as the bridge sends it over SBN."""
    cdr = TYPES.encode(LISTS[msg_id], value, big_endian=big_endian)
    body = len(cdr).to_bytes(8, "little") * 2 + cdr + bytes(padding)
    return sbn.emit(3, Peer(66, 3), cfe.emit_command(msg_id, 1, body))


LISTED = [
    message(0x182B, {"name": ["a", "bc"], "position": [1.5]}),
    message(0x182B, {"name": [], "position": [0.25, -1, 3]}, big_endian=True),
    message(0x182C, {"poses": [{"position": {"x": 2}}]}),
    message(0x182D, {"joint_names": ["j"], "points": [{"positions": [1, 2]}, {}, {"positions": [3]}]}),
    message(0x182E, {"covariance": list(range(36))}, padding=9),
    message(0x182F, {"data": 2**64 - 1}),
    message(0x1830, {"data": [0.1], "layout": {"dim": [{"label": "x", "size": 4}]}}),
    message(0x1831, {"data": True}),
    message(0x1832, {}),
    sbn.emit(3, Peer(66, 1), cfe.emit_telemetry(0x0808, bytes(156))),
]


@st.composite
def payloads(draw):
    """Packets as they are, and with a few bytes changed, cut or added."""
    data = bytearray(draw(st.sampled_from(POOL) | st.sampled_from(LISTED) | messages()))
    if draw(st.booleans()):
        return bytes(data)
    for _ in range(draw(st.integers(0, 3)) if data else 0):
        data[draw(st.integers(0, min(len(data) - 1, 60)))] = draw(st.integers(0, 255))
    cut = draw(st.integers(0, len(data)) | st.just(len(data)))
    return bytes(data[:cut]) + draw(st.binary(max_size=9))


ROWS = st.lists(
    st.tuples(
        payloads(),
        st.sampled_from([40000, 1235, 2236]),
        st.sampled_from([1234, 1235, 2234, 2236, 9]),
        st.sampled_from([0, 0, 0, int(Finding.CAPTURE_CUT)]),
    ),
    max_size=10,
)
OPTIONS = st.sampled_from(
    [
        Options(),
        Options(),
        Options(extended_header=True),
        Options(msg_id_version=2),
        Options(telemetry_header=12),
        Options(envelope="4/4 be"),
        Options(envelope="auto"),
    ]
)


@pytest.mark.long
@settings(max_examples=examples(100, 50, 2))
@given(rows=ROWS, name=st.sampled_from(sorted(MISSIONS)), options=OPTIONS)
@example(rows=[], name="lists", options=Options())
@example(rows=[(item, 2236, 2234, 0) for item in LISTED], name="lists", options=Options())
@example(rows=[(item, 2236, 2234, 0) for item in POOL], name="rover", options=Options())
@example(rows=[(item, 40000, 1235, 0) for item in POOL], name="arm", options=Options())
def test_every_field_of_any_bytes(rows, name, options):
    for turn in range(TURNS) if LONG else {sum(map(len, map(itemgetter(0), rows)))}:
        agree(batch_of(rows), name, options, turn)


NUMBERS = ["0", "1", "-1", "1.5", "0.1", "66", "2235", "0x827", "18446744073709551615", "nan", "inf", "1e300"]
WORDS = [
    "true",
    "SUB",
    "sbn",
    "'a'",
    "''",
    "cmd_vel",
    "00:01",
    "header_only",
    "2026-11-21",
    "127.0.0.1",
    "250ms",
]
CONSTANTS = st.sampled_from(NUMBERS + WORDS)
MORE = {
    "rover": ["pose", "ros.pose.position.x"],
    "arm": ["name[0]", "position[-1]", "ros.name"],
    "lists": ["poses", "poses[0]", "poses[1].position.x", "points[-1].positions[0]", "covariance[-40]"],
}
WRITTEN = {
    name: sorted({*Names(Context(mission, TYPES)).all(), *MORE.get(name, [])})
    for name, mission in MISSIONS.items()
}
OPERATORS = ["==", "!=", "<", "<=", ">", ">=", "contains", "matches", "in", "not in", ""]


@st.composite
def expressions(draw, mission, depth=2):
    """Filters of any shape; not all of them are sound."""
    if depth and draw(st.booleans()):
        parts = draw(st.lists(expressions(mission, depth - 1), min_size=2, max_size=3))
        return "(" + draw(st.sampled_from([" and ", " or ", " && ", "||"])).join(parts) + ")"
    name = draw(st.sampled_from(WRITTEN[mission]))
    wrapped = draw(st.sampled_from(["{}", "{}", "{}", "any({})", "all({})", "len({})"])).format(name)
    operator = draw(st.sampled_from(OPERATORS))
    one, other = draw(CONSTANTS), draw(CONSTANTS)
    if "in" in operator.split():
        one = draw(st.sampled_from([f"{{{one}, {other}}}", f"{one}..{other}"]))
    told = f"{wrapped} {operator} {one}" if operator else name
    return f"not {told}" if draw(st.booleans()) else told


CASES = st.sampled_from(sorted(MISSIONS)).flatmap(lambda name: st.tuples(st.just(name), expressions(name)))


# Many of them are mistakes, and are drawn again.
@settings(max_examples=examples(200, 40), suppress_health_check=[HealthCheck.filter_too_much])
@given(rows=ROWS, case=CASES)
@example(rows=[(item, 2236, 2234, 0) for item in POOL], case=("rover", "not summary contains 'x=' and sbn"))
def test_whole_filters(rows, case):
    name, text = case
    context = Context(MISSIONS[name], TYPES)
    try:
        where = Where(text, context)
    except WhereError:
        reject()
    batch = batch_of(rows)
    columns = ColumnDecoder(context).decode(batch)
    packets = [Dissector(context, detail=False).dissect(batch[index]) for index in range(len(batch))]
    mask = where.mask(batch, columns)
    assert mask.dtype == bool
    assert mask.tolist() == where.judge(packets).tolist()
    half = np.arange(0, len(batch), 2)
    assert where.mask(batch, columns, half).tolist() == mask[half].tolist()
    opposite = Where(f"not ({text})", context)
    opposite.mask(batch, columns)
    assert (opposite.mask(batch, columns) == ~mask).all()


@settings(max_examples=examples(500, 8))
@given(text=st.text(max_size=40) | st.text("()!=<>&|{}.,'\"[] notandi0x1", max_size=40))
@example("(" * 5000)
@example("not " * 5000)
@example("link == " + "9" * 9999)
def test_whatever_is_written_is_a_filter_or_a_located_mistake(text):
    try:
        Where(text, Context(MISSIONS["rover"], TYPES))
    except WhereError as mistake:
        error = mistake
    else:
        return
    assert 0 <= error.at <= len(text)
    first, second, third = str(error).splitlines()
    assert first.startswith(f"--where, character {error.at + 1}: ")
    assert len(second) <= 102
    assert set(third) == {" ", "^"}
