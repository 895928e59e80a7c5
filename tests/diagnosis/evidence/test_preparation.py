"""Evidence in order of time: what the counts say is the same however the file's records stand."""

import random
from contextlib import closing
from itertools import product

import numpy as np
import pytest
from effort import long_but
from places import MISSIONS, ROOT
from rewriting import datagrams, write

from edoras_tools.diagnosis.evidence.preparation import in_time_order
from edoras_tools.diagnosis.evidence.table import Recorder, followed
from edoras_tools.io.formats.open import open_file
from edoras_tools.pipelines.workbench import Settings

COUNTED = ("counted", "missing", "duplicates", "reordered", "restarts")
SECOND = 10**9


def recorded(path):
    with closing(open_file(path)) as source:
        bench = Settings([MISSIONS / "rover_ground.yaml"]).workbench(source.info)
        recorder = Recorder(bench.columns.context)
        for batch in source.batches():
            recorder.add(batch, bench.columns.decode(batch))
    return recorder


def captured(name):
    return datagrams(ROOT / f"tests/captures/{name}.pcap.zst")


def shuffled(items, within_ns, seed):
    chance = random.Random(seed)
    return sorted(items, key=lambda item: item.time_ns + chance.randrange(within_ns))


def some_moved(items, count, seed):
    chance, left = random.Random(seed), list(items)
    for _ in range(count):
        left.insert(chance.randrange(len(left)), left.pop(chance.randrange(len(left))))
    return left


@pytest.mark.long("d3*")
@pytest.mark.parametrize("name", ["a_rover", "c1_tlm_rate_limit4", "d3_cpu1_cpu2", "n3_cfs_restart"])
def test_counts_followed_again_say_the_same(tmp_path, name):
    rows = recorded(write(tmp_path / "x.pcap", captured(name))).rows()
    again = followed(rows)
    for column in COUNTED:
        assert np.array_equal(getattr(again, column), getattr(rows, column)), column


CASES = list(product(["c1_tlm_rate_limit4", "n1_to_remove_all"], [1, 10, 10**6], range(3)))


@pytest.mark.each(3)
@pytest.mark.parametrize(("name", "seconds", "seed"), long_but(CASES[::4], CASES))
def test_a_file_out_of_order_is_as_the_one_in_order(tmp_path, name, seconds, seed):
    items = captured(name)
    rows, _, none = in_time_order(recorded(write(tmp_path / "x.pcap", items)))
    path = write(tmp_path / "y.pcap", shuffled(items, seconds * SECOND, seed))
    found, _, disordered = in_time_order(recorded(path))
    assert none == 0 < disordered
    for column in ("time_ns", "packet_print", *COUNTED):
        assert np.array_equal(getattr(found, column), getattr(rows, column)), column


@pytest.mark.parametrize("seed", range(3))
def test_a_few_records_far_from_their_places_are_put_back(tmp_path, seed):
    items = captured("n5_app_restarts")
    rows, _, _ = in_time_order(recorded(write(tmp_path / "x.pcap", items)))
    path = write(tmp_path / "y.pcap", some_moved(items, 5, seed))
    found, payloads, disordered = in_time_order(recorded(path))
    assert disordered
    for column in ("time_ns", "packet_print", *COUNTED):
        assert np.array_equal(getattr(found, column), getattr(rows, column)), column
    assert np.array_equal(payloads.ingest["time_ns"], found.time_ns[payloads.ingest["row"]])
    assert (np.diff(payloads.ingest["row"]) > 0).all()
