"""Looks at what people see: labels, colours, contrast, figures, widths, and what a screen reader is told."""

from __future__ import annotations

import io
import re
from importlib.resources import files

import pytest
from looking import contrast, labels, overlaps, paint_of, rgb, svgs, themes
from places import ROOT
from plotted import figure  # noqa: F401  a fixture
from rich.console import Console

from edoras_tools.addons.archive.views import ArchiveTrends, answer_table, archive_page
from edoras_tools.addons.plot.series import open_recordings, read_plot
from edoras_tools.addons.report.charts import plots
from edoras_tools.addons.report.page import page
from edoras_tools.addons.runs.views import check_view, runs_view
from edoras_tools.addons.trace.views import standalone
from edoras_tools.io.formats.open import open_file
from edoras_tools.pipelines.capture.info import inspect
from edoras_tools.pipelines.doctor import Scope, examine
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.render.capture.info import capture_summary
from edoras_tools.render.doctor import screen
from edoras_tools.render.pages import BOTTOM, TOP, Origin
from edoras_tools.render.plot.figure import DARK_COLOURS, LIGHT_COLOURS
from edoras_tools.render.plot.svg import plot_svg
from edoras_tools.render.plot.terminal import plot_lines

STYLE = (files("edoras_tools.render") / "pages.css").read_text()
PLOT_STYLE = (files("edoras_tools.render.plot") / "page.css").read_text()
ROVER = ROOT / "samples/captures/a_rover.pcap"
SETTINGS = Settings((ROOT / "samples/missions/rover_ground.yaml",))
ORIGIN = Origin("edoras report a_rover.pcap", 0)


@pytest.fixture(scope="module")
def diagnosis():
    return examine(open_file(ROVER), SETTINGS.workbench()).diagnosis


@pytest.fixture(scope="module")
def plot():
    return read_plot(open_recordings([ROVER], SETTINGS, Scope()), ["a_rover.pcap"], [], Scope())


def archive():
    """Return an archive of 70 runs and four topics, each with another share missing."""
    runs = [
        {"capture": f"run_{place:02}.mcap", "start_ns": place * 10**13, "datagrams": 9, "worst": "error"}
        | {"lost": place, "unaccounted": 0, "sent": 100}
        for place in range(1, 71)
    ]
    routes = [
        {"route": f"/topic_{place}", "link": "to", "captures": 70, "with_loss": 60}
        | {"sent": 7000, "lost": 9, "unaccounted": 0}
        for place in range(4)
    ]
    shares = [
        {"capture": run["capture"], "start_ns": run["start_ns"], "route": route["route"], "link": "to"}
        | {"sent": 1000, "missing": (place * 7 + number * 300) % 1000 if place % 9 else 0}
        for place, run in enumerate(runs[-60:])
        for number, route in enumerate(routes)
    ]
    trends = [
        (route, [{"bin": place, "sent": 100, "missing": place} for place in range(50)]) for route in routes
    ]
    totals = {
        "captures": 70,
        "datagrams": 630,
        "seconds": 700.0,
        "with_loss": 60,
        "lost": 36,
        "unaccounted": 0,
    }
    totals |= {"start_ns": 10**13, "end_ns": 70 * 10**13}
    return ArchiveTrends("archive.duckdb", totals, runs, routes, shares, trends, [], [], [])


@pytest.fixture(scope="module")
def pages(diagnosis):
    return {"report": page(diagnosis, "a_rover.pcap", ORIGIN), "archive": archive_page(archive(), ORIGIN)}


@pytest.mark.parametrize("letters", [11, 23], ids=["desktop", "phone"])
@pytest.mark.parametrize("name", ["report", "archive"])
def test_no_label_covers_another_and_none_is_cut(pages, name, letters):
    for svg in svgs(pages[name]):
        found = labels(svg, 11 if svg.get("class") == "wide" else letters)
        width, height = map(float, svg.get("viewBox").split()[2:])
        assert overlaps(found) == [], svg.get("aria-label")[:60]
        assert [
            item.text for item in found if item.left < 0 or item.right > width or item.bottom > height
        ] == []


def test_no_label_of_a_plot_covers_another(plot, figure):  # noqa: F811
    for drawn in (plot.figure, figure):
        (svg,) = svgs(plot_svg(drawn))
        assert overlaps(labels(svg, 14)) == []


