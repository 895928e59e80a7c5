"""Samples in fragments: in any order, again and again, lost, odd and huge ones; memory is bounded."""

import numpy as np
import pytest
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from rtps import made, message
from rtps_batches import batch_of

from edoras_tools.addons.rtps import samples as fragmented
from edoras_tools.addons.rtps.samples import LARGEST_SAMPLE, FragmentedSamples
from edoras_tools.addons.rtps.wire import SubmessageKind
from edoras_tools.decode import ColumnDecoder, Context, Dissector
from edoras_tools.ros import TypeStore


def fragment(body, first, count, step, sequence=1, size=None, flags=1):
    """Return the message with some fragments of a sample."""
    part = body[(first - 1) * step : (first - 1 + count) * step]
    return message(
        made(SubmessageKind.INFO_TS, flags, seconds=5, fraction=1 << 30),
        made(
            SubmessageKind.DATA_FRAG,
            flags,
            part,
            writer_sn=sequence,
            octets_to_inline_qos=28,
            fragment_starting_num=first,
            fragments_in_submessage=count,
            fragment_size=step,
            sample_size=len(body) if size is None else size,
        ),
    )


def put_together(batches, samples=None):
    """Return the samples that come out, and what put them together."""
    context = Context(types=TypeStore())
    samples, decoder, found = samples or FragmentedSamples(), ColumnDecoder(context), []
    for batch in batches:
        whole, columns = samples.take(batch, decoder.decode(batch), decoder.decode)
        assert (columns.link == 8).all()
        assert (np.diff(whole.number) >= 0).all()
        for row in np.flatnonzero(whole.original_length < 0).tolist():
            data = whole[row].payload
            packet = Dissector(context).dissect(whole[row])
            assert packet.stop is None
            values = packet.layers[-1].values()
            found.append((int(whole.number[row]), values["writer_sn"], data[20 + 12 + 24 :]))
    return found, samples


@settings(max_examples=examples(200), deadline=None)
@given(st.data())
def test_any_order_and_any_number_of_copies(draw):
    step = draw.draw(st.integers(1, 40))
    body = bytes(range(256))[: draw.draw(st.integers(1, 200))]
    total = -(-len(body) // step)
    order = draw.draw(st.lists(st.integers(1, total), max_size=30))
    flags = draw.draw(st.sampled_from([0, 1]))
    pieces = [(first, draw.draw(st.integers(1, total - first + 1))) for first in order]
    payloads = [fragment(body, first, count, step, flags=flags) for first, count in pieces]
    cut = draw.draw(st.integers(0, len(payloads)))
    batches = [
        batch_of(*part, number=at) for part, at in ((payloads[:cut], 1), (payloads[cut:], cut + 1)) if part
    ]
    found, samples = put_together(batches)
    known, again, expected = set(), 0, []
    for number, (first, count) in enumerate(pieces, 1):
        octets = set(range((first - 1) * step, min((first - 1 + count) * step, len(body))))
        new = octets - known
        again += len(octets & known)
        known |= octets
        if len(known) == len(body) and (new or again >= len(body)):
            expected.append((number, 1, body))
            again -= 0 if new else len(body)
    assert found == expected
    assert samples.whole == bool(expected)


@pytest.mark.parametrize(
    "odd",
    [
        {"size": LARGEST_SAMPLE + 1},
        {"size": (1 << 32) - 1},
        {"size": 0},
        {"step": 0},
        {"first": 0},
        {"first": 99},
        {"count": 0},
        {"count": 9, "size": 90},  # the bytes are not there
    ],
    ids=str,
)
def test_odd_fragments_are_left_out(odd):
    values = {"first": 1, "count": 1, "step": 10, **odd}
    body = bytes(30)
    raw = fragment(body[: 10 * values["count"]], **values)
    found, samples = put_together([batch_of(raw)])
    assert (found, samples.too_large, samples._bytes) == ([], 1, 0)
    assert samples.notes() == ["DDS: 1 fragment left out: of samples over 32 MiB, or odd"]


def test_a_sample_that_changes_its_size_keeps_the_first():
    body = bytes(range(30))
    raws = [fragment(body, 1, 1, 10), fragment(body, 2, 1, 10, size=29), fragment(body, 2, 2, 10)]
    found, samples = put_together([batch_of(*raws)])
    assert (found, samples.too_large) == ([(3, 1, body)], 1)


def test_what_never_ends_gives_way(monkeypatch):
    monkeypatch.setattr(fragmented, "MOST_FRAGMENT_BYTES", 1000)
    body = bytes(300)
    raws = [fragment(body, 1, 1, 10, sequence=number) for number in range(1, 101)]
    _, samples = put_together([batch_of(*raws)])
    assert samples._bytes <= 1000
    assert samples.given_up == 97
    monkeypatch.setattr(fragmented, "MOST_OPEN", 2)
    put_together([batch_of(*raws)], samples)
    assert len(samples._open) == 2
    assert samples.notes() == ["DDS: of 200 samples not all fragments came"]


def test_a_copy_is_a_message_again_and_what_is_asked_for_again_is_none():
    body = bytes(range(30))
    pieces = [fragment(body, first, 1, 10) for first in (1, 2, 3)]
    twice = [raw for raw in pieces for _ in range(2)]  # to two readers
    found, samples = put_together([batch_of(*pieces, pieces[1], *pieces)])
    assert [number for number, *_ in found] == [3, 6]
    assert samples.notes() == ["DDS: 1 sample put together from fragments"]
    assert [number for number, *_ in put_together([batch_of(*twice)])[0]] == [5, 6]


def test_few_whole_samples_are_kept(monkeypatch):
    monkeypatch.setattr(fragmented, "MOST_WHOLE_BYTES", 100)
    body = bytes(30)
    raws = [fragment(body, first, 1, 10, sequence) for sequence in range(1, 9) for first in (1, 2, 3)]
    found, samples = put_together([batch_of(*raws), batch_of(*raws, number=25)])
    assert len(samples._whole) == 3
    assert samples._whole_bytes == 90
    assert (len(found), samples.whole) == (11, 8)  # copies of the last three
    assert samples.notes() == ["DDS: 8 samples put together from fragments"]
