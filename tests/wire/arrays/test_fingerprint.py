from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.wire.arrays import fingerprint


@given(st.lists(st.binary(min_size=1, max_size=40), min_size=1, max_size=12))
def test_equal_bytes_and_only_those_share_a_fingerprint(messages):
    data = np.frombuffer(b"".join(messages), np.uint8)
    data = np.append(data, np.zeros(8, np.uint8))  # as a batch has some bytes behind its last packet
    length = np.array([len(item) for item in messages], np.int32)
    found = fingerprint.of_bytes(data, np.cumsum(length, dtype=np.int64) - length, length)
    for index, one in enumerate(messages):
        for other, two in enumerate(messages):
            assert (found[index] == found[other]) == (one == two)