def test_no_data_is_drawn_over_a_limit_s_name(pages):
    named = [svg for svg in svgs(pages["report"]) if any("clean to" in item.text for item in labels(svg, 11))]
    assert named
    for svg in named:
        (label,) = (item for item in labels(svg, 11) if "clean to" in item.text)
        bars = " ".join(item.get("d") for item in svg.iter("path"))
        assert min(float(number) for number in re.findall(r"V([\d.]+)", bars)) > label.bottom


@pytest.mark.parametrize("name", ["report", "archive"])
def test_a_key_has_each_colour_once_and_all_that_are_drawn(pages, name):
    keyed = 0
    for section in re.findall(r"<section.*?</section>", pages[name], re.DOTALL):
        keys = re.findall(r'<p class="key.*?</p>', section)
        colours = [re.findall(r"var\(--([\w-]+)\)", key) for key in keys]
        for key in colours:
            for theme in themes(STYLE):
                assert len({theme[colour] for colour in key}) == len(key), key
        if not keys or "Lost on the software bus" in section:  # which says its lines by their form
            continue
        keyed += 1
        shapes = [
            item for svg in svgs(section) for item in svg.iter() if item.tag in {"path", "rect", "circle"}
        ]
        painted = {paint_of(STYLE, item.get("class", "")) for item in shapes}
        own = (
            {"dim", "rule", "note"} if name == "report" else {"note"}
        )  # nodes of the balance, frames, counts of runs
        assert painted - own - {None} <= {colour for key in colours for colour in key}, section[:60]
    assert keyed > 2


def test_no_colour_of_a_plot_is_there_twice(plot):
    lines = [line for panel in plot.figure.panels for line in panel.lines]
    coloured = [line.look for line in lines if line.colour >= 0]
    assert len({*coloured}) == len(coloured) > 4
    grey = [line.label for line in lines if line.colour < 0]
    assert len(grey) > 5
    assert all(label.startswith("/cfs/") for label in grey)
    svg = plot_svg(plot.figure)
    for panel in plot.figure.panels:
        for text, line in panel.legend if panel.has_names else ():
            assert f">{text}</text>" in svg
            assert f'class="c{line.look[0]}"' in svg


@pytest.mark.parametrize("style", [STYLE, PLOT_STYLE], ids=["pages", "plots"])
def test_text_is_read_on_light_and_on_dark(style):
    inks = {
        *re.findall(r"(?<![\w-])color: var\(--([\w-]+)\)", style),
        *re.findall(r"text \{[^}]*fill: var\(--(\w+)\)", style),
    }
    assert {"ink", "dim"} <= inks
    for theme in themes(style):
        grounds = [theme[name] for name in ("ground", "card") if name in theme]
        for ink, ground in ((ink, ground) for ink in inks - {"ground", "card"} for ground in grounds):
            assert contrast(rgb(ground), rgb(theme[ink])) >= 4.5, (ink, ground)


def test_lines_and_bars_are_seen_on_light_and_on_dark():
    for ground, colours in zip(("#ffffff", "#15171a"), (LIGHT_COLOURS, DARK_COLOURS), strict=True):
        assert len({*colours}) == len(colours)
        assert min(contrast(rgb(ground), rgb(colour)) for colour in colours) >= 3
    for theme in themes(STYLE):
        for name in ("ci", "to", "sbn", "robot", "other", "error", "note", "late"):
            assert contrast(rgb(theme["card"]), rgb(theme[name])) >= 3, name


def test_the_bars_are_the_figures_of_the_json(pages, diagnosis):
    """What arrived and what was lost, measured in the picture, is what the doctor counts."""
    (route,) = (
        row for row in diagnosis.as_json()["routes"] if row["topic"] == "/cmd_vel" and row["link"] == "ci"
    )
    (svg,) = (svg for svg in svgs(pages["report"]) if svg.get("aria-label") == "rate of 0x1827 (/cmd_vel)")
    height = float(svg.get("viewBox").split()[3])
    drawn = plots(diagnosis.case)
    (rates,) = (row for row in drawn.rates if row["label"] == "0x1827 (/cmd_vel)")
    peak = max([a + b for a, b in zip(rates["seen"], rates["missing"], strict=True)] + [rates["limit"]])
    scale = 1.08 * peak / (height - TOP - BOTTOM)
    sums = {}
    for item in svg.iter("path"):
        ends = re.findall(r"M[\d.]+ ([\d.]+)V([\d.]+)H", item.get("d"))
        sums[item.get("class").split()[0]] = (
            sum(float(low) - float(high) for low, high in ends) * scale * drawn.bin_s
        )
    assert sums["missing"] == pytest.approx(route["lost"], rel=0.05)
    assert sums["seen"] + sums["missing"] == pytest.approx(route["sent"], rel=0.02)


