"""What docs/missions.md shows is what happens."""

from __future__ import annotations

import re

import pytest
from places import ROOT

from edoras_tools.errors import ConfigError
from edoras_tools.mission import loads

PAGE = (ROOT / "docs/missions.md").read_text()
MISTAKEN = b"""conversion_node:
  ros__parameters:
    communication:
      bridge_port: 1235
      fsw_port: "1234"
      fsw_ip: cfs.local
      telemetry_ip: 0.0.0.0
    command: ['cmd_twist', 'cmd_pose']
    telemetry: ['tlm_pose']
    cmd_twist:
      type: geometry_msgs/Twist
      topic: cmd_vel
      mid: 1e3
    tlm_pose:
      type: geometry_msgs/msg/PoseStamped
      topic: cmd_vel
      mid: 0x2827
"""


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)


def test_the_sample_shown_is_the_sample():
    assert (ROOT / "samples/missions/rover_ground.yaml").read_text().partition("\n")[2] == blocks("yaml")[0]


def test_the_mistakes_shown_are_the_mistakes():
    with pytest.raises(ConfigError) as caught:
        loads({"rover.yaml": MISTAKEN})
    assert f"{caught.value}\n" == blocks("text")[0]


def test_the_program_shown_prints_what_is_shown(capsys, monkeypatch):
    monkeypatch.chdir(ROOT / "samples/missions")
    program = blocks("python")[0]
    exec(compile(program, "docs/missions.md", "exec"), {})
    assert program.endswith(f")  # {capsys.readouterr().out}")
