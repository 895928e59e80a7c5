"""Which instance takes up the counts of another: asked of all that came before at once."""

from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.diagnosis.evidence.clocks import steady

counts = st.dictionaries(st.tuples(st.integers(0, 5)), st.integers(0, 40), max_size=6)


def goes_on(last: dict[tuple[int, ...], int], begin: dict[tuple[int, ...], int]) -> bool:
    """Ask one pair, as it is defined."""
    steps = [(begin[item] - last[item]) % steady._MODULUS for item in begin if item in last]
    taken = sum(0 < step <= steady._NEXT for step in steps)
    return len(steps) > 2 and taken > steady._MOST_GO_ON * len(steps)


@given(last=st.lists(counts, max_size=8), begin=counts, end=st.integers(0, 8))
def test_counts_are_taken_up_as_of_each_pair(
    last: list[dict[tuple[int, ...], int]], begin: dict[tuple[int, ...], int], end: int
) -> None:
    end = min(end, len(last))
    pairs = [place for place in range(end) if goes_on(last[place], begin)]
    assert steady._taken_up(steady._places(last), begin, end) == pairs


def test_some_are_taken_up() -> None:
    last = [{(stream,): 7 for stream in range(4)}, {(stream,): 9000 for stream in range(4)}]
    assert steady._taken_up(steady._places(last), {(stream,): 8 for stream in range(4)}, 2) == [0]
