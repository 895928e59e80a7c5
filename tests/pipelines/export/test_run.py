"""Tables against rosbags' reading of the recordings, and what pandas, polars and DuckDB read from them."""

import importlib
import json
import math
from contextlib import closing
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from effort import long_but
from places import CAPTURES, MISSIONS, SAMPLE_MISSIONS, SMALL_SAMPLES
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import edoras_tools
from edoras_tools.errors import CaptureError, ConfigError, RouteError
from edoras_tools.io.formats.table import TimeForm
from edoras_tools.pipelines.capture.record import Target, record
from edoras_tools.pipelines.doctor import Scope
from edoras_tools.pipelines.export.reading import TableForm
from edoras_tools.pipelines.export.run import ExportTarget, export
from edoras_tools.pipelines.export.sources import open_topics
from edoras_tools.pipelines.selection import Period, Selection
from edoras_tools.pipelines.workbench import Settings, open_files

ROVER = CAPTURES / "a_rover.pcap"


def capture(name):
    return next(CAPTURES.glob(f"{name}.pcap*"))


def settings(name):
    return Settings(tuple(MISSIONS / f"{item}.yaml" for item in SAMPLE_MISSIONS[name]))


def flat(value, prefix=""):
    """The leaves of a message of rosbags by dotted name; of lists of messages a list each."""
    names = [item.name for item in fields(value)]
    for name in (item for item in names if not item.isupper() and not item.startswith("__")):  # no constants
        item, path = getattr(value, name), f"{prefix}{name}"
        if hasattr(item, "__dataclass_fields__"):
            yield from flat(item, f"{path}.")
        elif isinstance(item, list) and item and hasattr(item[0], "__dataclass_fields__"):
            parts = {}
            for each in item:
                for inner, leaf in flat(each, f"{path}."):
                    parts.setdefault(inner, []).extend(leaf if isinstance(leaf, list) else [leaf])
            yield from parts.items()
        else:
            yield path, plain(item)


def plain(value):
    """A value as Python's own, NaN as a text, so that it equals itself."""
    if isinstance(value, (list, tuple, np.ndarray)):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    return "NaN" if isinstance(value, float) and math.isnan(value) else value


def rosbags_reading(folder):
    """Every message by topic: a list of (time, leaves), as rosbags reads it."""
    found = {}
    with AnyReader([folder]) as reader:
        wanted = [item for item in reader.connections if item.topic != "/edoras/datagrams"]
        for connection, time_ns, raw in reader.messages(wanted):
            message = reader.deserialize(raw, connection.msgtype)
            found.setdefault(connection.topic, []).append((time_ns, dict(flat(message))))
    return found


def of_pandas(path):
    frame = importlib.import_module("pandas").read_parquet(path)
    return frame["time"].astype("int64").tolist(), {name: frame[name].tolist() for name in frame}


def of_polars(path):
    frame = importlib.import_module("polars").read_parquet(path)
    return frame["time"].dt.epoch("ns").to_list(), {name: frame[name].to_list() for name in frame.columns}


def of_duckdb(path):
    duckdb = importlib.import_module("duckdb")
    with closing(duckdb.connect()) as base:
        base.execute("SET TimeZone = 'UTC'")
        columns = [row[0] for row in base.execute(f"DESCRIBE SELECT * FROM '{path}'").fetchall()]
        others = ", ".join(f'"{name}"' for name in columns if name not in {"time", "publish_time"})
        rows = base.execute(f"SELECT epoch_ns(time), {others} FROM '{path}'").fetchall()
    names = ["time", *(name for name in columns if name not in {"time", "publish_time"})]
    found = {name: [row[place] for row in rows] for place, name in enumerate(names)}
    return found["time"], found


READERS = {"pandas": of_pandas, "polars": of_polars, "duckdb": of_duckdb}


