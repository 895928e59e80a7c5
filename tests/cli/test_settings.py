"""``edoras.toml``: where it is looked for, whose it may be, what it can set, and what counts more."""

import json
import os
import subprocess
import sys

import pytest
import typer
from places import ROOT

from edoras_tools import __version__
from edoras_tools.cli import main, settings
from edoras_tools.cli.options import OLD_NAMES

CAPTURE = ROOT / "samples/captures/a_rover.pcap"
MISSION = ROOT / "samples/missions/rover_ground.yaml"


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A folder with a repository, in a folder where a settings file is not looked for; the working folder."""
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.delenv("EDORAS_CONFIG", raising=False)
    monkeypatch.delenv("ROS_DISTRO", raising=False)
    folder = tmp_path / "project"
    (folder / ".git").mkdir(parents=True)
    monkeypatch.chdir(folder)
    return folder


def write(path, text=f"config = '{MISSION}'\n"):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path


def topics(done):
    return {row["topic"] for row in done.json()["routes"]} - {None}


def test_every_option_that_can_be_set_is_an_option_of_a_command():
    def options(command):
        inner = getattr(command, "commands", {}).values()
        return {name for item in command.params for name in item.opts}.union(*map(options, inner))

    every = options(typer.main.get_command(main.program()))
    named = {f"--{name}" for name in (*settings.SETTABLE, *settings.COMMAND_LINE_ONLY)}
    assert named <= {*every, *OLD_NAMES}
    assert set(settings.SETTABLE).isdisjoint(settings.COMMAND_LINE_ONLY)


@pytest.mark.parametrize("place", ["edoras.toml", "sub/edoras.toml", "sub/deep/edoras.toml"])
def test_found_upward_as_far_as_the_repository(place, project, call, monkeypatch):
    path = write(project / place)
    (project / "sub/deep").mkdir(parents=True, exist_ok=True)
    monkeypatch.chdir(project / "sub/deep")
    done = call("info", CAPTURE, "--json")
    assert topics(done) == {"/cmd_vel", "/telemetry_pose"}
    assert done.json()["settings"] == str(path)


@pytest.mark.parametrize("outside", ["..", "../home"])
def test_not_above_the_repository_nor_in_another_home(outside, project, call):
    write(project / outside / "edoras.toml")
    done = call("info", CAPTURE, "--json")
    assert topics(done) == set()
    assert "settings" not in done.json()


def test_as_far_as_home(tmp_path, project, call, monkeypatch):
    write(tmp_path / "edoras.toml")
    path = write(tmp_path / "home/edoras.toml")
    (tmp_path / "home/work").mkdir()
    monkeypatch.chdir(tmp_path / "home/work")
    assert call("info", CAPTURE, "--json").json()["settings"] == str(path)


def test_outside_of_both_only_in_the_working_folder(tmp_path, project, call, monkeypatch):
    write(tmp_path / "edoras.toml")
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path / "other")
    assert topics(call("info", CAPTURE, "--json")) == set()


def test_another_users_file_is_said_and_not_used(project, call, monkeypatch):
    path = write(project / "edoras.toml")
    monkeypatch.setattr(os, "geteuid", lambda: path.stat().st_uid + 1)
    done = call("info", CAPTURE, "--json")
    assert done.err == [
        f"edoras: {path} is not used: it belongs to another user; EDORAS_CONFIG={path} uses it all the same"
    ]
    assert topics(done) == set()
    monkeypatch.setenv("EDORAS_CONFIG", str(path))
    assert topics(call("info", CAPTURE, "--json"))


def test_with_sudo_the_file_of_the_calling_user(project, call, monkeypatch):
    owner = write(project / "edoras.toml").stat().st_uid
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    monkeypatch.setenv("SUDO_UID", str(owner))
    assert topics(call("info", CAPTURE, "--json"))


def test_a_file_that_all_can_write_is_not_used(project, call):
    path = write(project / "edoras.toml")
    path.chmod(0o666)
    done = call("info", CAPTURE, "--json")
    assert topics(done) == set()
    assert done.err == [f"edoras: {path} is not used: every user can write to it; change that with chmod o-w"]


def test_the_command_line_counts_more(project, call):
    write(project / "edoras.toml", "config = 'nowhere.yaml'\nport = 'ci:99'\n")
    assert topics(call("info", CAPTURE, "-c", MISSION, "--json")) == {"/cmd_vel", "/telemetry_pose"}


def test_paths_start_at_the_file(project, call, monkeypatch):
    write(project / "missions/rover.yml", MISSION.read_text(encoding="utf-8"))
    write(project / "missions/expect.yaml", "schema: 1\n")
    write(project / "edoras.toml", "config = ['missions']\n")
    (project / "runs").mkdir()
    monkeypatch.chdir(project / "runs")
    done = call("info", CAPTURE, "--json")
    assert topics(done) == {"/cmd_vel", "/telemetry_pose"}
    assert done.err == [
        f"edoras: {project}/missions/expect.yaml: left out: not a parameter file of ROS 2",
    ]


def test_a_table_is_for_one_command(project, call):
    write(project / "edoras.toml", f"[info]\nconfig = '{MISSION}'\n[sniff]\nverbose = true\n")
    assert topics(call("info", CAPTURE, "--json"))
    done = call("sniff", CAPTURE, "-n", 3)
    python = ".".join(map(str, sys.version_info[:3]))
    assert done.err[:2] == [
        f"edoras: edoras-tools {__version__}, Python {python}",
        f"edoras: settings: {project}/edoras.toml",
    ]
    assert "/cmd_vel" not in done.out


def test_every_command_says_with_v_what_it_works_with(project, call):
    write(project / "edoras.toml", f"config = '{MISSION}'\n")
    for words in (
        ["info", CAPTURE],
        ["decode", CAPTURE, 1],
        ["wireshark", "print"],
        ["xtce"],
        ["doctor", CAPTURE],
    ):
        assert call(*words, "-v").err[1:3] == [
            f"edoras: settings: {project}/edoras.toml",
            f"edoras: missions: {MISSION}",
        ]
        assert not any(line.startswith("edoras: settings") for line in call(*words).err)
    (project / "edoras.toml").unlink()
    assert call("help", "-v").err[1] == "edoras: settings: no edoras.toml"


def test_commands_of_a_group_take_it_too(project, call):
    write(project / "edoras.toml", f"[wireshark]\nconfig = '{MISSION}'\n")
    assert "telemetry_pose" in call("wireshark", "print").out


@pytest.mark.long
def test_programs_of_one_command_take_it_too(project):
    path = write(project / "edoras.toml", f"verbose = true\n[sniff]\nconfig = '{MISSION}'\n")
    program = os.path.join(os.path.dirname(sys.executable), "edoras-sniff")  # noqa: PTH118, PTH120
    done = subprocess.run(
        [program, CAPTURE, "--topic", "/cmd_vel", "-n", "40"], capture_output=True, text=True, check=True
    )
    assert f"settings: {path}" in done.stderr
    assert "/cmd_vel" in done.stdout


MISTAKES = [
    (
        "yes = true",
        "yes: only for the command line; a file cannot send, listen",
    ),
    ("listen = ['5000']", "listen: only for the command line"),
    ("[live]\nallow-publish = ['*']", "live.allow-publish: only for the command line"),
    ("confg = 'x'", "confg: not known here; did you mean config?"),
    ("nothing_like_it = 1", "nothing_like_it: not known here; known are color, config, distro, "),
    ("[sniffle]\nquiet = true", "[sniffle]: no such command; did you mean sniff?"),
    ("quiet = [true]", "quiet: one value is needed"),
    ("config = [['a']]", "config: a text or a list of texts is needed"),
    ("port = 'ci'", "edoras.toml: 'ci' is not LINK:PORT"),
    ("port = 'ci:5", "(at end of document); correct it"),
    ("a = " + "[" * 5000, ""),
]


@pytest.mark.parametrize(("text", "said"), MISTAKES)
def test_mistakes(text, said, project, call):
    path = write(project / "edoras.toml", text)
    done = call("info", CAPTURE)
    assert done.code == 2
    (line,) = done.err
    assert str(path) in line
    assert said in line


def test_mistakes_are_reported_all_at_once(project, call):
    write(project / "edoras.toml", "yes = true\n[sniff]\nall = true\n")
    assert [line.partition(".toml: ")[2].partition(":")[0] for line in call("info", CAPTURE).err] == [
        "yes",
        "sniff.all",
    ]


@pytest.mark.parametrize("name", ["nowhere.toml", "folder"])
def test_a_variable_that_names_no_file(name, project, call, monkeypatch):
    (project / "folder").mkdir()
    monkeypatch.setenv("EDORAS_CONFIG", name)
    done = call("info", CAPTURE, "--json")
    assert done.code == 2
    error = json.loads(done.err[0])["error"]
    assert name in error["message"]
    assert error["hint"] == "EDORAS_CONFIG names a file like edoras.toml"


def test_help_needs_no_settings(project, call, monkeypatch):
    monkeypatch.setenv("EDORAS_CONFIG", "nowhere.toml")
    assert call("info", "--help").code == 0
    assert call("help", "info").code == 0
