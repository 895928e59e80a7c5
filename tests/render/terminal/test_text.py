from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.render.terminal.text import (
    cells,
    clean,
    clip,
    clip_left,
    clip_middle,
    fit,
    fit_right,
    plain_cells,
    wrap,
)

anything = st.text(st.characters(exclude_categories=()), max_size=60)


@pytest.mark.parametrize(
    ("raw", "harmless"),
    [
        ("plain 你好", "plain 你好"),
        ("\x1b[2J", r"\x1b[2J"),
        ("a\r\n\tb\0", r"a\r\n\tb\0"),
        ("\u202eevil", r"\u202eevil"),
        ("\x9b31m", r"\x9b31m"),
        ("👩\u200d🚀 ❤\ufe0f", "👩\\u200d🚀 ❤\\ufe0f"),
        ("\ud800", r"\ud800"),
        ("\U000e0041", r"\U000e0041"),
    ],
)
def test_clean_escapes_what_drives_a_terminal(raw, harmless):
    assert clean(raw) == harmless


@given(anything)
def test_clean_text_is_printable_and_stays_clean(text):
    assert clean(text).isprintable()
    assert clean(clean(text)) == clean(text)
    clean(text).encode()


@given(anything.map(clean), st.integers(0, 70))
def test_cuts_keep_the_width(text, width):
    for cut in (clip, clip_left, clip_middle):
        assert cells(cut(text, width)) <= width
        assert cut(text, cells(text)) == text
    for pad in (fit, fit_right):
        assert cells(pad(text, width)) == width


@given(anything.map(clean), st.integers(2, 70))
def test_wrap_keeps_the_width_and_every_character(text, width):
    lines = wrap(text, width)
    assert all(cells(line) <= width for line in lines)
    assert "".join(lines).replace(" ", "") == text.replace(" ", "")


@pytest.mark.parametrize(
    ("cut", "expected"), [(clip, "/robot_1/…"), (clip_left, "…d/cmd_vel"), (clip_middle, "/ro…md_vel")]
)
def test_cuts_show_where(cut, expected):
    assert cut("/robot_1/ground/cmd_vel", 10) == expected


def test_plain_cells_leaves_styles_out():
    assert plain_cells("\x1b[1;36mab\x1b[0m你") == 4


def test_no_line_breaks_between_a_number_and_its_unit():
    assert wrap("from 29.5 to 35.3 s, 2.6 % of it", 17) == ["from 29.5 to", "35.3 s, 2.6 % of", "it"]
