"""Samples that have no topic, or whose type is not known, are counted and told."""

import numpy as np
from rtps import announced, data, message
from rtps_batches import batch_of

from edoras_tools.addons.rtps.samples import LeftSamples
from edoras_tools.decode import ColumnDecoder, Context
from edoras_tools.ros import TypeStore

CDR = b"\0\1\0\0" + bytes(48)


def told(*payloads):
    """Return the notes on some datagrams."""
    decoder, left = ColumnDecoder(Context(types=TypeStore())), LeftSamples()
    for number, payload in enumerate(payloads, 1):
        batch = batch_of(payload, number=number)
        decoder.decode(batch)
        left.add(batch, np.arange(1), decoder.context.endpoints)
    return left.notes(decoder.context.types, decoder.context.endpoints)


def test_samples_are_told_by_when_their_writer_was_announced():
    one, two = message(data(1, CDR)), message(data(2, CDR), data(3, CDR))
    assert told(announced(), one, two) == []
    assert told(one, two, announced(), one) == [
        "DDS: 3 samples (and copies) came before the writer was announced: no topic"
    ]
    assert told(one, two) == [
        "DDS: 3 samples (and copies) of 1 writer that the capture does not announce: no topic"
    ]


def test_samples_of_unknown_types_are_told():
    mine = announced("rt/mine", "my::msg::dds_::Thing_")
    assert told(message(data(1, CDR)), mine, message(data(2, CDR))) == [
        "DDS: 1 sample (and copies) came before the writer was announced: no topic",
        "DDS: 1 sample of unknown types (my/msg/Thing): only bytes; --set msg-path adds types",
    ]
    assert told(announced("rq/mineRequest", "my::srv::dds_::Thing_Request_"), message(data(1, CDR))) == []