def test_the_cells_are_the_shares_of_the_runs():
    data = archive()
    (svg,) = (
        item for item in svgs(archive_page(data, ORIGIN)) if "topics and runs" in item.get("aria-label")
    )
    cells = [(item.get("class"), item.find("title").text) for item in svg.iter("rect")]
    expected = sorted(
        (f"heat{sum(row['missing'] > limit for limit in (0, 10, 100, 500))}",
         f"{row['capture']}: {row['missing']:,} of 1,000 missing, {row['missing'] / 10:.3g} %")
        for row in data.shares
    )  # fmt: skip
    assert sorted(cells) == expected
    assert {name for name, _ in cells} == {f"heat{step}" for step in (0, 2, 3, 4)} | {"heat1"} & {
        name for name, _ in cells
    }


@pytest.mark.parametrize("name", ["report", "archive"])
def test_a_screen_reader_is_told_what_a_figure_shows(pages, name):
    charts = svgs(pages[name])
    assert len(charts) > 3
    assert all(svg.get("role") == "img" and len(svg.get("aria-label")) > 3 for svg in charts)
    figures = re.findall(r"<figure.*?</figure>", pages[name], re.DOTALL)
    assert all("<figcaption" in item or "aria-label" in item for item in figures)
    assert '<html lang="en">' in pages[name]
    assert re.search(r"<title>[^<]+</title>", pages[name])


def test_a_picture_of_its_own_says_what_it_shows(plot, pages):
    svg = plot_svg(plot.figure)
    assert 'role="img"' in svg
    assert re.search(r"<title>rate:\*, a_rover.pcap</title>", svg)
    first = re.search(r"<svg.*?</svg>", pages["report"], re.DOTALL)[0]
    assert 'role="img"' in standalone(first)


def lines_of(view, width):
    console = Console(width=width, file=io.StringIO(), force_terminal=False)
    console.print(view)
    return console.file.getvalue().splitlines()


FOUND = "92 of 600 messages, the first of them in packet 105 at 4.25 s"
RESULT = {
    "passed": False,
    "expected": "at most 1",
    "about": "/cmd_vel",
    "expectation": "lost",
    "found": FOUND,
}
CHECK = {"source": "a_rover.pcap", "seconds": 65.3, "failed": 1, "results": [RESULT]}
SIDE = {
    "runs": 1,
    "source": "a/path/that/is/rather/long/a_rover.pcap",
    "datagrams": 1827,
    "seconds": 65.3,
    "lost": 92,
}
CHANGE = {
    "route": "/cmd_vel",
    "worse": True,
    "text": FOUND + " instead of none at all before",
}
POINT = {"route": "/cmd_vel", "what": "lost", "good": 1, "bad": 92, "interval": None, "worse": True}
COMPARE = {"good": SIDE, "bad": SIDE, "changes": [CHANGE], "points": [POINT]}
ANSWER = (
    [f"column_{place}" for place in range(24)],
    [["/captures/a_rover.pcap", *range(10**7, 10**7 + 23)]] * 3,
)


@pytest.mark.parametrize("width", [60, 80, 160])
def test_no_line_is_wider_than_the_terminal(diagnosis, plot, width):
    summary = {**inspect(open_file(ROVER), SETTINGS.workbench()).summary(), "source": "a_rover.pcap"}
    views = {
        "doctor": screen(diagnosis, width),
        "info": capture_summary(summary),
        "check": check_view(CHECK, width),
        "compare": runs_view(COMPARE, width),
        "query": answer_table(*ANSWER, width),
    }
    shown = {name: lines_of(view, width) for name, view in views.items()}
    shown["plot"] = [line.plain for line in plot_lines(plot.figure, width, colour=True)]
    for name, lines in shown.items():
        assert max(map(len, lines)) <= width, name
    assert len(shown["doctor"]) <= 24
    assert len(shown["plot"]) <= 40
    tails = [line for line in shown["check"][2:-2] if line[0] != "✗"]
    assert all(line.startswith("  ") and line[2] != " " for line in tails)  # wrapped: below its beginning
    assert bool(tails) is (width < 100)
    hidden = " ".join(shown["query"])
    assert ("not shown" in hidden) is (width < 240)
    for place in range(24):
        assert f"column_{place}" in hidden
