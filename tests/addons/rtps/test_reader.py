"""RTPS as a link: submessages as tshark reads them, columns and layers alike, samples as they were sent."""

import subprocess
from itertools import chain

import numpy as np
import pytest
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from places import ROOT
from rtps import CAPTURES, PREFIX, TRUTH, WRITER, announced, batches, data, message
from rtps_batches import batch_of

from edoras_tools.addons.rtps.link import RTPS
from edoras_tools.addons.rtps.wire import EVERY_RTPS_LAYOUT, STATUS_NAMES, Announcement
from edoras_tools.decode import ColumnDecoder, Context, Dissector
from edoras_tools.decode.filters.filter import Where
from edoras_tools.decode.filters.names import Names
from edoras_tools.decode.filters.rows import ColumnRows
from edoras_tools.links.doors import MOST_ENDPOINTS, Endpoints
from edoras_tools.links.table import protocol
from edoras_tools.mission import load
from edoras_tools.model import Finding
from edoras_tools.ros import TypeStore

TYPES = TypeStore()
FIELDS = {
    "rtps.sm.id": ["submessage_id"],
    "rtps.sm.flags": ["flags"],
    "rtps.sm.octetsToNextHeader": ["octets_to_next_header"],
    "rtps.sm.rdEntityId": ["reader_id"],
    "rtps.sm.wrEntityId": ["writer_id"],
    "rtps.sm.seqNumber": ["first_sn", "last_sn", "gap_start_sn", "base_sn", "writer_sn"],
    "rtps.bitmap.num_bits": ["num_bits"],
    "rtps.data_frag.number": ["fragment_starting_num"],
    "rtps.data_frag.num_fragments": ["fragments_in_submessage"],
    "rtps.data_frag.size": ["fragment_size"],
    "rtps.data_frag.sample_size": ["sample_size"],
    "rtps.heartbeat_frag.number": ["last_fragment_num"],
    "rtps.param.status_info": ["status"],
}
"""What tshark calls our fields; several are in wire order of their layer."""
APART = {"rtps.bitmap.num_bits": "rtps_nack_frag"}
"""Layers whose field of that name tshark calls otherwise."""
UNREAD = range(0x80, 0x100)
"""Submessages of vendors, of which tshark shows the number alone."""


def read(batch, context=None):
    """Return the columns of a batch and its packets, read one by one; both agree."""
    context = context or Context(types=TYPES)
    columns = ColumnDecoder(context).decode(batch)
    dissector = Dissector(Context(types=TYPES))
    dissector.context.endpoints = context.endpoints
    packets = [dissector.dissect(batch[row]) for row in range(len(batch))]
    assert [item.link for item in packets] == columns.link.tolist()
    assert [int(item.findings) for item in packets] == columns.findings.tolist()
    return columns, packets


def told(values):
    if isinstance(values, str):
        return sum(bit for bit, name in STATUS_NAMES.items() if name in values.split(" and "))
    return int.from_bytes(values, "big") if isinstance(values, bytes) else values


def ours(packet):
    """Return what our layers say under tshark's names."""
    found = {name: [] for name in FIELDS}
    for layer in packet.layers:
        values = layer.values()
        if "submessage_id" not in values:
            continue
        for name, own in FIELDS.items():
            unnamed = layer.name == "rtps_submessage" and values["submessage_id"] in UNREAD
            if APART.get(name) != layer.name and not (unnamed and name != "rtps.sm.id"):
                found[name] += [told(values[item]) for item in own if item in values]
    return found


