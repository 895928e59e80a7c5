"""A plot as SVG, judged by an XML reader."""

from __future__ import annotations

import struct
import sys
from types import SimpleNamespace
from xml.etree import ElementTree as ET

import pytest

from edoras_tools.errors import ConfigError
from edoras_tools.render.plot.svg import PLOT_WIDTH, plot_svg, png

NAME = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module")
def root(figure):
    return ET.fromstring(plot_svg(figure))


def test_it_says_what_it_shows_and_loads_nothing(figure, root):
    text = " ".join(root.itertext())
    for words in (
        "/cmd_vel.linear.*",
        "x · bad",
        "messages/s",
        "3 events, 2 drawn",
        "seconds since",
        "a note",
    ):
        assert words in text
    assert "prefers-color-scheme:dark" in text
    assert "href" not in plot_svg(figure)
    assert "url(" not in plot_svg(figure)


def test_lines_stay_inside_and_keep_their_peak(root):
    lines = [item for item in root.iter(f"{NAME}path") if item.get("stroke-linejoin")]
    assert len(lines) == 3, "a line without values is not drawn"
    for item in lines:
        points = [tuple(map(float, point.split())) for point in item.get("d")[1:].split("L")]
        assert all(0 <= x <= PLOT_WIDTH for x, _ in points)
    wave = [float(point.split()[1]) for point in lines[0].get("d")[1:].split("L")]
    assert len(wave) < 5000
    assert min(wave) < sorted(wave)[1] - 50, "one value stands out"
    assert lines[1].get("stroke-dasharray"), "the second recording is dashed"


BOX = '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 30 20"><rect width="30" height="20"/></svg>'


def test_png_has_the_width_that_is_asked_for():
    pytest.importorskip("resvg_py", reason="the extra plot is not installed")
    image = png(BOX, 60)
    assert image[:8] == b"\x89PNG\r\n\x1a\n"
    assert struct.unpack(">2I", image[16:24]) == (60, 40)


@pytest.mark.parametrize(
    ("library", "told"),
    [
        (None, r"pip install 'edoras-tools\[plot\]', or write SVG"),
        (SimpleNamespace(svg_to_bytes=lambda **_: b"blank"), "install fonts-dejavu-core"),
    ],
)
def test_png_without_its_library_or_without_a_font_says_what_to_do(monkeypatch, library, told):
    monkeypatch.setitem(sys.modules, "resvg_py", library)
    with pytest.raises(ConfigError, match=told):
        png(BOX, 60)


def test_png_where_only_names_of_families_find_a_font(monkeypatch):
    """As in a container with fonts-dejavu-core and without fontconfig."""
    drawn = []

    def draw(*, svg_string, sans_serif_family="", **options):
        drawn.append(sans_serif_family)
        return b"text" if sans_serif_family == "DejaVu Sans" and "<text" in svg_string else b"blank"

    monkeypatch.setitem(sys.modules, "resvg_py", SimpleNamespace(svg_to_bytes=draw))
    assert png("<svg><text>W</text></svg>", 60) == b"text"
    assert drawn == ["", "", *["DejaVu Sans"] * 3]
