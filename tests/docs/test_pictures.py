"""The pictures show what the commands show: `python docs/make_pictures.py` after a change that is meant."""

from __future__ import annotations

from xml.etree import ElementTree as ET

import pytest
from effort import long_but
from places import ROOT

FOLDER = ROOT / "docs/pictures"
NAMES = sorted(path.stem for path in FOLDER.glob("*.svg"))
ALIKE = ("tui_routes", "tui_sequence", "tui_small")
"""More of the three-pane view, for ``make long``."""


def words(svg):
    """Return what a picture says; how it is drawn is up to the version of rich."""
    return [text for text in ("".join(ET.fromstring(svg).itertext())).replace("\xa0", " ").split() if text]


@pytest.mark.each(3)
@pytest.mark.long("tui", "tui_rates", "tui_filter")
@pytest.mark.parametrize("name", long_but([name for name in NAMES if name not in ALIKE], NAMES))
def test_the_picture_says_what_the_command_says(name, make_pictures):
    svg = (FOLDER / f"{name}.svg").read_text()
    drawn = [word for word in words(svg) if "{" not in word and ";" not in word]
    assert drawn == [
        word for word in words(make_pictures.PICTURES[name]()) if "{" not in word and ";" not in word
    ]


def test_there_are_no_others(make_pictures):
    assert {*NAMES} == {*make_pictures.PICTURES}
    # These are of a moment, so they are not compared: docs/make_page_picture.py, and Wireshark itself
    pictures = {path.name for path in FOLDER.iterdir() if path.suffix != ".svg"}
    assert pictures == {"live_page.png", "wireshark.png"}


@pytest.mark.parametrize("name", NAMES)
def test_a_picture_loads_nothing(name):
    text = (FOLDER / f"{name}.svg").read_text()
    assert "@font-face" not in text
    assert "href" not in text


def test_long_lines_are_cut(make_pictures):
    svg = make_pictures.terminal_picture(["x" * 100, "[red]y"], width=20, title="t")
    text = "".join(ET.fromstring(svg).itertext())
    assert "x" * 20 in text
    assert "x" * 21 not in text
    assert "[red]y" in text
