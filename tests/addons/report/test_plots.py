"""What a report draws of a capture."""

import pytest
import truth
from places import CAPTURES

from edoras_tools.addons.report.plots import plots


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
