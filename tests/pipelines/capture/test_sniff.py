"""Packets one by one: what is chosen, where it ends, and what becomes of values that JSON has no word for."""

from __future__ import annotations

import itertools
import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
from effort import every
from hypothesis import given
from hypothesis import strategies as st
from places import MISSIONS

from edoras_tools.decode import Context
from edoras_tools.decode.filters.filter import Where, fields
from edoras_tools.decode.filters.rows import ColumnRows
from edoras_tools.decode.filters.syntax import WhereError
from edoras_tools.errors import CaptureError, RouteError, TruncatedError
from edoras_tools.links.bare import CI, TO
from edoras_tools.links.sbn import SBN
from edoras_tools.mission import Mission, Route
from edoras_tools.model import (
    OTHER,
    Datagram,
    Decoded,
    Endpoint,
    Finding,
    Layer,
    LayerField,
    RosMessage,
)
from edoras_tools.pipelines.capture.packet_json import as_json
from edoras_tools.pipelines.capture.sniff import column_texts, decode_packet, is_number, sniff
from edoras_tools.pipelines.reading import Limits, selected_rows
from edoras_tools.pipelines.selection import Selection
from edoras_tools.pipelines.workbench import Settings, open_files

ROUTES = tuple(
    Route(topic, "geometry_msgs/msg/Twist", 0x1827 + index, CI, "command")
    for index, topic in enumerate(["/robot_1/cmd_vel", "/robot_2/cmd_vel", "/arm/target"])
)


def bench_of(*routes):
    """What a selection needs of a workbench, for a mission with these routes."""
    return SimpleNamespace(columns=SimpleNamespace(context=Context(Mission(routes=routes))))


@pytest.fixture
def rover(captures):
    source = open_files([captures("a_rover")])
    yield source
    source.close()


def test_everything_then_closed(bench, batches_of, made_up):
    source = made_up(batches_of("a_rover", 700))
    shown = list(sniff(source, bench, selection=Selection()))
    assert [item.datagram.number for item in shown] == list(range(1, 1828))
    assert source.closed


@pytest.fixture
def batches_of(captures):
    def cut(name, size):
        source = open_files([captures(name)])
        (whole,) = source.batches()
        source.close()
        return [whole.take(slice(start, start + size)) for start in range(0, len(whole), size)]

    return cut


@pytest.mark.parametrize("count", [1, 99, 100, 101])
def test_count_stops_there(count, bench, batches_of, made_up):
    source = made_up(batches_of("a_rover", 100))
    assert len(list(sniff(source, bench, selection=Selection(), limits=Limits(count)))) == count
    assert source.closed


def test_duration_stops_after_a_batch(bench, batches_of, made_up):
    times = itertools.count(0, 10**9)
    source = made_up(batches_of("a_rover", 100))
    shown = sniff(source, bench, selection=Selection(), limits=Limits(0, 2 * 10**9, lambda: next(times)))
    assert len(list(shown)) == 200


def test_everything_before_an_error(bench, batches_of, made_up):
    source = made_up([*batches_of("a_rover", 100)[:2], CaptureError("cut")])
    shown = sniff(source, bench, selection=Selection())
    assert len(list(itertools.islice(shown, 200))) == 200
    with pytest.raises(CaptureError, match="cut"):
        next(shown)
    assert source.closed


def test_an_abandoned_reader_closes_its_source(bench, batches_of, made_up):
    source = made_up(batches_of("a_rover", 100))
    shown = sniff(source, bench, selection=Selection())
    next(shown)
    shown.close()
    assert source.closed


def test_find_by_number(bench, captures):
    for number in (1, 1000, 1827):
        assert decode_packet(open_files([captures("a_rover")]), bench, number).datagram.number == number


def test_find_says_what_is_wrong(bench, batches_of, made_up):
    (whole,) = batches_of("a_rover", 10**6)
    without = [whole.take(np.flatnonzero(whole.number != 5))]
    with pytest.raises(CaptureError, match="made up: packet 5 is not a UDP datagram"):
        decode_packet(made_up(without), bench, 5)
    with pytest.raises(CaptureError, match="packet 1828 does not exist: the last datagram is number 1827"):
        decode_packet(made_up([whole]), bench, 1828)
    source = made_up([whole, CaptureError("never reached")])
    decode_packet(source, bench, 3)
    assert source.closed


SELECTIONS = [
    (Selection(), [True] * 4),
    (Selection(links=[CI]), [True, True, False, False]),
    (Selection(msg_ids=[0x1828, 0x827]), [False, True, True, False]),
    (Selection(topics=["/robot_*"]), [True, True, False, False]),
    (Selection(topics=["*/cmd_vel"]), [True, True, False, False]),
    (Selection(topics=["robot_2/cmd_vel"]), [False, True, False, False]),
    (Selection(topics=["/robot_[2-9]/*", "/arm/target"]), [False, True, False, False]),
    (Selection(notable=int(Finding.TRUNCATED)), [False, False, False, True]),
    (Selection(links=[CI, TO], msg_ids=[0x827]), [False, False, True, False]),
]


