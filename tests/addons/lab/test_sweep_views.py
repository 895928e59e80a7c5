"""What a sweep found as people see it: the table, the chart in cells and as SVG, and the limit in words."""

from __future__ import annotations

import io
from xml.etree import ElementTree as ET

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from edoras_tools.addons.lab import views
from edoras_tools.render.plot.figure import ticks
from edoras_tools.render.plot.svg import plot_svg
from edoras_tools.render.plot.terminal import plot_lines

SUMMARY = {
    "route": "/cmd_vel",
    "msg_id": "0x1827",
    "type": "geometry_msgs/msg/Twist",
    "link": "ci",
    "to_cfs": True,
    "emulated": "rover",
    "swept": "rate",
    "steps": [
        {"rate_hz": 16, "size": 76, "sent": 128, "delivered": 90, "lost": 38, "hop": "EDORAS_APP_PIPE"},
        {"rate_hz": 8, "size": 76, "sent": 64, "delivered": 64, "lost": 0, "hop": None},
        {"rate_hz": 9, "size": 76, "sent": 72, "delivered": 67, "lost": 5, "hop": "EDORAS_APP_PIPE"},
    ],
    "threshold_hz": 8,
    "first_loss_hz": 9,
    "threshold_bytes": None,
    "first_loss_bytes": None,
    "limiting_hop": "EDORAS_APP_PIPE",
    "reason": "EDORAS_APP_PIPE limit 4 per 500 ms wake-up of CI_LAB_APP",
    "interrupted": False,
    "notes": ["a note"],
}
BY_SIZE = {
    **SUMMARY,
    "swept": "size",
    "steps": [{**step, "rate_hz": 2, "size": 100 * step["rate_hz"]} for step in SUMMARY["steps"]],
    "threshold_hz": None,
    "first_loss_hz": None,
    "threshold_bytes": 800,
    "first_loss_bytes": 900,
}


def shown(summary, width=80):
    console = Console(width=width, file=io.StringIO(), color_system=None)
    console.print(views.sweep_outcome(summary, width))
    return [line.rstrip() for line in console.file.getvalue().splitlines()]


def test_steps_stand_in_order_and_the_limit_in_words():
    lines = shown(SUMMARY)
    assert [line.split()[0] for line in lines[1:4]] == ["8", "9", "16"]
    assert lines[2].split() == ["9", "Hz", "76", "B", "72", "67", "5", "6.9", "%", "EDORAS_APP_PIPE"]
    assert "threshold     between 8 and 9 Hz" in lines
    assert "reason        EDORAS_APP_PIPE limit 4 per 500 ms wake-up of CI_LAB_APP" in lines
    assert "note          a note" in lines
    assert max(len(line) for line in lines) <= 80


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, "between 8 and 9 Hz"),
        ({"threshold_hz": None}, "below 9 Hz: the lowest that was tried lost something"),
        ({"threshold_hz": None, "first_loss_hz": None}, "none found: nothing was lost up to 16 Hz"),
        ({"threshold_hz": None, "first_loss_hz": None, "steps": []}, "none found"),
    ],
)
def test_the_threshold_in_words(changes, words):
    assert views.threshold_line({**SUMMARY, **changes}) == words


def test_sizes_have_their_own_words():
    assert views.threshold_line(BY_SIZE) == "between 800 and 900 bytes"
    clean = views.chart(BY_SIZE).panels[0].lines[2]
    assert (clean.label, clean.seconds.tolist(), clean.values.tolist()) == ("all arrived", [800], [100])


def test_a_sweep_that_has_no_step_yet():
    lines = shown({**SUMMARY, "steps": [], "threshold_hz": None, "first_loss_hz": None, "limiting_hop": None})
    assert lines[0].startswith("route")


def test_the_chart_in_cells():
    lines = [str(line) for line in plot_lines(views.chart(SUMMARY), 60, colour=False)]
    assert max(len(line) for line in lines) <= 60
    assert lines[1] == "━ what was asked for  ━ threshold  ● all arrived"
    field = lines[3:13]
    assert sum(line.count("●") for line in field) == 1
    assert sum(line.count("✗") for line in field) == 2
    # What is asked for goes up to the right; what gets through does not.
    assert not field[0].rstrip().endswith(("●", "✗"))
    heights = [index for index, line in enumerate(field) for mark in line if mark in "●✗"]
    assert max(heights) - min(heights) <= 3
    assert lines[-1].strip() == "asked for, messages/s"


@given(st.floats(1e-3, 1e6))
def test_ticks_are_few_round_and_inside(end):
    found = ticks(end)
    assert 2 <= len(found) <= 6 + 1
    assert found[0] == 0
    assert found[-1] <= end * (1 + 1e-6)


@given(
    st.lists(st.tuples(st.integers(1, 65535), st.floats(0, 1)), min_size=1, max_size=20),
    st.integers(40, 200),
)
def test_any_sweep_can_be_drawn(pairs, width):
    steps = [
        {
            "rate_hz": rate,
            "size": 1,
            "sent": 1000,
            "delivered": int(1000 * share),
            "lost": share < 1,
            "hop": "",
        }
        for rate, share in pairs
    ]
    drawn = views.chart({**SUMMARY, "steps": steps})
    assert all(len(line) <= width for line in plot_lines(drawn, width, colour=True))
    ET.fromstring(plot_svg(drawn))


def test_svg_stands_alone_and_is_escaped():
    text = plot_svg(views.chart({**SUMMARY, "route": "/a<b>&c"}, "threshold <here>"))
    root = ET.fromstring(text)
    assert "/a<b>&c, 0x1827" in "".join(root.itertext())
    dots = [item for item in root if item.get("stroke-linecap") == "round" and "M" in item.get("d")]
    assert (
        sum(item.get("d").count("h0") for item in dots) == 3 + 2 + 4
    )  # each step, two in the legend, ends of lines
    assert "href" not in text
    assert "@font-face" not in text
