from __future__ import annotations

import struct
import sys
from types import SimpleNamespace

import pytest

from edoras_tools.errors import ConfigError
from edoras_tools.render.svg import png

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
