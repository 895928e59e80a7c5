"""A Docker host and a router: each datagram is captured on several interfaces, with other addresses."""

from __future__ import annotations

from itertools import product

import pytest
from effort import long_but
from msgspec.structs import replace
from places import ROOT
from rewriting import datagrams, write

from edoras_tools.io.formats.open import open_file
from edoras_tools.pipelines.doctor import examine
from edoras_tools.pipelines.workbench import Settings

GROUND, HOST, INSIDE = "10.0.0.9", "10.0.0.1", "172.17.0.2"
STEP_NS = 30_000


def examined(path):
    source = open_file(path)
    return examine(source, Settings([]).workbench(source.info)).diagnosis


def placed(item):
    """Return a datagram of one machine as if cFS and robot ran in a container, and the ground elsewhere."""
    inner = {1234: (GROUND, INSIDE), 1235: (INSIDE, GROUND)}
    source, destination = inner.get(item.destination[1], (INSIDE, INSIDE))
    return replace(
        item, source=(source, item.source[1]), destination=(destination, item.destination[1]), tap=1
    )


def everywhere(item, port):
    """Return a datagram as it is captured on the host's interface, on the bridge and on the container's."""
    item = placed(item)
    if item.destination[1] == 1234:
        outer = replace(item, destination=(HOST, 1234), tap=3)
        inner = [replace(item, tap=tap, time_to_live=63) for tap in (2, 1)]
        steps = [outer, *inner]
    elif item.destination[1] == 1235:
        masked = (HOST, port or item.source[1])
        steps = [item, replace(item, tap=2), replace(item, source=masked, tap=3, time_to_live=63)]
    else:
        steps = [item, replace(item, tap=2)]
    return [step.at(STEP_NS * place) for place, step in enumerate(steps)]


def figures(found):
    """Return what is counted, whoever has which address."""
    rows = [(row.hop, row.msg_id, row.came, row.out, dict(row.lost)) for row in found.balance]
    return found.datagrams, found.lost, found.superseded, found.unaccounted, rows


CASES = list(product(["a_rover", "c4_cmd_rate"], [True, False], [0, 61_000]))


@pytest.mark.quick("a_rover-True-61000")
@pytest.mark.parametrize(("name", "numbered", "port"), long_but([*CASES[:4], CASES[7]], CASES))
def test_a_docker_host_counts_as_the_container_alone(name, numbered, port, tmp_path):
    items = [
        placed(replace(item, identification=(index % 60_000 + 1) * numbered))
        for index, item in enumerate(datagrams(ROOT / f"tests/captures/{name}.pcap.zst"))
    ]
    plain = examined(write(tmp_path / "plain.pcap", items))
    several = sorted(
        (step for item in items for step in everywhere(item, port)), key=lambda item: item.time_ns
    )
    found = examined(write(tmp_path / "several.pcap", several))
    assert figures(found) == figures(plain)
    (verdict,) = [item for item in found.verdicts if item.rule == "captured_twice"]
    assert verdict.reason.startswith(f"{len(several) - found.datagrams - found.left_out:,} datagrams")
    assert any(line.startswith(f"{HOST} is another name of {INSIDE}") for line in verdict.evidence)
    assert {item.rule for item in found.verdicts} == {item.rule for item in plain.verdicts} | {
        "captured_twice"
    }


def test_one_command_to_two_cfs_is_no_translation(tmp_path):
    """The same bytes at the same time, but each sent by the station itself."""
    items = [placed(item) for item in datagrams(ROOT / "tests/captures/a_rover.pcap.zst")]
    other = [
        replace(item, source=(item.source[0].replace(INSIDE, HOST), item.source[1]), tap=2).at(STEP_NS)
        for item in items
    ]
    other = [
        replace(item, destination=(item.destination[0].replace(INSIDE, HOST), item.destination[1]))
        for item in other
    ]
    both = sorted([*items, *other], key=lambda item: item.time_ns)
    found = examined(write(tmp_path / "two.pcap", both))
    alone = examined(write(tmp_path / "one.pcap", items))
    assert found.datagrams == 2 * alone.datagrams
    assert not found.case.prepared.translated
