"""``edoras plot`` as a shell sees it."""

import struct
from xml.etree import ElementTree as ET

import pytest
from mcap.writer import Writer


@pytest.fixture
def rover(captures, missions):
    return [captures("a_rover"), *missions("rover_ground")]


def test_in_the_terminal(call, rover):
    done = call("plot", *rover, "/cmd_vel.linear.x")
    assert (done.code, done.err) == (0, [])
    assert "/cmd_vel.linear.x" in done.out
    assert "⠒" in done.out
    assert "15 events" in done.out
    assert max(map(len, done.out.splitlines())) <= 100


@pytest.mark.quick("png")
@pytest.mark.parametrize("suffix", ["svg", "html", "png"])
def test_as_a_picture_that_is_replaced_only_by_force(call, rover, tmp_path, suffix):
    if suffix == "png":
        pytest.importorskip("resvg_py", reason="the extra plot is not installed")
    path = tmp_path / f"new/p.{suffix}"
    done = call("plot", *rover, "/cmd_vel.linear.*", "-o", path)
    assert (done.code, done.out) == (0, "")
    assert done.err[0].startswith(f"{path}: /cmd_vel.linear.*, 5 lines, ")
    data = path.read_bytes()
    if suffix == "svg":
        ET.fromstring(data)
    assert data.startswith({"svg": b"<svg", "html": b"<!DOCTYPE html>", "png": b"\x89PNG"}[suffix])
    done = call("plot", *rover, "/cmd_vel.linear.x", "-o", path)
    assert (done.code, path.read_bytes()) == (2, data)
    assert "exists; name another output, or replace it with --force" in done.err[0]
    assert call("plot", *rover, "/cmd_vel.linear.x", "-o", path, "--force", "-q").err == []
    assert path.read_bytes() != data


def test_json_holds_to_its_schema(call, rover):
    done = call("plot", *rover, "/cmd_vel.linear.x", "--json")
    told = done.json()
    assert [[line["label"] for line in panel["lines"]] for panel in told["panels"]] == [
        ["/cmd_vel.linear.x"],
        ["/cmd_vel", "/cmd_vel lost"],
    ]
    assert told["panels"][0]["lines"][0]["read"] == 600


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["/cmd_vel.linaer.x"], 2, "did you mean linear.x"),
        (["/cmd_vle.linear.x"], 1, "did you mean /cmd_vel?"),
        (["/edoras/events.msg"], 2, "holds text, not numbers"),
        (["/cmd_vel.linear.x", "--start", "90"], 1, "its times go from 0 to 65.270 s"),
        (["/cmd_vel.linear.x", "-o", "p.gif"], 2, ".gif is no picture; use .svg, .png or .html"),
        (["/cmd_vel.linear.x", "-o", "/proc/p.svg"], 1, "/proc/p.svg: cannot be written"),
        (["speed:/cmd_vel"], 2, "write /topic.field, rate:/topic or loss:/topic"),
        (["nothing.mcap"], 1, "nothing.mcap: there is no such file"),
    ],
)
def test_bad_input_is_one_line(call, rover, tmp_path, monkeypatch, arguments, code, words):
    monkeypatch.chdir(tmp_path)
    done = call("plot", *rover, *arguments)
    assert (done.code, len(done.err), done.out) == (code, 1, "")
    assert words in done.err[0]
    assert not list(tmp_path.iterdir())


def test_the_damage_of_a_recording_is_told_where_a_topic_is_not_there(call, rover, tmp_path):
    own, other, cut = tmp_path / "own.mcap", tmp_path / "other.mcap", tmp_path / "cut.mcap"
    assert call("record", *rover, "-o", own, "-q").code == 0
    with other.open("wb") as file:
        writer = Writer(file, chunk_size=256)
        writer.start("ros2")
        schema = writer.register_schema("std_msgs/msg/Int32", "ros2msg", b"int32 data")
        channel = writer.register_channel("/count", "cdr", schema)
        for number in range(100):
            writer.add_message(channel, number, struct.pack("<Ii", 1 << 8, number), number)
        writer.finish()
    for whole in (own, other):
        cut.write_bytes(whole.read_bytes()[:1000])
        for arguments in (
            ["plot", cut, "/nowhere.x"],
            ["export", cut, "--topic", "/nowhere", "-o", tmp_path / "x"],
        ):
            done = call(*arguments, "--force")
            assert (done.code, len(done.err)) == (1, 1)
            start = f"edoras: no topic of what can be read matches '/nowhere': {cut}: is cut off at byte "
            assert done.err[0].startswith(start)
    done = call("plot", other, "/nowhere.x")
    assert done.err == [f"edoras: no topic of {other} matches '/nowhere'; there are /count"]


def test_an_input_is_needed(call):
    done = call("plot", "/cmd_vel.linear.x")
    assert (done.code, done.err) == (2, ["edoras: name the input to plot: FILE... FIELD..."])
