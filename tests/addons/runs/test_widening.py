"""Drafts that are widened: the run that was judged good passes, and what nobody touched stays as it was."""

from __future__ import annotations

import pytest
from places import CAPTURES
from rewriting import datagrams, write

ITEMS = datagrams(CAPTURES / "a_rover.pcap")[:500]


@pytest.fixture
def good(tmp_path):
    return write(tmp_path / "good.pcap", ITEMS)


@pytest.fixture
def other(tmp_path):
    """A run with two commands a second fewer."""
    commands = [item for item in ITEMS if item.payload[:2] == b"\x18\x27"]
    late = {id(item): place for place, item in enumerate(commands) if place % 5 == 4}
    return write(tmp_path / "other.pcap", [item for item in ITEMS if id(item) not in late])


def test_a_good_run_widens_what_it_does_not_meet(call, good, other, missions, tmp_path):
    mission, expect = missions("rover_ground"), tmp_path / "expect.yaml"
    assert call("check", "--init", good, *mission, "-o", expect).code == 0
    text = expect.read_text().replace("schema: 1", "schema: 1  # mine")
    expect.write_text(text)
    done = call("check", other, expect, *mission, "--update")
    assert done.code == 0
    assert any("/cmd_vel: rate" in line and "widened" in line for line in done.err)
    after = call("check", other, expect, *mission)
    left = {line for line in after.out.splitlines() if line.startswith("✗")}
    assert not any("rate" in line for line in left)
    new = expect.read_text().splitlines()
    assert "schema: 1  # mine" in new
    changed = [(old, line) for old, line in zip(text.splitlines(), new, strict=True) if old != line]
    assert all("# widened: " in line or line.startswith("verdicts: ") for _, line in changed)
    assert 0 < len(changed) < 8
    assert call("check", good, expect, *mission).code == 0


def test_a_run_that_meets_all_widens_nothing(call, good, missions, tmp_path):
    mission, expect = missions("rover_ground"), tmp_path / "expect.yaml"
    expect.write_text("topics: {/cmd_vel: {count: at least 1}}\n")
    done = call("check", good, expect, *mission, "--update")
    assert done.err == ["edoras: this run meets all expectations: nothing was widened"]
    assert expect.read_text() == "topics: {/cmd_vel: {count: at least 1}}\n"


@pytest.mark.parametrize("words", [("--json",), ("--junit", "r.xml")])
def test_it_reports_nothing_else(words, call, good, tmp_path):
    (tmp_path / "e.yaml").write_text("lost: 0\n")
    done = call("check", good, tmp_path / "e.yaml", "--update", *words)
    assert done.code == 2