@pytest.mark.parametrize(("selection", "wanted"), SELECTIONS, ids=[str(case[0]) for case in SELECTIONS])
def test_selections(selection, wanted, as_batch, row):
    rows = [
        row(link=CI, msg_id=0x1827, route=0),
        row(link=CI, msg_id=0x1828, route=1),
        row(link=TO, msg_id=0x827),
        row(link=OTHER, msg_id=-1, findings=int(Finding.TRUNCATED)),
    ]
    batch, columns = as_batch(rows)
    ready = selection.over(bench_of(*ROUTES))
    assert ready.mask(batch, columns).tolist() == wanted
    chosen, chosen_columns = ready.apply(batch, columns)
    assert len(chosen) == len(chosen_columns) == sum(wanted)
    assert bool(selection) is not all(wanted)


def test_a_topic_that_is_not_there():
    with pytest.raises(
        RouteError, match="matches '/robot'; there are: /robot_1/cmd_vel, /robot_2/cmd_vel, /arm/target"
    ):
        Selection(topics=["/robot"]).over(bench_of(*ROUTES))
    with pytest.raises(RouteError, match="name a mission with -c"):
        Selection(topics=["/robot"]).over(bench_of())


SCALARS = (
    st.none() | st.booleans() | st.integers() | st.floats() | st.binary(max_size=9) | st.text(max_size=9)
)
VALUES = st.recursive(
    SCALARS,
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.tuples(inner, inner)
        | st.dictionaries(st.text(max_size=5), inner, max_size=4)
    ),
    max_leaves=20,
)


def listed(value):
    """A value with lists of numbers for bytes."""
    if isinstance(value, dict):
        return {name: listed(item) for name, item in value.items()}
    return [listed(item) for item in value] if isinstance(value, (list, tuple, bytes)) else value


@given(value=VALUES)
def test_any_value_is_json(value):
    """NaN and the infinities have no word in JSON; bytes are hex in headers, numbers in messages."""
    local = Endpoint("::1", 5)
    decoded = Decoded(
        datagram=Datagram(7, 8, 101, b"", b"abc", -1, 3, local, local),
        link=SBN,
        layers=(
            Layer(
                "sbn",
                "SBN",
                0,
                3,
                (LayerField("field", value, 0, 3), LayerField("listed", listed(value), 0, 3)),
            ),
        ),
        findings=Finding.TRUNCATED | Finding.FRAGMENT,
        message=RosMessage("a/msg/B", "/t", {"v": value}, b""),
        stop=TruncatedError("ccsds", 3, 6, 0),
    )

    def refuse(word):
        raise AssertionError(word)

    read = json.loads(json.dumps(as_json(decoded)), parse_constant=refuse)
    fields = read["layers"]["sbn"]
    assert fields["listed"] == read["message"]["v"]
    if isinstance(value, bytes):
        assert bytes.fromhex(fields["field"]) == bytes(fields["listed"]) == value
    assert read["findings"] == ["truncated", "fragment"]
    assert read["source"] == "[::1]:5"
    assert read["stop"] == "ccsds at byte 3 needs 6 bytes, 0 are there"
    assert (read["number"], read["time_ns"], read["length"], read["msg_id"]) == (7, 8, 3, None)
    if isinstance(value, float) and not math.isfinite(value):
        assert read["message"]["v"] in {"NaN", "Infinity", "-Infinity"}
        assert float(read["message"]["v"]) == value or math.isnan(value)
    elif not isinstance(value, (dict, list, tuple, bytes)):
        assert read["message"]["v"] == value


ROVER = [
    *("number", "time", "time_ns", "utc", "mission_time", "length", "link", "source", "destination.port"),
    *("source.address", "topic", "type", "msg_id", "ccsds.apid", "ccsds.packet_type", "sequence_count"),
    *("function_code", "sbn.msg_type", "sbn.spacecraft_id", "edoras.buffer_length", "cdr.representation"),
    *("cfe_telemetry.spare", "cfe_event.message", "event_type", "pose.position.x"),
    *("header.frame_id", "linear.x", "summary", "len(header.frame_id)"),
]
ARM = ["position[0]", "name[0]", "len(name)", "position.x", "orientation.w", "header.stamp.nanosec"]
CASES = [("a_rover", "rover_ground", name) for name in ROVER]
CASES += [("b_arm_single", "single_arm_ground", name) for name in ARM]


def rows_of(captures, capture, *missions):
    bench = Settings([MISSIONS / f"{name}.yaml" for name in missions]).workbench()
    source = open_files([captures(capture)])
    (rows,) = selected_rows(source, bench, selection=Selection())
    return bench, rows


def texts(bench, rows, names):
    return column_texts(rows, fields(names, bench.columns.context))