@pytest.mark.each(2)
@pytest.mark.quick("fastdds*")
@pytest.mark.parametrize("path", CAPTURES, ids=lambda path: path.name.partition(".")[0])
def test_every_submessage_as_tshark_reads_it(path):
    asked = chain.from_iterable(("-e", name) for name in FIELDS)
    lines = subprocess.run(
        [
            "tshark",
            "--disable-protocol",
            "rx",  # it has port 7000
            "-r",
            path,
            "-Y",
            "rtps",
            "-T",
            "fields",
            "-e",
            "frame.number",
            "-e",
            "rtps.guidPrefix.src",
            *asked,
        ],
        capture_output=True,
        text=True,
        check=True,
    ).stdout.splitlines()
    judged = {}
    for line in lines:
        number, prefix, *columns = line.split("\t")
        values = [[int(item, 0) for item in column.split(",") if item] for column in columns]
        judged[int(number)] = prefix, dict(zip(FIELDS, values, strict=True))
    found = {}
    context = Context(types=TYPES)
    for batch in batches(path):
        for packet in read(batch, context)[1]:
            if packet.link is RTPS:
                assert packet.stop is None
                assert not packet.findings
                prefix = packet.layers[0].values()["guid_prefix"].hex()
                found[packet.datagram.number] = prefix, ours(packet)
    assert len(found) > 250
    assert found == judged


@pytest.mark.each(2)
@pytest.mark.quick("cyclone*")
@pytest.mark.parametrize("path", CAPTURES, ids=lambda path: path.name.partition(".")[0])
def test_samples_are_what_was_published(path):
    kind, _, end = path.name.partition(".")[0].partition("_")
    truth, context, seen = TRUTH[kind], Context(types=TYPES), {}
    for batch in batches(path):
        for packet in read(batch, context)[1]:
            for item in packet.messages:
                seen.setdefault(item.topic, {}).setdefault(str(item.values), item.values)
    twists = [item["linear"]["x"] for item in seen["/cmd_vel"].values()]
    assert sorted(round(10 * value) for value in twists) == list(range(truth["written"]["/cmd_vel"]))
    texts = [int(item["data"].split()[1]) for item in seen["/chatter"].values()]
    # Best effort: at the receiver's end there is what it heard; at the sender's all.
    expected = truth["heard"]["/chatter"] if end == "receiver" else range(truth["written"]["/chatter"])
    assert sorted(texts) == list(expected)


def test_topics_are_those_that_were_announced():
    context = Context(types=TYPES)
    for batch in batches(CAPTURES[0]):
        ColumnDecoder(context).decode(batch)
    known = {item.topic: item for item, _ in context.endpoints.announced.values()}
    assert {"rt/cmd_vel", "rt/chatter", "rt/joint_states"} <= set(known)
    assert known["rt/cmd_vel"].type == "geometry_msgs::msg::dds_::Twist_"


def test_an_endpoint_is_unknown_before_it_is_announced():
    cdr = b"\0\1\0\0" + np.arange(6, dtype="<f8").tobytes()
    sample = message(data(7, cdr))
    columns, packets = read(batch_of(sample, announced(), sample))
    assert [len(item.messages) for item in packets] == [0, 0, 1]
    assert packets[2].message.topic == "/cmd_vel"
    assert packets[2].message.values["angular"] == {"x": 3.0, "y": 4.0, "z": 5.0}
    assert not columns.findings.any()
    assert packets[0].summary == "DATA 7"
    assert packets[2].summary.startswith("DATA /cmd_vel 7: linear.y=1")


def test_several_samples_in_one_datagram():
    samples = [data(number, b"\0\1\0\0" + np.full(6, number, "<f8").tobytes()) for number in (1, 2, 3)]
    batch = batch_of(announced(), message(*samples), message(data(4, b"\0\1\0\0" + bytes(7))))
    context = Context(types=TYPES)
    columns, packets = read(batch, context)
    assert [item.values["linear"]["x"] for item in packets[1].messages] == [1.0, 2.0, 3.0]
    assert columns.findings.tolist() == [0, 0, int(Finding.CDR_INVALID)]
    ColumnRows(context, 0, batch, columns)
    for text, hits in {
        "rtps_data.writer_sn_low == 3": [1],
        "rtps_data.writer_sn_low < 2": [0, 1],
        "rtps.vendor_id == 0x0110": [0, 1, 2],
        "rtps_heartbeat": [],
        "rtps.writer_sn == 3": [1],
        "rtps.writer_sn > 1": [1, 2],
        f"rtps.writer == '{PREFIX.hex()}.{WRITER.hex()}'": [1, 2],
        "rtps.topic == '/cmd_vel'": [1, 2],
        "rtps_data_big": [],
    }.items():
        fast = Where(text, context).mask(batch, columns)
        assert np.flatnonzero(fast).tolist() == hits, text
        assert [bool(Where(text, context).judge([item])[0]) for item in packets] == fast.tolist(), text


