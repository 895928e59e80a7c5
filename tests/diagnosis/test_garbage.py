"""Any bytes on any port: the doctor says something or nothing, and never fails."""

from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from edoras_tools.model import Endpoint

PORTS = st.sampled_from([1234, 1235, 2234, 2235, 2236, 40000])
HEADS = st.sampled_from(
    [
        b"",
        b"\x18\x27\0\0\0\x45\1\0",
        b"\x08\x08\xc0\1\0\xa5",
        b"\x08\x03\xc0\1\0\x25",
        b"\x18\x80\0\0\0\x11\6\0",
        b"\0\x14\3\0\0\0\3\0\0\0\x42",
        b"\0\x32\1\0\0\0\1\0\0\0\x42",
        b"\0\1\4\0\0\0\3\0\0\0\x42\x0b",
    ]
)
DATAGRAMS = st.lists(
    st.tuples(st.integers(-(10**10), 10**11), PORTS, PORTS, HEADS, st.binary(max_size=220)),
    min_size=1,
    max_size=30,
)


@settings(max_examples=examples(150))
@given(DATAGRAMS)
def test_garbage_in_verdicts_out(lab, datagrams):
    sent = [
        lab.at(at / 1e9, Endpoint("127.0.0.1", source), Endpoint("127.0.0.1", target), head + body)
        for at, source, target, head, body in datagrams
    ]
    diagnosis = lab.examine(sent, lab.missions("two-rovers"))
    assert diagnosis.datagrams <= len(sent)
    for item in diagnosis.verdicts:
        assert item.start_ns <= item.end_ns
    diagnosis.as_json()


def test_a_real_link_with_garbage_in_it(lab):
    sent, _ = lab.simulate("two-rovers", seconds=10)
    spoilt = [
        item._replace(payload=item.payload[: index % 90] if index % 7 == 0 else item.payload)
        for index, item in enumerate(sent)
    ]
    assert lab.examine(spoilt, lab.missions("two-rovers")).datagrams == len(sent)


def test_nothing_at_all(lab):
    diagnosis = lab.examine([])
    assert (diagnosis.datagrams, diagnosis.verdicts, diagnosis.routes, diagnosis.lost) == (0, (), [], 0)
