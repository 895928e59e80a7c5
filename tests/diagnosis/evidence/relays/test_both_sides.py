"""Two captures of one path: in front of a relay and behind it, on both sides of an address translation."""

from __future__ import annotations

import random

import mutations
import pytest
import truth
from effort import long_but
from msgspec.structs import replace
from places import ROOT
from rewriting import datagrams, write

from edoras_tools.decode import Options
from edoras_tools.links.bare import CI
from edoras_tools.pipelines.clocks import open_aligned
from edoras_tools.pipelines.doctor import examine
from edoras_tools.pipelines.workbench import Settings

CAPTURES = ROOT / "tests/captures"
SIDES = ("ground", "cfs")
GROUND, OUTSIDE, ROUTER, INSIDE = "10.0.0.5", "203.0.113.9", "192.168.1.1", "192.168.1.10"
DELAY_NS = 3_000_000
A_ROVER = (1763, 92, 0, 0)


def examined(paths, ci_port=0):
    settings = Settings([], options=Options(ports=((CI, ci_port),) if ci_port else ()))
    source, _ = open_aligned(paths, settings)
    return examine(source, settings.workbench(source.info)).diagnosis


def figures(found):
    return found.datagrams, found.lost, found.unaccounted, found.uncertain


@pytest.mark.quick("none")
@pytest.mark.parametrize("unnumbered", ["none", "ground", "cfs", "both"])
def test_what_a_relay_did_is_in_its_row_and_each_message_is_counted_once(unnumbered, tmp_path):
    """Its truth: 14 dropped, 78 doubled, 26 late; 37 lost at the pipe; 33 of 280 not at the robot."""
    paths = []
    for side in SIDES:
        path = CAPTURES / f"season3/q07_uplink_dup_loss_reorder_{side}.pcap.zst"
        if unnumbered in {side, "both"}:
            bare = [replace(item, identification=0) for item in datagrams(path)]
            path = write(tmp_path / f"{side}.pcap", bare)
        paths.append(path)
    found = examined(paths, 5234)
    rows = {row.hop: row for row in found.balance if row.msg_id == 0x1827}
    relay = rows["relay 127.0.0.7:5234"]
    assert (relay.came, relay.all_lost, relay.duplicated, relay.late) == (280, 14, 78, 26)
    assert 20 <= relay.out_of_order <= relay.late
    assert (rows["software bus"].came, rows["software bus"].lost) == (344, {"limit": 37})
    assert (found.messages_lost, found.messages_uncertain) == (33, 0)


def translated(item, number, unnumbered, *, ages, masks, ci_port):
    """Return a datagram as it is captured at the ground and at cFS; None where it does not come there."""
    numbers = [0 if unnumbered in {side, "both"} else number for side in SIDES]
    port, to = item.source[1], item.destination[1]
    there = INSIDE if to != 1235 else GROUND
    cfs = replace(item, source=(INSIDE, port), destination=(there, to), identification=numbers[1], tap=2)
    ground = replace(cfs, identification=numbers[0], tap=1)
    life = 64 - ages
    if to == 1234:
        source = (ROUTER, 61_000) if masks else (GROUND, port)
        ground = replace(ground, source=(GROUND, port), destination=(OUTSIDE, ci_port or to))
        return ground, replace(cfs, source=source, time_to_live=life).at(DELAY_NS)
    if to == 1235:
        return replace(ground, source=(OUTSIDE, 62_000), time_to_live=life).at(DELAY_NS), cfs
    return None, replace(cfs, identification=number)


NAT = [
    (masks, ci_port, unnumbered, ages)
    for masks in (False, True)
    for ci_port in (0, 5234)
    for unnumbered in ("none", *SIDES, "both")
    for ages in (True, False)
]


@pytest.mark.quick("True-5234-cfs-False")
@pytest.mark.parametrize(
    ("masks", "ci_port", "unnumbered", "ages"),
    long_but([(True, 5234, "cfs", False), (False, 0, "ground", True)], NAT),
)
def test_an_address_translation_without_identifications_is_one_path(
    masks, ci_port, unnumbered, ages, tmp_path
):
    sides = zip(
        *(
            translated(item, at % 60_000 + 1, unnumbered, ages=ages, masks=masks, ci_port=ci_port)
            for at, item in enumerate(datagrams(CAPTURES / "a_rover.pcap.zst"))
        ),
        strict=True,
    )
    paths = [
        write(tmp_path / f"{name}.pcap", sorted(filter(None, side), key=lambda item: item.time_ns))
        for name, side in zip(SIDES, sides, strict=True)
    ]
    found = examined(paths, ci_port)
    assert figures(found) == A_ROVER
    assert not {"repeated_commands", "stranger_commands", "duplicated"} & {
        item.rule for item in found.verdicts
    }


