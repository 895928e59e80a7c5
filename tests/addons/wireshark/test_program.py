"""``edoras wireshark``: what it installs, runs and prints, and what it says where Wireshark will not do."""

import os
import re
import stat
import subprocess
import sys
from pathlib import Path

import here
import pytest
from effort import every
from looking import contrast
from places import ROOT

from edoras_tools.addons.wireshark import program as wireshark_program

CAPTURE = ROOT / "samples/captures/a_rover.pcap"
MISSION = ROOT / "samples/missions/rover_ground.yaml"


def edoras(capfd, *arguments):
    """Run ``edoras``; return its exit code, output and complaints."""
    before, sys.argv = sys.argv, ["edoras", *map(str, arguments)]
    try:
        with pytest.raises(SystemExit) as ended:
            here.edoras()
    finally:
        sys.argv = before
    out, err = capfd.readouterr()
    said = [line for line in err.splitlines() if line and "Running as user" not in line]
    return ended.value.code, out, said


def pretend(folder, monkeypatch, name, script):
    """Put a program of that name in front of all others."""
    path = folder / name
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", str(folder))


def test_print_and_path(capfd):
    code, out, said = edoras(capfd, "wireshark", "print")
    assert (code, said) == (0, [])
    assert out == (ROOT / "dissectors/edoras.lua").read_text()
    code, where, _ = edoras(capfd, "wireshark", "path")
    assert Path(where.strip()).read_text() == out
    _, other, _ = edoras(capfd, "wireshark", "print", "-c", MISSION)
    assert other != out
    assert "Routes of rover_ground.yaml" in other


def test_install_to_a_folder(capfd, tmp_path):
    code, out, said = edoras(capfd, "wireshark", "install", "--to", tmp_path / "new", "-c", MISSION)
    assert (code, out.strip(), said) == (0, str(tmp_path / "new/edoras.lua"), [])
    assert "Routes of rover_ground.yaml" in (tmp_path / "new/edoras.lua").read_text()


def test_install_where_wireshark_looks(capfd, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    code, out, said = edoras(capfd, "wireshark", "install")
    assert (code, said) == (0, [])
    script, profile = map(Path, out.splitlines())
    assert script.is_relative_to(tmp_path)
    words = ("tshark", "-C", profile.name, "-r", ROOT / "samples/captures/e_ci_errors.pcap", "-c", "400")
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert "0x0803 SB_HK pipe overflow 0, message limit 8" in done.stdout
    colours = subprocess.run([*words, "--color"], capture_output=True, text=True, check=True)
    assert "compile" not in done.stderr + colours.stderr
    filters = [line.split("@")[2:] for line in (profile / "colorfilters").read_text().splitlines()[1:]]
    buttons = [
        [part.replace("\\x22", '"') for part in re.findall(r'"([^"]*)"', line)]
        for name in ("dfilter_buttons", "io_graphs")
        for line in (profile / name).read_text().splitlines()[1:]
    ]
    every_filter = {item[0] for item in filters} | {item[2] for item in buttons}
    shown = " or ".join(f"({item})" for item in sorted(every_filter))  # refused if a field is not known
    assert subprocess.run([*words, "-Y", shown], capture_output=True, text=True, check=True).stdout
    for _, colours in filters:
        ground, ink = (
            [int(part) // 257 for part in item.split(",")] for item in re.findall(r"[\d,]{5,}", colours)
        )
        assert contrast(ground, ink) >= 4.5, colours
    assert len({item[3] for item in buttons[9:]}) == len(buttons[9:]) == 9  # no colour of a graph twice


def test_a_profile_of_the_user_is_kept_and_ours_goes(capfd, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    profile = tmp_path / ".config/wireshark/profiles/EDORAS"
    profile.mkdir(parents=True)
    (profile / "preferences").write_text("mine")
    code, out, said = edoras(capfd, "wireshark", "install", "--force")
    assert (code, len(out.splitlines()), len(said)) == (0, 1, 1)
    assert "is another profile of that name, or was changed since, and is kept" in said[0]
    code, out, said = edoras(capfd, "wireshark", "uninstall")
    assert (code, out.strip().endswith("edoras.lua"), len(said)) == (0, True, 1)
    assert [path.read_text() for path in profile.iterdir()] == ["mine"]
    (profile / "preferences").unlink()
    profile.rmdir()
    assert wireshark_program.install_profile() == (profile, True)
    (profile / "recent").write_text("written by Wireshark itself")
    assert wireshark_program.install_profile() == (profile, True)  # once more: nothing to say
    assert [*wireshark_program.uninstall()] == [(profile, True)]
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


@pytest.mark.long
def test_run_passes_arguments_and_exit_codes_on(capfd):
    wanted = ["-Y", "edoras.msg_id == 0x0827 and ros2.geometry_msgs.PoseStamped.pose.position.x > 6"]
    code, out, said = edoras(capfd, "wireshark", "run", "-r", CAPTURE, "-c", MISSION, "--", *wanted)
    assert (code, said) == (0, [])
    assert len(out.splitlines()) == 3
    assert "/telemetry_pose  pose.position.x=6.3" in out
    code, _, said = edoras(capfd, "wireshark", "run", "-r", CAPTURE, "--", "-Y", "nonsense")
    assert code == 2
    assert "nonsense" in said[0]


@pytest.mark.long
def test_run_reads_recordings(capfd, tmp_path):
    recording = tmp_path / "a.mcap"
    assert edoras(capfd, "record", "-q", "-r", CAPTURE, "-c", MISSION, "-o", recording)[0] == 0
    code, out, _ = edoras(capfd, "wireshark", "run", "-r", recording, "--", "-Y", "ros2.geometry_msgs.Twist")
    assert code == 0
    assert len(out.splitlines()) == 600


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["run", "-r", "nope.pcap"], 1, "nope.pcap"),
        (["print", "-c", "nope.yaml"], 2, "nope.yaml"),
        (["print", "--envelope", "9/9"], 2, "9/9"),
        (["install", "--to", "/dev/null/here"], 1, "cannot be written"),
        (["extcap", "install", "--to", "/dev/null/here"], 1, "WIRESHARK_EXTCAP_DIR"),
    ],
)
def test_mistakes_are_one_line(arguments, code, words, capfd):
    ended, _, said = edoras(capfd, "wireshark", *arguments)
    assert (ended, len(said)) == (code, 1)
    assert words in said[0]


