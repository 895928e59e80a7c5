import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.diagnosis.accounting.claims import Claim, Counts, settle

SECOND = 10**9
KINDS = ("limit", "overflow")


def counts(limit, overflow):
    times = np.arange(len(limit) + 1) * SECOND
    return Counts(times, {"limit": np.array(limit, np.int64), "overflow": np.array(overflow, np.int64)})


@pytest.mark.parametrize(
    ("claims", "left"),
    [
        # Who can wait for a later second does, though it has one kind only.
        ([Claim(0, 0, 1, 1, ("overflow",)), Claim(1, 0, 0, 2, KINDS)], ([0, 0], [0, 0])),
        # Of two in one second, who has one kind only is served with it.
        ([Claim(0, 0, 0, 1, KINDS), Claim(1, 0, 0, 1, ("overflow",))], ([0, 0], [0, 1])),
    ],
)
def test_as_many_as_possible_are_explained(claims, left):
    there = counts([1, 0], [1, 1])
    settle(there, claims)
    assert all(sum(claim.taken.values()) == claim.number for claim in claims)
    assert tuple(there.left[kind].tolist() for kind in KINDS) == left


CLAIMS = st.lists(
    st.builds(
        lambda first, more, number, kinds: Claim(0, first, first + more, number, kinds),
        st.integers(-1, 5),
        st.integers(0, 6),
        st.integers(0, 9),
        st.sampled_from([KINDS, KINDS[:1], KINDS[1:], ()]),
    ),
    max_size=8,
)
GROWN = st.lists(st.integers(0, 9), min_size=5, max_size=5)


@given(GROWN, GROWN, CLAIMS)
def test_what_is_taken_and_what_is_left_are_what_was_counted(limit, overflow, claims):
    there = counts(limit, overflow)
    settle(there, claims)
    taken = {kind: sum(claim.taken.get(kind, 0) for claim in claims) for kind in KINDS}
    for kind, grown in zip(KINDS, (limit, overflow), strict=True):
        assert there.left[kind].min() >= 0
        assert int(there.left[kind].sum()) + taken[kind] == sum(grown)
    assert all(sum(claim.taken.values()) <= claim.number for claim in claims)
