"""``edoras export`` as a shell sees it."""

import csv
import os
import resource
import stat
import subprocess
import sys

import pytest
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

from edoras_tools.errors import InterruptError
from edoras_tools.pipelines.export.sources import CaptureTopics


@pytest.fixture
def rover(captures, missions):
    return [captures("a_rover"), *missions("rover_ground")]


def test_a_topic_as_csv(call, rover, tmp_path):
    path = tmp_path / "new/a.csv"
    done = call("export", *rover, "--topic", "cmd_vel", "-o", path)
    assert (done.code, done.out) == (0, "")
    assert done.err == [f"{path}: 600 rows of /cmd_vel, geometry_msgs/msg/Twist"]
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 600
    assert rows[0]["linear.x"] == "0.5"


def test_json_holds_to_its_schema(call, rover, tmp_path):
    done = call("export", *rover, "-o", f"{tmp_path}/out/", "--format", "csv", "--json")
    told = done.json()
    assert {item["topic"]: item["rows"] for item in told["files"]}["/telemetry_pose"] == 63
    assert {item["path"] for item in told["files"]} == {str(item) for item in (tmp_path / "out").iterdir()}


@pytest.mark.each(2)
@pytest.mark.quick("arrow", "csv")
@pytest.mark.parametrize("kind", ["csv", "jsonl", "arrow", "parquet"])
def test_a_table_on_standard_output_is_that_of_a_file(call, edoras, rover, tmp_path, kind):
    line = ["export", *rover, "--topic", "/cmd_vel"]
    assert call(*line, "-q", "-o", tmp_path / f"a.{kind}").code == 0
    done = edoras(*line, "--format", kind, "-o", "-")
    assert (done.returncode, done.stderr) == (0, b"")
    assert done.stdout == (tmp_path / f"a.{kind}").read_bytes()


def test_a_table_and_a_report_do_not_go_to_the_same_place(call, rover):
    done = call("export", *rover, "--topic", "/cmd_vel", "-o", "-", "--json")
    assert (done.code, done.out) == (2, "")
    assert "leave one of them out" in done.err[0]


def test_what_is_there_is_replaced_only_by_force(call, rover, tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("before")
    chosen = ["--topic", "cmd_vel", "-o", path]
    done = call("export", *rover, *chosen)
    assert (done.code, path.read_text()) == (2, "before")
    assert "exists; name another output, or replace it with --force" in done.err[0]
    assert call("export", *rover, *chosen, "--force").code == 0
    assert len(path.read_text().splitlines()) == 601
    done = call("export", *rover, "-o", tmp_path, "--format", "csv")
    assert (done.code, [item.name for item in tmp_path.iterdir()]) == (2, ["a.csv"])


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["-o", "a.xls"], 2, ".xls is not a table format; use .parquet, .arrow, .csv or .jsonl"),
        (["-o", "a.csv", "--format", "jsonl"], 2, "is CSV by its suffix, and --format says jsonl"),
        (["-o", "a/", "--format", "xls"], 2, "'xls' is not a table format"),
        (["-o", "a.csv", "--time", "local"], 2, "is not one of 'utc', 'ns', 'seconds'"),
        (["-o", "a.csv", "--topic", "cmd_vle"], 1, "did you mean /cmd_vel?"),
        (["-o", "a.csv", "--topic", "cmd_vel", "--fields", "linaer.x"], 2, "did you mean linear.x"),
        (["-o", "a.csv", "--topic", "cmd_vel", "--start", "90"], 1, "its times go from 0 to 65.270 s"),
        (["-o", "a.csv", "--start", "9", "--end", "8"], 2, "--end is not after --start"),
        (
            ["-o", "a.csv"],
            2,
            "are several topics; select one with --topic, or name a folder",
        ),
        (["-o", "/dev/full"], 2, "name its --format"),
        (["-o", "/dev/full", "--format", "csv", "--topic", "cmd_vel"], 1, "No space left on device"),
        (["-o", "/proc/a.csv", "--topic", "cmd_vel"], 1, "/proc/a.csv: cannot be written"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(call, rover, tmp_path, monkeypatch, arguments, code, words):
    monkeypatch.chdir(tmp_path)
    done = call("export", *rover, *arguments)
    assert (done.code, len(done.err), done.out) == (code, 1, "")
    assert words in done.err[0]
    assert not list(tmp_path.iterdir())


@pytest.mark.long
@pytest.mark.parametrize("suffix", ["parquet", "csv"])
def test_a_disk_that_fills_leaves_nothing_and_keeps_what_was_there(command, rover, tmp_path, suffix):
    if suffix == "parquet":
        pytest.importorskip("pyarrow")
    (tmp_path / f"cmd_vel.{suffix}").write_text("before")
    done = subprocess.run(
        [command, "export", *map(str, rover), "-o", f"{tmp_path}/", "--format", suffix, "--force"],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096)),
    )
    assert (done.returncode, len(done.stderr.splitlines()), done.stdout) == (1, 1, "")
    assert "cannot be written: File too large" in done.stderr
    assert [(item.name, item.read_text()) for item in tmp_path.iterdir()] == [(f"cmd_vel.{suffix}", "before")]