@pytest.mark.parametrize(
    ("script", "words"),
    [
        ("echo 'TShark (Wireshark) 2.6.20 (Git)'; echo 'with Lua 5.2.4'", "2.6.20 is too old; 3.6 or newer"),
        ("echo 'TShark (Wireshark) 4.2.1.'; echo 'with GnuTLS, without Lua'", "4.2.1 was built without Lua"),
        ("echo hello", "does not print its version"),
    ],
)
def test_a_wireshark_that_will_not_do(script, words, capfd, tmp_path, monkeypatch):
    pretend(tmp_path, monkeypatch, "tshark", script)
    for arguments in (["install"], ["run", "-r", CAPTURE], ["extcap", "install"]):
        code, _, said = edoras(capfd, "wireshark", *arguments)
        assert (code, len(said)) == (1, 1)
        assert words in said[0]


def test_no_wireshark_at_all(capfd, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    for arguments in (["install"], ["run", "-r", CAPTURE]):
        code, _, said = edoras(capfd, "wireshark", *arguments)
        assert (code, len(said)) == (1, 1)
        assert "tshark" in said[0]
        assert "is not installed" in said[0]
    code, out, _ = edoras(capfd, "wireshark", "install", "--to", tmp_path)  # needs nobody to ask
    assert (code, out.strip()) == (0, str(tmp_path / "edoras.lua"))


def test_newer_versions_are_fine(tmp_path, monkeypatch):
    pretend(tmp_path, monkeypatch, "tshark", "echo 'TShark (Wireshark) 10.0.0.'; printf 'with\\n Lua 5.4.6'")
    assert wireshark_program.find_program("tshark") == str(tmp_path / "tshark")


@pytest.mark.long
def test_the_page_shows_what_tshark_says():
    """Commands on files, as docs/wireshark.md shows them; columns may be laid out otherwise."""
    page = (ROOT / "docs/wireshark.md").read_text()
    blocks = re.findall(r"^```shell\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    shown = re.findall(r"^\$ (.* -r .*)\n((?:[^$].*\n)*)", "".join(blocks), re.MULTILINE)
    ours = Path(sys.executable).parent
    assert len(shown) > 3
    for command, output in every(5, shown):
        done = subprocess.run(
            command,
            shell=True,
            cwd=ROOT,
            env=os.environ | {"PATH": f"{ours}{os.pathsep}{os.environ['PATH']}"},
            capture_output=True,
            text=True,
            check=True,
        )
        said = [line.split() for line in done.stdout.splitlines()]
        assert said == [line.split() for line in output.splitlines()], command


def test_the_page_s_captures_hand_their_arguments_on(capfd, tmp_path, monkeypatch):
    """Commands that capture are not run, but for a tshark that says what it was given."""
    page = (ROOT / "docs/wireshark.md").read_text()
    captures = re.findall(r"^\$ edoras (wireshark run (?!.*-r ).*)$", page, re.MULTILINE)
    assert captures
    pretend(tmp_path, monkeypatch, "tshark", """echo 'TShark (Wireshark) 4.0.0.'; echo 'with Lua' "$@" """)
    for command in captures:
        code, out, said = edoras(capfd, *command.split())
        assert (code, said) == (0, []), command
        assert out.splitlines()[-1].endswith(command.partition(" -- ")[2])
