"""The demos at the command line."""

from __future__ import annotations

import json
import sys

import pytest
from schema import held

WRONG = {
    ("--state-rate", "5"): (2, "--state-rate needs two-rovers or two-arms"),
    ("-o", "a.txt"): (2, "a.txt: unknown suffix"),
    ("-o", "/proc/none/a.mcap"): (1, "/proc/none/a.mcap: cannot be created: No such file or directory"),
    ("--ros-option", "a"): (2, "'a' is not NAME=VALUE"),
    ("--ros-option", "a=b"): (2, "--ros local has no option 'a'"),
    ("--ros", "carrier"): (2, "carrier"),
    ("--duration", "soon"): (2, "'soon' is not a duration"),
    ("--rate", "-1"): (2, "--rate"),
    ("--distro", "nice"): (2, "nice"),
}


@pytest.mark.parametrize("arguments", WRONG, ids=" ".join)
def test_what_is_wrong_is_one_line(call, tmp_path, monkeypatch, arguments):
    monkeypatch.chdir(tmp_path)
    result = call("demo", "rover", "--duration", "50ms", *arguments)
    code, part = WRONG[arguments]
    assert (result.code, result.out) == (code, "")
    assert len(result.err) == 1, result.err
    assert part in result.err[0]
    assert list(tmp_path.iterdir()) == []


def test_an_absent_library_is_told_with_what_to_install(call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "websockets", None)
    result = call("demo", "rover", "--live", "--ws-port", "0")
    assert result.code == 2
    assert "pip install 'edoras-tools[live]'" in result.err[0]


def test_it_reports_in_json_and_leaves_its_files_here(edoras, tmp_path):
    result = edoras("demo", "arm", "--seconds", "1", "--json", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    summary = held(json.loads(result.stdout), ["demo", "--json"])
    assert (summary["demo"], summary["ros"], summary["lost"]) == ("arm", "local", 0)
    assert summary["output"] == "arm.mcap"
    assert {item.name for item in tmp_path.iterdir()} == {"arm.mcap", "arm_layout.json"}
    (robot,) = summary["robots"]
    assert robot["robot"] == "arm"
    assert (robot["commands"]["from"], robot["states"]["to"]) == ("/command_pose", "/telemetry_joint_state")


def test_it_tells_what_happened_and_what_to_do_next(call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = call("demo", "two-rovers", "-o", "there.mcap", "--duration", "1", "--rate", "0")
    assert result.code == 0
    assert result.err[0] == "emulated two-rovers, recorded to there.mcap; Ctrl-C ends"
    assert result.err[1].startswith("in another terminal: edoras sniff -i lo --set port=ci:")
    for part in ("edoras doctor there.mcap", "there_layout.json", "/robot_2/pose → /robot_2/ground/pose"):
        assert part in result.out
    quiet = call("demo", "rover", "--duration", "100ms", "-q")
    assert (quiet.code, quiet.out, quiet.err) == (0, "", [])


@pytest.mark.long
def test_the_commands_of_the_tour_name_files_that_are_there(call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = call("demo", "-o", "tour", "--duration", "600ms")
    assert result.code == 0
    lines = [line.strip() for line in result.out.splitlines()]
    commands = [line.split()[2:] for line in lines if line.startswith("$ edoras ")]
    assert [words[0] for words in commands] == ["sniff", "decode", "info", "record"]
    named = [word for words in commands for word in words if word.startswith("tour/")]
    assert len(named) == 7
    assert [name for name in named if not (tmp_path / name).is_file()] == []
    for words in commands[1:3]:
        assert call(*words).code == 0
