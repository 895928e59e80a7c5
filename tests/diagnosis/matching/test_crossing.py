"""Which way in a way out has, where several are equally likely."""

import numpy as np
import pytest

from edoras_tools.diagnosis.matching.crossing import assign_candidates

CAME = np.array([0x1827, 0x1828, 0x1829])


@pytest.mark.parametrize(
    ("alike", "expected"),
    [
        # Two robots are sent equal values, and both send them on: in the order of their MsgIds.
        ({0: [1, 0], 1: [1, 0]}, {0: 0, 1: 1}),
        # One can be of one only: the other has what is left.
        ({0: [1, 0], 1: [1]}, {0: 0, 1: 1}),
        ({0: [0], 1: [1, 0]}, {0: 0, 1: 1}),
        # One alone has the likeliest, which stands first.
        ({1: [1, 0]}, {1: 1}),
        # One that comes out twice has one way in.
        ({0: [2], 1: [2]}, {0: 2, 1: 2}),
    ],
)
def test_each_way_out_has_a_way_in_of_its_own_as_far_as_there_are(alike, expected):
    assert assign_candidates(alike, CAME, np.array([0x82A, 0x82B])) == expected
