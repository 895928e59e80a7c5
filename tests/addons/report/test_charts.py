"""What a report draws of a capture: bands as wide as the ledger's figures, the same in words, and rates."""

from __future__ import annotations

import re
from collections import Counter
from xml.etree import ElementTree as ET

import pytest
import truth
from merging import merge
from places import CAPTURES, MISSIONS, ROOT

from edoras_tools.addons.report.charts import bands, plots, sankey, strip
from edoras_tools.addons.report.page import page
from edoras_tools.diagnosis.balance import ways
from edoras_tools.diagnosis.ledger import summed
from edoras_tools.diagnosis.summary import summarize
from edoras_tools.io.formats.open import open_file
from edoras_tools.pipelines.doctor import examine
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.render.pages import Origin

MISSION = ROOT / "samples/missions/rover_ground.yaml"
NAMES = ("a_rover", "c4_cmd_rate", "n12_two_hosts_ground", "season3/q01_two_causes_one_counter")


@pytest.fixture(scope="module", params=NAMES)
def result(request):
    path = ROOT / f"tests/captures/{request.param}.pcap.zst"
    return examine(open_file(path), Settings(configs=(MISSION,)).workbench()).diagnosis


def test_widths_are_the_ledger(result):
    """Each band's width is its messages by one scale; at each hop they add up to what came."""
    tree = ET.fromstring(sankey(result))
    drawn = [item for item in tree.iter("path") if "band" in item.get("class")]
    scales = {
        round(float(item.get("data-width")) / int(item.get("data-number")), 3)
        for item in drawn
        if int(item.get("data-number"))
    }
    assert max(scales) - min(scales) < 0.002
    named = [way for way in ways(summed(result.balance)) if way.hops[0].route in result.topics]
    lanes = [way for way in named if way.hops[0].came]
    expected = Counter((row.hop, band.number) for way in lanes for row in way.hops for band in bands(row))
    titles = [item.find("title").text.partition(": ") for item in drawn]
    numbers = [int(item.get("data-number")) for item in drawn]
    assert Counter((title[0], number) for title, number in zip(titles, numbers, strict=True)) == expected
    assert all(title[2].startswith(f"{number:,} ") for title, number in zip(titles, numbers, strict=True))
    for way in lanes:
        for row in way.hops:
            assert sum(band.number for band in bands(row)) == row.came + row.duplicated


def test_it_is_said_in_words(result):
    label = ET.fromstring(sankey(result)).get("aria-label")
    for item in result.headlines[:3]:
        if item.topic in result.topics.values():
            assert f"{item.topic}: {item.sent:,} sent" in label
    told = ET.fromstring(strip(drawn := plots(result.case))).get("aria-label")
    assert told.startswith("Routes over time. ")
    for row in drawn.rates:
        lost = sum(row["missing"]) * drawn.bin_s
        if lost or any(row["seen"]):
            assert f"{row['label']}, {row['link'].upper()}: {lost:,.0f} lost, " in told


def test_a_report_has_what_would_be_left(result):
    text = page(result, "x.pcap", Origin("edoras report x.pcap", 0))
    promised = [item.promise for item in summarize(result).problems[:3] if item.promise]
    assert re.findall(r">left ([^<]+)<", text) == promised


@pytest.mark.parametrize(
    ("name", "link", "topic", "sent", "lost"),
    [
        ("a_rover.pcap", "ci", "0x1827", 600, 92),
        ("c1_tlm_rate_limit4.pcap.gz", "to", "0x0827", 17_663, 16_706),
    ],
)
def test_loss_is_drawn_with_and_without_gaps_in_counts(name, link, topic, sent, lost):
    drawn = plots(truth.examined(CAPTURES / name, (), ()).case)
    [row] = [row for row in drawn.rates if (row["link"], row["label"][:6]) == (link, topic)]
    assert min(row["seen"]) >= 0
    assert sum(row["missing"]) * drawn.bin_s == pytest.approx(lost, rel=0.01)
    assert sum(row["seen"] + row["missing"]) * drawn.bin_s == pytest.approx(sent, rel=0.01)


def test_each_spacecraft_has_its_own_pictures(tmp_path, call):
    captures = {"10.0.0.2": CAPTURES / "b_arm_single.pcap", "10.0.0.3": CAPTURES / "a_rover.pcap"}
    whole, _ = merge(captures, tmp_path)
    second = ["--topic", "/sc_2/cmd_vel", "-c", MISSIONS / "rover_ground.yaml"]
    for words, numbers in (
        ([], [1, 2]),
        (second, [2]),
    ):
        page = tmp_path / f"{len(words)}.html"
        assert call("report", whole, "-o", page, *words).code == 3
        titles = re.findall(r"<h2>(.*?)</h2>", page.read_text(encoding="utf-8"))
        for title in "Routes over time", "Rates against limits", "Over time", "Sizes against buffers":
            own = [f"{title} of spacecraft {number}" for number in numbers]
            assert [item for item in titles if item.startswith(title)] == own