def test_a_recording_is_not_overwritten_by_its_own_export(call, rover, tmp_path):
    path = tmp_path / "a.csv"
    path.write_bytes(rover[0].read_bytes())
    done = call("export", path, *rover[1:], "--topic", "cmd_vel", "-o", path, "--force")
    assert (done.code, path.read_bytes()) == (2, rover[0].read_bytes())
    assert "would overwrite its own input" in done.err[0]


def test_an_interrupted_export_is_whole_and_says_so(call, rover, tmp_path, monkeypatch):
    made = CaptureTopics.pieces

    def interrupted(source, *arguments):
        for item in made(source, *arguments):
            yield item
            source.failure = InterruptError("x: interrupted; everything before was read")
            return

    monkeypatch.setattr(CaptureTopics, "pieces", interrupted)
    done = call("export", *rover, "--topic", "cmd_vel", "-o", tmp_path / "a.csv")
    assert (done.code, len((tmp_path / "a.csv").read_text().splitlines())) == (130, 601)
    assert done.err[-1] == "edoras: x: interrupted; everything before was read"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_may_not_be_written(call, rover, tmp_path):
    tmp_path.chmod(stat.S_IRUSR | stat.S_IXUSR)
    done = call("export", *rover, "--topic", "cmd_vel", "-o", tmp_path / "a.csv")
    assert (done.code, len(done.err)) == (1, 1)
    assert "Permission denied" in done.err[0]


def test_rosbag2_directories_are_read_by_topic(call, rover, tmp_path):
    bag = tmp_path / "bag"
    assert call("record", "-q", "-r", *rover, "--rosbag2", "-o", bag).code == 0
    assert call("export", bag, "--topic", "cmd_vel", "-o", tmp_path / "a.jsonl").code == 0
    assert len((tmp_path / "a.jsonl").read_text().splitlines()) == 600
    ci = "--link", "ci", "--msg-id", "0x1827"  # a command to Telemetry Output has a topic, too
    assert call("export", bag, *ci, "-o", tmp_path / "b.jsonl").code == 0
    assert (tmp_path / "b.jsonl").read_bytes() == (tmp_path / "a.jsonl").read_bytes()
    assert call("export", bag, *rover, "--topic", "cmd_vel", "-o", tmp_path / "c.jsonl").code == 0
    assert len((tmp_path / "c.jsonl").read_text().splitlines()) == 1200


def test_what_has_topics_only_is_not_chosen_from_by_link(call, rover, tmp_path):
    path = tmp_path / "bag"
    with Writer(path, version=9) as writer:
        store = get_typestore(Stores.ROS2_JAZZY)
        topic = writer.add_connection("/cmd_vel", "geometry_msgs/msg/Twist", typestore=store)
        writer.write(topic, 10**18, bytes([0, 1, 0, 0]) + bytes(48))
    done = call("export", path, "--link", "ci", "-o", tmp_path / "b.jsonl")
    assert (done.code, len(done.err)) == (2, 1)
    assert "--link and --msg-id select datagrams" in done.err[0]
    done = call("export", path, rover[0], "-o", tmp_path / "b.jsonl")
    assert (done.code, len(done.err)) == (2, 1)


@pytest.mark.long
def test_without_pyarrow_the_way_out_is_told(rover, tmp_path):
    code = "import sys; sys.modules['pyarrow'] = None; from edoras_tools.cli.main import *; run(program())"
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            code,
            "export",
            *map(str, rover),
            "--topic",
            "cmd_vel",
            "-o",
            tmp_path / "a.parquet",
        ],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert "pip install 'edoras-tools[analysis]', or write CSV or JSON Lines" in done.stderr
    assert not list(tmp_path.iterdir())
