"""``edoras sweep``: its words, its shapes and its exit codes."""

from __future__ import annotations

from xml.etree import ElementTree as ET

import pytest

from edoras_tools.errors import ConfigError
from edoras_tools.render.plot import svg


@pytest.mark.long
def test_json_has_the_promised_shape(call, missions):
    done = call("sweep", "/cmd_vel", *missions("rover_ground"), "--sim", "rover", "--json")
    found = done.json()
    assert (done.code, done.err) == (0, [])
    assert found.keys() >= {"route", "steps", "threshold_hz", "limiting_hop", "reason"}
    assert (found["route"], found["threshold_hz"], found["limiting_hop"]) == (
        "/cmd_vel",
        8,
        "EDORAS_APP_PIPE",
    )
    for step in found["steps"]:
        assert step.keys() >= {"rate_hz", "size", "sent", "delivered", "lost"}
        assert step["sent"] == step["delivered"] + step["lost"]


@pytest.mark.long
def test_people_see_a_table_a_chart_and_the_reason(call, missions, tmp_path):
    picture = tmp_path / "limit.svg"
    options = ("--sim", "two-rovers", "--rate", "6..12", "--step-time", "4s", "--svg", picture)
    done = call("sweep", "/robot_1/ground/pose", *missions("two_rovers_ground"), *options)
    assert done.code == 0
    for words in ("Delivered", "got through, messages/s", "between 8 and 9 Hz", "TO keeps 4 of this MsgId"):
        assert words in done.out
    assert "threshold between 8 and 9 Hz" in "".join(ET.fromstring(picture.read_text()).itertext())


def test_quiet_is_quiet(call, missions):
    options = ("--sim", "rover", "--rate", "2", "--step-time", "2s", "-q")
    done = call("sweep", "/cmd_vel", *missions("rover_ground"), *options)
    assert (done.code, done.out, done.err) == (0, "", [])


def test_a_dry_run_sends_nothing(call, missions):
    done = call("sweep", "/telemetry_pose", *missions("rover_ground"), "--dry-run")
    assert done.code == 0
    assert "would send  0x1801, 0x18f0" in done.out
    shape = call("sweep", "/telemetry_pose", *missions("rover_ground"), "--dry-run", "--json").json()
    assert shape["rates_hz"] == [1, 1000]


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        ("/nope --sim rover", 1, "'/nope' is not configured; there are /cmd_vel (0x1827, ci)"),
        ("0x2000 --sim rover", 1, "0x2000 is not a MsgId from 0x0001 to 0x1fff"),
        ("/cmd_vel --to sbn", 1, "/cmd_vel uses ci, not sbn"),
        ("/cmd_vel --to up", 2, "--to"),
        ("/cmd_vel --sim mars", 2, "--sim"),
        ("/cmd_vel --rate 5..2", 2, "'5..2' is not FROM..TO"),
        ("/cmd_vel --rate 0..2", 2, "'0..2' is not FROM..TO"),
        ("/cmd_vel --rate fast", 2, "'fast' is not FROM..TO"),
        ("/cmd_vel --rate 1..2 --size 80..90", 2, "only one range"),
        ("/cmd_vel --size 10..90", 2, "has 76 bytes"),
        ("/cmd_vel --limit 9", 2, "it needs --sim"),
        ("/cmd_vel --sim rover --target 127.0.0.1:5", 2, "--sim needs no --target"),
        ("/cmd_vel --sim rover --watch", 2, "with --sim there are none"),
        ("/cmd_vel --step-time 1s", 2, "at least 2s"),
        ("/cmd_vel --target 192.0.2.1:1234", 2, "nothing was sent; confirm the target with --yes"),
        ("/cmd_vel --target 192.0.2.1:1234 --rate 1..2000 -y", 2, "exceeds the limit of 1,000 Hz"),
        ("/cmd_vel --sim rover --allow 0x1828", 2, "not on the allow-list"),
        (
            "/cmd_vel --sim rover --rate 2 --svg /nowhere/at/all.svg",
            1,
            "/nowhere/at/all.svg: cannot be written",
        ),
    ],
)
def test_mistakes_are_one_clear_line(call, missions, options, code, words):
    done = call("sweep", *options.split(), *missions("rover_ground"))
    assert done.code == code
    assert len(done.err) == 1
    assert words in done.err[0]


def test_png_needs_resvg_and_says_so_before_the_sweep(call, missions, monkeypatch):
    def none():
        raise ConfigError("PNG needs resvg")

    monkeypatch.setattr(svg, "need_png", none)
    done = call("sweep", "/cmd_vel", *missions("rover_ground"), "--sim", "rover", "--png", "x.png")
    assert (done.code, done.out, done.err) == (2, "", ["edoras: PNG needs resvg"])