def test_fields_of_messages_are_those_of_samples_too():
    mission = load([ROOT / "samples/missions/rover_ground.yaml"])
    context = Context(mission, TYPES)
    several = [data(number, b"\0\1\0\0" + np.full(6, number, "<f8").tobytes()) for number in (1, 5)]
    batch = batch_of(announced(), message(*several), message(several[1]))
    columns = ColumnDecoder(context).decode(batch)
    packets = [Dissector(context).dissect(batch[row]) for row in range(len(batch))]
    for text, hits in {
        "linear.x > 3": [1, 2],
        "linear.x == 1": [1],
        "angular": [1, 2],
        "topic == '/cmd_vel'": [1, 2],
        "type == Twist": [1, 2],
    }.items():
        fast = Where(text, context).mask(batch, columns)
        assert np.flatnonzero(fast).tolist() == hits, text
        assert [bool(Where(text, context).judge([item])[0]) for item in packets] == fast.tolist(), text


def test_any_port_but_only_what_begins_so():
    columns, _ = read(batch_of(announced(), b"RTPX" + bytes(40), b"RTP", b"", b"RTPS"))
    assert columns.link.tolist() == [8, 0, 0, 0, 8]
    assert columns.findings.tolist() == [0, 0, 0, 0, int(Finding.TRUNCATED)]
    assert protocol(RTPS) is RTPS


def test_every_field_of_the_tree_is_a_filter():
    known = set(Names(Context()).all())
    for layout in EVERY_RTPS_LAYOUT:
        assert {layout.name, *(f"{layout.name}.{name}" for name in layout.by_name)} <= known


def test_endpoints_are_limited():
    known = Endpoints()
    for number in range(MOST_ENDPOINTS + 10):
        known.learn(Announcement(number.to_bytes(16, "big"), "a"), number)
    assert len(known.announced) == MOST_ENDPOINTS
    known.learn(Announcement(bytes(16), "b"), -1)
    assert known.find(bytes(16), -1).topic == "a"
    assert known.find(bytes(16), -2) is None
    assert known.is_new(b"x")
    assert not known.is_new(b"x")


@settings(max_examples=examples(300), deadline=None)
@given(st.lists(st.binary(max_size=120), min_size=1, max_size=4), st.randoms(use_true_random=False))
def test_any_bytes(payloads, rng):
    made = [announced(), message(data(3, b"\0\1\0\0" + bytes(48)))]
    for item in payloads:
        whole = bytearray(made[rng.randrange(2)] + item)
        whole[rng.randrange(8, len(whole))] = rng.randrange(256)
        made.append(bytes(whole))
        made.append(message(item, prefix=PREFIX[:8] + WRITER))
    batch = batch_of(*made)
    context = Context(types=TYPES)
    columns, packets = read(batch, context)
    rows = ColumnRows(context, 0, batch, columns)
    for layout in EVERY_RTPS_LAYOUT:
        owner, start = RTPS.places(layout, rows)
        mine = [
            (row, layer.start)
            for row, item in enumerate(packets)
            for layer in item.layers
            if layer.name == layout.name
        ]
        assert list(zip(owner.tolist(), (start - batch.offset[owner]).tolist(), strict=True)) == mine
