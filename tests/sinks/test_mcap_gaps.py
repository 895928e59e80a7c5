from __future__ import annotations

from collections import defaultdict

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.sessions.sequence import SequenceTracker
from edoras_tools.sinks.mcap_gaps import SequenceGaps


@pytest.mark.parametrize(
    ("counts", "missing"),
    [
        ([5, 6, 7], [0, 0, 0]),
        ([5, 8], [0, 2]),
        ([16382, 16383, 0, 1], [0, 0, 0, 0]),
        ([16382, 2], [0, 3]),
        ([5, 5, 6], [0, 0, 0]),
        ([7, 6, 8], [0, 0, 0]),
        ([9000, 0], [0, 7383]),
        ([100, 0], [0, 0]),
        ([], []),
    ],
)
def test_what_a_row_of_counts_misses(counts, missing):
    flow = np.zeros(len(counts), dtype=np.int64)
    assert SequenceGaps().missing(flow, np.array(counts, dtype=np.uint16)).tolist() == missing


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 16383)), max_size=30), st.integers(0, 30))
def test_batches_do_not_matter_and_flows_do_not_mix(packets, cut):
    senders, expected = defaultdict(SequenceTracker), []
    for flow, count in packets:
        before = senders[flow].gaps
        senders[flow].follow(count, count)
        expected.append(senders[flow].gaps - before)
    gaps, found = SequenceGaps(), []
    for part in (packets[:cut], packets[cut:]):
        flow = np.array([item[0] for item in part], dtype=np.int64)
        count = np.array([item[1] for item in part], dtype=np.uint16)
        order = np.argsort(flow, kind="stable")
        missing = np.zeros(len(part), dtype=np.int64)
        missing[order] = gaps.missing(flow[order], count[order])
        found += missing.tolist()
    assert found == expected