@pytest.mark.quick("f_sbn_disconnect")
@pytest.mark.parametrize("name", long_but(SMALL_SAMPLES, SAMPLE_MISSIONS))
def test_parquet_holds_what_rosbags_reads(name, tmp_path):
    pytest.importorskip("pyarrow")
    source = open_files([capture(name)])
    record(source, settings(name).workbench(source.info), Target(tmp_path / "bag", rosbag2=True))
    judged = rosbags_reading(tmp_path / "bag")
    report = export(open_topics([capture(name)], settings(name)), ExportTarget.of(tmp_path / "out"))
    assert {item.head.topic for item in report.files} == set(judged)
    readers = [read for library, read in READERS.items() if importlib.util.find_spec(library)]
    assert readers
    for item in report.files:
        messages = judged[item.head.topic]
        assert len(messages) == item.rows
        for read in readers:
            # Where the clock stepped back, rosbags sorts by time; the table keeps the order of the capture.
            times, columns = read(item.path)
            order = sorted(range(len(times)), key=times.__getitem__)
            assert [times[row] for row in order] == [time_ns for time_ns, _ in messages]
            for field in {field for _, leaves in messages for field in leaves}:
                values = plain([columns[field][row] for row in order])
                assert values == [leaves.get(field, []) for _, leaves in messages], (item.path, field)


ODD = "string name\nfloat32[] xs\ngeometry_msgs/Point[2] ps\nuint8 time\nstring<=4[] ws\n"


