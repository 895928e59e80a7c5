"""The way of each command, held to what the robot and the relay counted when the captures were made."""

from __future__ import annotations

import numpy as np
import pytest
from captures import ROBOT_GOT
from places import ROOT
from truth import examined

from edoras_tools.diagnosis.balance import (
    BUS,
    CI_HOP,
    PEER_TO_ROBOT,
    PUBLISHER,
    TO_ROBOT,
    BridgeCount,
    Row,
    chains,
    sent,
)
from edoras_tools.diagnosis.examination import Examination
from edoras_tools.io.formats.open import open_file
from edoras_tools.links import ROBOT_PORT
from edoras_tools.model import NO_ROUTE
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.render.doctor import causes, shown_rows

FOLDER = ROOT / "tests/captures"
NAMES = sorted(path.name.partition(".")[0] for path in FOLDER.glob("*.pcap.zst"))
OPTIONS = {"n10_uplink_loss": ("--port", "ci:5234")}
TOGETHER = "diagnoses"
REST = ("superseded", "waiting", "not_captured", "unaccounted")
GOT = {
    # Counted behind the last hop that a capture shows: at the robot, behind the relay, or by the ROS side.
    **{name: {0x1827: counted} for name, counted in ROBOT_GOT.items()},
    "n10_uplink_loss": {0x1827: (191, 225)},
    "n12_two_hosts_flight": {0x1827: (27 + 30 + 17, 140), 0x1828: (24 + 20 + 17, 140)},
    "n12_two_hosts_ground": {0x1827: (27 + 30 + 17, 140), 0x1828: (24 + 20 + 17, 140)},
}


@pytest.fixture(scope="module")
def diagnosis():
    """A function: the diagnosis of a capture by its name."""
    return lambda name: examined(FOLDER / f"{name}.pcap.zst", OPTIONS.get(name, ()))


@pytest.mark.long("d3_cpu1_cpu2", "c4_cmd_rate")
@pytest.mark.parametrize("name", NAMES)
def test_what_comes_out_of_a_hop_goes_into_the_next_one(name, diagnosis):
    for chain in diagnosis(name).chains:
        publisher, first, *_ = chain.hops
        assert publisher.hop == PUBLISHER
        assert (publisher.came, publisher.lost, publisher.out) == (None, None, first.came)
        assert "--bag" in publisher.counted
        for one, following in zip(chain.hops, chain.hops[1:], strict=False):
            assert one.out == following.came, (chain.msg_id, following.hop)
        for hop in chain.hops:
            if hop.observed:
                assert hop.counted
                assert hop.came + hop.doubled == hop.out + hop.lost + sum(hop.rest.values())
            else:
                assert hop.counted.startswith("not observable")


@pytest.mark.parametrize("name", GOT)
def test_what_comes_out_of_the_last_hop_is_what_was_counted_there(name, diagnosis):
    counted = {}
    for chain in diagnosis(name).chains:
        last = [hop for hop in chain.hops if hop.observed][-1]
        counted[chain.msg_id] = (last.out, chain.hops[1].came)
    assert counted == GOT[name]


@pytest.mark.parametrize("name", NAMES)
def test_each_loss_of_a_command_is_at_one_hop(name, diagnosis):
    found = diagnosis(name)
    for chain in found.chains:
        own = [
            row
            for row in found.balance
            if (row.msg_id, row.instance, row.link) == (chain.msg_id, chain.instance, "ci")
        ]
        inside = [hop for hop in chain.hops if hop.observed][: len({row.hop for row in own})]
        assert sum(hop.lost for hop in inside) == sum(row.all_lost for row in own)
        for figure in REST:
            assert sum(hop.rest.get(figure, 0) for hop in inside) == sum(getattr(row, figure) for row in own)
        assert sent(own) == inside[0].came


@pytest.mark.parametrize("name", NAMES)
def test_hops_that_were_not_counted_are_shown_beside_the_balance(name, diagnosis):
    found = diagnosis(name)
    shown = [row for row in shown_rows(found) if row["lost"] is None]
    ends = [chain.hops[at] for chain in found.chains for at in (0, -1)]
    wanted = sum(not hop.observed and hop.hop != PEER_TO_ROBOT for hop in ends)
    wanted += sum(not row.observed for row in found.balance)
    assert len(shown) == wanted
    assert all(row["not_counted"].startswith("not observable") for row in shown)


