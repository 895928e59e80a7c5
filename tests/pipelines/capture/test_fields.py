"""Fields as text: what is printed is what the filter language reads."""

import pytest
from effort import every
from places import MISSIONS

from edoras_tools.decode.filters.filter import Where, fields
from edoras_tools.decode.filters.rows import ColumnRows
from edoras_tools.decode.filters.syntax import WhereError
from edoras_tools.pipelines.capture.fields import column_texts, is_number
from edoras_tools.pipelines.capture.packet_json import as_json
from edoras_tools.pipelines.reading import Limits, selected_rows
from edoras_tools.pipelines.selection import Selection
from edoras_tools.pipelines.workbench import Settings, open_files

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
