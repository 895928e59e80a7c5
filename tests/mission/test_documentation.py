"""What docs/missions.md shows is what happens."""

from __future__ import annotations

import re

import pytest
from places import ROOT

from edoras_tools.errors import ConfigError
from edoras_tools.mission import loads

PAGE = (ROOT / "docs/missions.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)


def test_the_sample_shown_is_the_sample():
    assert (ROOT / "samples/missions/rover_ground.yaml").read_text().partition("\n")[2] == blocks("yaml")[0]


def test_the_mistakes_shown_are_the_mistakes():
    with pytest.raises(ConfigError) as caught:
        loads({"rover.yaml": blocks("yaml")[1].encode()})
    assert f"{caught.value}\n" == blocks("text")[0]


def test_the_program_shown_prints_what_is_shown(capsys, monkeypatch):
    monkeypatch.chdir(ROOT / "samples/missions")
    exec(compile(blocks("python")[0], "docs/missions.md", "exec"), {})
    assert capsys.readouterr().out == blocks("text")[1]