WITHOUT_CI_COUNT = {b"\x08\x84"}
WITHOUT_COUNTS = WITHOUT_CI_COUNT | {b"\x08\x03"}


@pytest.mark.each(3)
@pytest.mark.parametrize(
    ("name", "without", "robot", "blank"),
    [
        ("a_rover", WITHOUT_CI_COUNT, True, {CI_HOP}),
        ("a_rover", WITHOUT_CI_COUNT, False, {CI_HOP}),
        ("a_rover", WITHOUT_COUNTS, False, {CI_HOP, BUS}),
        ("b_arm_single", WITHOUT_COUNTS, True, set()),  # all came out again: nothing was lost before that
        ("b_arm_single", set(), False, set()),
    ],
)
def test_a_hop_whose_loss_nothing_counts_shows_none(name, without, robot, blank):
    bench = Settings().workbench()
    examination = Examination(bench.columns.context)
    for batch in open_file(FOLDER / f"{name}.pcap.zst").batches():
        kept = [
            at
            for at, item in enumerate(batch)
            if bytes(item.payload[:2]) not in without and (robot or item.destination.port != ROBOT_PORT)
        ]
        part = batch.take(np.array(kept))
        examination.add(part, bench.columns.decode(part))
    found = examination.diagnose()
    (chain,) = found.chains
    inside = [hop for hop in chain.hops if hop.hop in {CI_HOP, BUS}]
    assert {hop.hop for hop in inside if hop.lost is None} == blank
    assert all(hop.counted.startswith("not observable: no 0x8") for hop in inside if hop.lost is None)
    shown = [item for item in shown_rows(found) if item["msg_id"] == "0x1827" and item["hop"] in blank]
    assert [item["lost"] for item in shown] == [None] * len(blank)
    assert all(causes(item).startswith("not observable: no 0x8") for item in shown)


def row(hop, came, out, **figures):
    figures = {"link": "ci", "msg_id": 0x1827, "instance": None, "route": 0} | figures
    return Row(hop=hop, came=came, out=out, **figures)


def test_bags_count_both_ends():
    rows = [
        row("CI", 9, 9),
        row("software bus", 9, 8, lost={"limit": 1}),
        row("application", 8, 8, onward=(("sbn", 0x082A),)),
        row("SBN_3_66_Pipe", 8, 7, lost={"limit": 1}, link="sbn", msg_id=0x082A, route=1),
    ]
    bridges = {("ci", 0x1827): BridgeCount(10, 1, "a.mcap"), ("sbn", 0x082A): BridgeCount(7, 2, "robot")}
    (chain,) = chains(rows, {0: "/cmd_vel"}, bridges)
    assert [(hop.hop, hop.came, hop.lost, hop.out) for hop in chain.hops] == [
        (PUBLISHER, 10, 1, 9),
        ("CI", 9, 0, 9),
        ("software bus", 9, 1, 8),
        ("application", 8, 0, 8),
        ("SBN_3_66_Pipe", 8, 1, 7),
        (PEER_TO_ROBOT, 7, 2, 5),
    ]
    assert (chain.topic, chain.hops[0].counted) == ("/cmd_vel", "in a.mcap")


def test_a_peer_that_is_a_cfs_is_no_bridge_to_a_robot():
    rows = [
        row("CI", 4, 4),
        row("software bus", 4, 4),
        row("application", 4, 4, onward=(("sbn", 0x18F0),)),
        row("software bus", 4, 4, link="sbn", msg_id=0x18F0),
    ]
    (chain,) = chains(rows, {})
    assert [hop.hop for hop in chain.hops][-1] == "software bus"


def test_where_a_mission_names_commands_others_have_no_chain():
    rows = [row("CI", 1, 1), row("software bus", 1, 1)]
    other = [row(item.hop, 1, 1, msg_id=0x18EE, route=NO_ROUTE) for item in rows]
    assert [chain.msg_id for chain in chains([*rows, *other], {0: "/cmd_vel"})] == [0x1827]
    assert [hop.hop for hop in chains(rows, {})[0].hops] == [PUBLISHER, "CI", "software bus", TO_ROBOT]
