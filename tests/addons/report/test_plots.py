"""What a report draws of a capture."""

import re

import pytest
import truth
from merging import merge
from places import CAPTURES, MISSIONS

from edoras_tools.addons.report.charts import plots


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