def write_bag(path, plugin):
    """A bag of rosbags' own, with a type that no distribution has."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(ODD, "my_msgs/msg/Odd"))
    odd, point = store.types["my_msgs/msg/Odd"], store.types["geometry_msgs/msg/Point"]
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        connection = writer.add_connection("/odd", "my_msgs/msg/Odd", typestore=store)
        for row in range(5):
            xs = np.arange(row, dtype=np.float32)
            ps = [point(x=1.0 * row, y=2.0, z=3.0), point(x=4.0, y=5.0, z=6.0)]
            message = odd(name=f"n{row}", xs=xs, ps=ps, time=row, ws=["ab"] * row)
            writer.write(connection, 10**18 + row, store.serialize_cdr(message, "my_msgs/msg/Odd"))


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_bags_of_others_bring_their_types_along(plugin, tmp_path):
    write_bag(tmp_path / "bag", plugin)
    report = export(open_topics([tmp_path / "bag"], Settings()), ExportTarget.of(tmp_path / "a.jsonl"))
    assert not report.source.notes
    rows = [json.loads(line) for line in (tmp_path / "a.jsonl").read_text().splitlines()]
    judged = rosbags_reading(tmp_path / "bag")["/odd"]
    times = [f"2001-09-09T01:46:40.{row:09}Z" for row in range(5)]
    assert rows == [{"_time": when, **leaves} for when, (_, leaves) in zip(times, judged, strict=True)]


def test_shorter_lists_have_nothing_beside_longer_ones(tmp_path):
    write_bag(tmp_path / "bag", StoragePlugin.MCAP)
    made = edoras_tools.read(tmp_path / "bag", explode=True)["/odd"].to_numpy()
    chosen = made["name"] == "n3"
    assert made["element"][chosen].tolist() == [0, 1, 2]
    assert made["xs"][chosen].tolist() == [0, 1, 2]
    assert made["ps.x"][chosen].tolist() == [3, 4, None]
    assert made["ws"][made["name"] == "n0"].tolist() == [None, None]


@pytest.mark.quick("csv")
@pytest.mark.parametrize("suffix", ["csv", "jsonl"])
def test_a_bag_and_its_capture_give_the_same(suffix, tmp_path):
    source = open_files([ROVER])
    record(source, settings("a_rover").workbench(source.info), Target(tmp_path / "bag", rosbag2=True))
    found = []
    for place, (path, config) in enumerate([(ROVER, settings("a_rover")), (tmp_path / "bag", Settings())]):
        made = export(
            open_topics([path], config),
            ExportTarget.of(tmp_path / f"{place}.{suffix}"),
            ["/telemetry_pose"],
            TableForm(("header", "pose.position.*"), time=TimeForm.NS),
        )
        assert made.files[0].rows == 63
        found.append((tmp_path / f"{place}.{suffix}").read_text())
    assert found[0] == found[1]
    head = "time,header.stamp.sec,header.stamp.nanosec,header.frame_id,pose.position.x"
    assert suffix == "jsonl" or found[0].startswith(head)


def test_seconds_count_from_the_start_and_end_before_the_end(tmp_path):
    scope = Scope(Selection(where="linear.x > 0.5"), Period(10 * 10**9, 20 * 10**9))
    export(
        open_topics([ROVER], settings("a_rover"), scope),
        ExportTarget.of(tmp_path / "a.jsonl"),
        ["cmd_vel"],
        TableForm(time=TimeForm.SECONDS),
    )
    rows = [json.loads(line) for line in (tmp_path / "a.jsonl").read_text().splitlines()]
    assert rows
    assert all(10 <= row["time"] < 20 and row["linear.x"] > 0.5 for row in rows)


def test_lists_become_rows_side_by_side():
    arm = edoras_tools.read(capture("b_arm_single"), config=settings("b_arm_single").configs, explode=True)
    table = arm["/edoras/datagrams"]
    plain_table = edoras_tools.read(capture("b_arm_single"))["/edoras/datagrams"].to_numpy()
    columns = table.to_numpy()
    lengths = np.array([len(item) for item in plain_table["frame"]])
    assert len(table) == lengths.sum()
    assert columns["source_address[15]"].shape == (len(table),)
    assert (columns["element"] == np.concatenate([np.arange(length) for length in lengths])).all()
    assert (columns["frame"] == np.concatenate(plain_table["frame"])).all()


def test_files_are_named_after_topics():
    target = ExportTarget.of(Path("out"), name="csv")
    assert target.place("/robot_1/cmd_vel") == Path("out/robot_1.cmd_vel.csv")
    assert target.place("/a.b/../c") == Path("out/a%2Eb.%2E%2E.c.csv")
    assert len(target.place("/" + "t" * 300).name) < 200


@pytest.mark.parametrize(
    ("patterns", "chosen", "error", "words"),
    [
        (["/cmd_vle"], (), RouteError, "did you mean /cmd_vel"),
        (
            ["/cmd_vel"],
            ("linaer.x",),
            ConfigError,
            "'linaer.x' is no field of /cmd_vel; did you mean linear",
        ),
        ([], (), ConfigError, "are several topics; select one with --topic, or name a folder"),
        (["/edoras/faults"], (), CaptureError, "no message on /edoras/faults in the selected part"),
    ],
)
def test_what_cannot_be_exported_leaves_nothing(patterns, chosen, error, words, tmp_path):
    with pytest.raises(error, match=words):
        export(
            open_topics([ROVER], settings("a_rover")),
            ExportTarget.of(tmp_path / "a.csv"),
            patterns,
            TableForm(chosen),
        )
    assert not list(tmp_path.iterdir())


def test_a_time_outside_of_the_capture_says_what_times_there_are(tmp_path):
    source = open_topics([ROVER], settings("a_rover"), Scope(period=Period(10**13)))
    with pytest.raises(CaptureError, match=r"its times go from 0 to 65\.270 s"):
        export(source, ExportTarget.of(tmp_path / "a.csv"), ["cmd_vel"])


def test_a_capture_that_is_cut_off_gives_what_it_holds(tmp_path):
    (tmp_path / "cut.pcap").write_bytes(ROVER.read_bytes()[:-7])
    source = open_topics([tmp_path / "cut.pcap"], settings("a_rover"))
    report = export(source, ExportTarget.of(tmp_path / "out", name="csv"))
    assert "cut off" in str(report.source.failure)
    assert {item.head.topic: item.rows for item in report.files}["/cmd_vel"] == 600