@pytest.mark.each(3)
@pytest.mark.long(
    "summary", "*_time", "source*", "ccsds.*", "sbn.*", "cfe_event*", "event_type", "pose*", "name*"
)
@pytest.mark.parametrize(("capture", "mission", "name"), CASES, ids=[case[2] for case in CASES])
def test_a_filter_reads_back_what_is_printed(capture, mission, name, captures):
    bench, rows = rows_of(captures, capture, mission)
    (column,) = texts(bench, rows, name)
    assert len(column) == len(rows)
    there = Where(name, bench.columns.context).mask(rows.batch, rows.columns) if "(" not in name else None
    if there is not None:
        assert [bool(text) for text in column] == there.tolist()
    different = list(dict.fromkeys(text for text in column if text))
    assert different
    # What is said in a line is made packet by packet.
    for text in every(7 if name == "summary" else 1, different[:20]):
        bare = text.replace(".", "").replace("-", "").replace("+", "").isalnum()
        value = text if bare else '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'
        mask = Where(f"{name} == {value}", bench.columns.context).mask(rows.batch, rows.columns)
        assert mask.tolist() == [text == other for other in column], text


def test_the_values_are_those_of_the_json(captures):
    bench, rows = rows_of(captures, "a_rover", "rover_ground")
    names = "number,time_ns,link,source,destination,length,msg_id,pose.position.x,findings"
    printed = texts(bench, rows, names)
    for row in range(0, len(rows), 7):
        record = as_json(bench.dissector.dissect(rows.batch[row]))
        pose = ((record["message"] or {}).get("pose") or {}).get("position", {}).get("x")
        told = [
            record[key] for key in ("number", "time_ns", "link", "source", "destination", "length", "msg_id")
        ]
        told = [*told, pose, ",".join(record["findings"])]
        assert [column[row] for column in printed] == ["" if item is None else str(item) for item in told]


def test_several_values_are_joined(captures):
    bench, rows = rows_of(captures, "b_arm_single", "single_arm_ground")
    position, first, port = texts(bench, rows, "position,position[0],port")
    row = next(index for index, text in enumerate(position) if text)
    assert len(position[row].split(",")) == 7
    assert position[row].split(",")[0] == first[row]
    datagram = rows.batch[row]
    assert port[row] == f"{datagram.source.port},{datagram.destination.port}"


def test_texts_from_packets_can_be_cleaned(captures):
    bench, rows = rows_of(captures, "a_rover", "rover_ground")
    columns = fields("header.frame_id,link", bench.columns.context)
    frame, link = column_texts(rows, columns, str.upper)
    assert "WORLD" in frame
    assert "ci" in link


def test_numbers_keep_to_the_right():
    columns = fields(
        "number,time,msg_id,link,summary,sbn_sub.msg_ids,findings", Settings().workbench().columns.context
    )
    assert [is_number(column) for column in columns] == [True, True, True, False, False, False, False]


MISTAKES = [
    ("number,nubmer", "nubmer", "did you mean number"),
    ("number,", None, "a field's name belongs here"),
    ("", None, "a field's name belongs here"),
    ("number time", "t", "expected a comma or the end"),
    ("any(findings)", "findings", "any(...) is for comparisons"),
    ("sbn", "sbn", "sbn is a group of fields"),
    ("len(link)", "link", "len counts"),
]


@pytest.mark.parametrize(("text", "marked", "said"), MISTAKES)
def test_mistakes_are_marked(text, marked, said):
    with pytest.raises(WhereError) as caught:
        fields(text, Settings().workbench().columns.context)
    assert str(caught.value).startswith(f"--fields, character {caught.value.at + 1}: ")
    assert said in caught.value.why
    assert caught.value.at == (len(text) if marked is None else text.rindex(marked))


def test_times_of_nanoseconds_keep_them(captures):
    bench, rows = rows_of(captures, "a_rover")
    batch = rows.batch
    shifted = type(batch)(
        **{key: getattr(batch, key) for key in batch.__struct_fields__} | {"time_ns": batch.time_ns + 1}
    )
    finer = ColumnRows(bench.columns.context, rows.begin_ns + 2, shifted, rows.columns)
    time, utc = texts(bench, finer, "time,utc")
    assert time[0] == "-0.000000001"
    assert utc[0].endswith("001")
    assert len(utc[0]) == len("2026-11-21T06:13:56.850000001")


@pytest.mark.parametrize("count", [1, 5, 100])
def test_count_ends_it(count, captures, made_up):
    bench = Settings().workbench()
    whole = next(open_files([captures("a_rover")]).batches())
    source = made_up([whole.take(slice(at, at + 30)) for at in range(0, len(whole), 30)])
    blocks = list(
        selected_rows(source, bench, selection=Selection(where="link == sbn"), limits=Limits(count))
    )
    assert sum(map(len, blocks)) == min(count, 72)
    assert source.closed


def test_a_mistaken_filter_closes_its_source(made_up):
    source = made_up([])
    with pytest.raises(WhereError):
        list(selected_rows(source, Settings().workbench(), selection=Selection(where="nothing == 1")))
    assert source.closed


def test_time_counts_from_the_first_datagram_chosen_or_not(captures):
    bench = Settings().workbench()
    source = open_files([captures("a_rover")])
    (rows,) = selected_rows(source, bench, selection=Selection(where="msg_id == 0x1880"))
    assert rows.begin_ns < int(rows.datagram("time_ns")[0])
    elapsed = (int(rows.datagram("time_ns")[0]) - rows.begin_ns) // 1000
    assert texts(bench, rows, "time") == [[f"{elapsed / 1e6:.6f}"]]
