import random

import mutations
import numpy as np
import pytest
import truth
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from places import CAPTURES
from rewriting import datagrams, write

from edoras_tools.diagnosis.evidence.copies import _perhaps_again, find_copies
from edoras_tools.io.formats.open import open_file
from edoras_tools.pipelines.capture.info import inspect
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.units import MILLISECOND

MS = 1_000_000


def found(items, ways=1):
    """Return copies and duplicates of (ms, identification, tap, bytes) in conversations, by their bytes."""
    when, identification, tap, prints = (np.array(column) for column in zip(*items, strict=True))
    out = find_copies(
        (when * MS).astype(np.int64),
        identification.astype(np.uint16),
        prints.astype(np.int64) % ways,
        tap.astype(np.uint64),
        prints.astype(np.uint64),
    )
    return out.copy.sum(), out.duplicate.sum()


def test_at_two_places_within_ms_is_captured_twice():
    assert found([(at * 100 + step, at + 1, step, at) for at in range(3) for step in (0, 1)]) == (3, 0)


def test_a_conversation_doubled_throughout_is_captured_twice_at_one_place_too():
    assert found([(at * 100 + step, at + 1, 0, at) for at in range(10) for step in (0, 1)]) == (10, 0)


def test_single_doubles_are_the_networks():
    items = [(at * 100 + step, at + 1, 0, at) for at in range(10) for step in ((0, 1) if at == 4 else (0,))]
    assert found(items) == (0, 1)


def test_equal_bytes_with_other_identifications_are_sent_twice():
    assert found([(at, at + 1, 0, 7) for at in range(50)]) == (0, 0)


def test_the_same_identification_much_later_is_another_datagram():
    assert found([(0, 5, 0, 7), (500, 5, 0, 7)]) == (0, 0)


@pytest.mark.parametrize("count", [2, 16, 50])
def test_without_identification_a_burst_stays(count):
    assert found([(at / 10, 0, 0, 7) for at in range(count)]) == (0, 0)


def test_without_identification_a_conversation_that_comes_in_twos_is_captured_twice():
    items = [(at * 100 + step / 10, 0, 0, 7) for at in range(20) for step in (0, 1)]
    assert found(items) == (20, 0)
    assert found(items[:10]) == (0, 0)


@pytest.mark.parametrize(("ways", "copies"), [(1, 0), (4, 72)])
def test_without_identification_most_ways_in_twos_tell_also_where_some_are_missing(ways, copies):
    items = [(at * 100 + step, 0, 0, at) for at in range(80) for step in (0, 1)]
    assert found([item for at, item in enumerate(items) if at % 20], ways) == (copies, 0)


def test_an_identification_of_0_among_others_is_one():
    assert found([(at * 100 + step, at, 0, at) for at in range(10) for step in (0, 1)]) == (10, 0)


def test_without_identification_two_places_tell():
    assert found([(0, 0, 1, 7), (1, 0, 2, 7)]) == (1, 0)


def test_three_times_is_twice_too_often():
    assert found([(at * 100 + step, at + 1, step, at) for at in range(9) for step in range(3)]) == (18, 0)


def test_info_counts_once_what_was_captured_twice(tmp_path):
    plain = CAPTURES / "a_rover.pcap"
    doubled = [replace(item, tap=tap).at(tap * 1000) for item in datagrams(plain) for tap in (0, 1)]
    found = [
        inspect(source, Settings([]).workbench(source.info))
        for source in map(open_file, (plain, write(tmp_path / "x.pcap", doubled, layer="any")))
    ]
    rows = [
        [
            (row["link"], row["msg_id"], row["count"], row["gaps"], row["duplicates"])
            for row in one.ledger.routes()
        ]
        for one in found
    ]
    assert rows[0] == rows[1]
    assert "captured twice, and are counted once" in found[1].notes[-1]


@given(
    st.lists(st.tuples(st.integers(0, 9), st.integers(0, 60)), max_size=60),
    st.sampled_from([1, 1 << 40]),
)
def test_a_glance_misses_no_two_within_half_a_second(items, spread):
    number = np.array([value * spread for value, _ in items], np.uint64)
    time_ns = np.cumsum(np.array([step for _, step in items], np.int64) * 50 * MILLISECOND)
    near = abs(time_ns[:, None] - time_ns) <= 500 * MILLISECOND
    again = near & (number[:, None] == number) & ~np.eye(len(items), dtype=bool)
    # Two windows are 1 s long: some that are further apart share them.
    near_enough = abs(time_ns[:, None] - time_ns) <= 1000 * MILLISECOND
    may = near_enough & (number[:, None] == number) & ~np.eye(len(items), dtype=bool)
    assert again.any() <= _perhaps_again(number, time_ns) <= may.any()


TELEMETRY, ROBOT, CI = 1235, 8585, 1234
DAMAGED = {"a_rover": 92, "season3/q01_two_causes_one_counter": 258, "flights/queues_of_ten": 168}


def changed(name, path, change):
    items = mutations.frames(truth.FOLDER / f"{name}.pcap.zst")
    after = change(items, random.Random(1))
    mutations.write(path, after)
    return sum(item not in items for item in after)


@pytest.mark.parametrize("name", DAMAGED)
def test_what_the_network_damaged_is_lost_by_that(name, tmp_path):
    """Nothing that cFS sends comes back: what is damaged of it changes no counter."""
    path = tmp_path / "damaged.pcap"
    number = changed(name, path, mutations.damaged(0.05, TELEMETRY, ROBOT))
    result = truth.diagnosed(path)
    low, more = truth.bounds(result)
    assert low <= DAMAGED[name] + number <= low + more
    assert more <= 3
    assert truth.causes(result)["damaged"] >= 0.9 * number > 10
    assert truth.sums(result) == []


def test_a_command_that_came_damaged_was_sent_and_lost(tmp_path):
    def add(items, chance):
        """Send a sixth of the commands again, damaged on their way: CI does not get them."""
        more = []
        for item in items:
            if mutations.is_to(item.data, CI) and chance.random() < 1 / 6:
                other = bytearray(item.data)
                other[18] ^= 0x55
                other[-9] ^= 0x55
                more.append(
                    item._replace(
                        time_ns=item.time_ns + 40_000_000, data=mutations.flipped(other, chance, 60)
                    )
                )
        return sorted([*items, *more], key=lambda item: item.time_ns)

    path = tmp_path / "damaged.pcap"
    number = changed("a_rover", path, add)
    result = truth.diagnosed(path)
    assert truth.bounds(result) == (92 + number, 0)
    assert truth.causes(result) == {"limit": 92, "damaged": number}
    assert sum(row["in"] for row in result["balance"] if row["hop"] == "CI") == 601 + number
    told = [item for item in result["verdicts"] if item["rule"] == "damaged"]
    assert sum(item["lost"] for item in told) == number


@pytest.mark.parametrize("share", [0.5, 1])
def test_a_network_card_that_makes_checksums_damages_nothing(share, tmp_path):
    """Where it is asked to, the sender's kernel leaves anything in the field."""

    def left(items, chance):
        out = []
        for item in items:
            frame = mutations.summed(item.data)
            if chance.random() < share:
                frame[41] ^= 0x55
            out.append(item._replace(data=bytes(frame)))
        return out

    path = tmp_path / "offload.pcap"
    changed("a_rover", path, left)
    assert truth.bounds(truth.diagnosed(path)) == (92, 0)
