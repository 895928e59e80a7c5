"""Values that arrive as others than were sent: a_rover with some of what reached its robot changed."""

import random
import struct

import pytest
import truth
from msgspec.structs import replace
from places import CAPTURES
from rewriting import datagrams, write

from edoras_tools.diagnosis.summary import summarize
from edoras_tools.diagnosis.verdict import Severity
from edoras_tools.units import SECOND

ROBOT = 8585


@pytest.fixture(scope="module")
def flight():
    return datagrams(CAPTURES / "a_rover.pcap")


def changed(items, share, change):
    """Return datagrams of which a share of what reached the robot is changed, and the number of those."""
    draw = random.Random(share)
    reached = [index for index, item in enumerate(items) if item.destination[1] == ROBOT]
    chosen = set(draw.sample(reached, round(len(reached) * share / 100)))
    return [change(item, draw) if index in chosen else item for index, item in enumerate(items)], len(chosen)


def garbled(item, draw):
    return replace(item, payload=draw.randbytes(48))


def raised(item, _draw):
    (value,) = struct.unpack("<d", item.payload[:8])
    return replace(item, payload=struct.pack("<d", value + 0.125) + item.payload[8:])


def never_set(item, _draw):
    return replace(item, payload=bytes(range(48)))


def verdicts(path, items):
    found = truth.examined(write(path, items))
    own = [item for item in found.verdicts if item.rule in {"changed_values", "old_values"}]
    return found, own


@pytest.mark.parametrize(("share", "change"), [(1, garbled), (10, raised), (10, never_set)])
def test_each_value_that_was_never_sent_is_counted_and_is_no_loss(flight, tmp_path, share, change):
    items, number = changed(flight, share, change)
    found, (verdict,) = verdicts(tmp_path / "a.pcap", items)
    always = f": {number} always hold the same one" if change is never_set else ""
    assert (
        verdict.reason == f"{number} of 508 that reached the robot have a value that was never sent{always}"
    )
    assert verdict.severity is Severity.ERROR
    assert (found.lost, found.unaccounted, found.uncertain) == (92, 0, 0)


@pytest.mark.parametrize(("change", "how"), [(garbled, "changed"), (never_set, "always hold the same one")])
def test_where_nothing_that_was_sent_arrives_the_first_line_says_so(flight, tmp_path, change, how):
    items, number = changed(flight, 100, change)
    found, (verdict,) = verdicts(tmp_path / "a.pcap", items)
    assert verdict.reason.endswith(f"has a value that was sent: all {number} {how}")
    headline = summarize(found).headline
    assert headline.startswith("Nothing that reached the robot has a value that was sent. About 1 in 7")


@pytest.mark.parametrize("share", [10, 100])
def test_a_value_that_comes_instead_of_newer_ones_is_old_and_they_are_no_loss(flight, tmp_path, share):
    first = next(item for item in flight if item.destination[1] == ROBOT)
    items, number = changed(flight, share, lambda item, _: replace(item, payload=first.payload))
    found, (verdict,) = verdicts(tmp_path / "a.pcap", items)
    number -= share == 100  # the first is what it was
    assert verdict.reason.startswith(f"{number} of 508 that reached the robot came with an old value")
    assert (found.lost, found.unaccounted) == (92, 0)


def test_what_comes_once_more_later_is_old(flight, tmp_path):
    copies = [item.at(1_500_000_000) for item in flight if item.destination[1] == ROBOT][5:500:10]
    items = sorted([*flight, *copies], key=lambda item: item.time_ns)
    _, (verdict,) = verdicts(tmp_path / "a.pcap", items)
    assert verdict.reason.startswith(
        f"{len(copies)} of {508 + len(copies)} that reached the robot came with an"
    )


def test_what_takes_longer_than_its_rounds_is_late(flight, tmp_path):
    items = [item.at(3 * SECOND) if item.destination[1] == ROBOT else item for item in flight]
    _, (verdict,) = verdicts(tmp_path / "a.pcap", sorted(items, key=lambda item: item.time_ns))
    assert verdict.reason.startswith("508 of 508 that reached the robot were late, up to 3.5 s")


def test_what_the_capture_missed_has_not_changed(flight, tmp_path):
    draw = random.Random(5)
    _, found = verdicts(tmp_path / "a.pcap", [item for item in flight if draw.random() > 0.05])
    assert found == []


def test_an_unknown_application_may_change_values_on_purpose(flight, tmp_path):
    items, _ = changed(flight, 10, raised)
    named = [item for item in items if item.payload[:2] not in {b"\x08\x08", b"\x08\x26"}]
    _, (verdict,) = verdicts(tmp_path / "a.pcap", named)
    assert verdict.severity is Severity.WARNING