TAPS = [(True, True), (False, False), (False, True)]


@pytest.mark.parametrize(("numbered", "apart"), long_but(TAPS[:2], TAPS))
def test_what_each_of_two_taps_lacks_was_not_lost(numbered, apart, tmp_path):
    chance, sides = random.Random(1), ([], [])
    for at, plain in enumerate(datagrams(CAPTURES / "a_rover.pcap.zst")):
        item = replace(plain, identification=(at % 60_000 + 1) * numbered)
        step = (1 if item.destination[1] == 1234 else -1) * 300_000 if apart else 15_000
        later = replace(item, time_to_live=64 - apart).at(step)
        for side, own in zip(sides, (item, later), strict=True):
            if chance.random() >= 0.01:
                side.append(own)
    paths = [
        write(tmp_path / f"{at}.pcap", sorted(side, key=lambda item: item.time_ns))
        for at, side in enumerate(sides)
    ]
    assert figures(examined(paths)) == A_ROVER


HERE, THERE = bytes([10, 0, 0, 5]), bytes([10, 0, 0, 9])
ENDS = {1234: HERE + THERE, 1235: THERE + HERE, 8585: THERE + THERE}


def between(name, paths, *, dropped, damaged, numbered=True):
    """Write what is captured at the ground and at cFS, with a network between them; return what that lost.

    Of what goes up more is sent than the capture has: CI did not get it.
    """
    chance, sides, lost = random.Random(1), ([], []), [0, 0]
    for at, item in enumerate(mutations.frames(CAPTURES / f"{name}.pcap.zst")):
        port = int.from_bytes(item.data[36:38], "big")
        if port not in ENDS or not mutations.is_to(item.data, port):
            continue
        number = 2 * at % 60_000 + 1 if numbered else 0

        def frame(data, number, port=port):
            data = bytearray(data)
            data[18:20], data[26:34] = number.to_bytes(2, "big"), ENDS[port]
            return bytes(mutations.summed(data))

        def put(side, data, late=0, item=item):
            data = bytearray(data)
            data[5], data[22] = side, 64 - late
            data = data if late == 2 else mutations.summed(data)
            sides[side].append(item._replace(data=bytes(data), time_ns=item.time_ns + bool(late) * DELAY_NS))

        plain, fate = frame(item.data, number), chance.random()
        up = port == 1234
        put(0 if up else 1, plain)
        if port == 8585:
            continue
        sent, to = plain, 1 if up else 0
        if up:
            put(to, plain, 1)
            if fate < dropped + damaged:
                other = bytearray(plain)
                other[-9] ^= 0x55
                sent = frame(other, number + numbered)
                put(0, sent)
        if fate < dropped:
            lost[0] += 1
        elif fate < dropped + damaged:
            lost[1] += 1
            put(to, mutations.flipped(sent, chance, 60), 2)
        elif not up:
            put(to, plain, 1)
    for path, side in zip(paths, sides, strict=True):
        mutations.write(path, sorted(side, key=lambda item: item.time_ns))
    return lost


BETWEEN = [("a_rover", 92), ("season3/q01_two_causes_one_counter", 258)]


@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize(("name", "already"), BETWEEN)
def test_what_was_lost_or_damaged_between_two_taps_is_lost(name, already, order, tmp_path):
    paths = [tmp_path / "ground.pcap", tmp_path / "cfs.pcap"]
    dropped, damaged = between(name, paths, dropped=0.04, damaged=0.04)
    result = examined(paths[::order]).as_json()
    # Of what was sent just before one of them ends nothing is said.
    assert already + dropped + damaged - 4 <= truth.bounds(result)[0] <= already + dropped + damaged
    assert truth.causes(result)["damaged"] >= 0.9 * damaged > 10
    assert truth.causes(result)["after"] > 10
    assert truth.sums(result) == []


@pytest.mark.parametrize("numbered", [True, False])
def test_what_came_damaged_to_the_second_tap_is_not_counted_twice(numbered, tmp_path):
    paths = [tmp_path / "ground.pcap", tmp_path / "cfs.pcap"]
    _, damaged = between("a_rover", paths, dropped=0, damaged=0.05, numbered=numbered)
    result = examined(paths).as_json()
    low, more = truth.bounds(result)
    assert low <= 92 + damaged <= low + more <= low + 1
