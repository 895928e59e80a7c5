"""The JSON of every ROS type from columns; that packets are told alike, ``decode/test_agreement`` tests."""

import json
import math
from collections import Counter
from contextlib import closing
from itertools import accumulate
from random import Random

import numpy as np
import pytest
from effort import examples
from places import CAPTURES

from edoras_tools.decode import ColumnDecoder, Context, Dissector, lines
from edoras_tools.decode.filters.rows import ColumnRows
from edoras_tools.io.formats.open import open_file
from edoras_tools.links.bare import CI
from edoras_tools.mission import Mission, Route
from edoras_tools.model import concatenate
from edoras_tools.pipelines.capture.packet_json import PacketTexts, as_json
from edoras_tools.pipelines.sending.inject import arbitrary
from edoras_tools.ros import TypeStore
from edoras_tools.ros.cdr.plan import Repeat
from edoras_tools.wire import cfe
from edoras_tools.wire.envelope import DEFAULT

TYPES = TypeStore()


def counted(monkeypatch, rows):
    """Return the texts of rows, and how often each payload was dissected."""
    seen = Counter()

    class Counting(Dissector):
        def dissect(self, datagram):
            seen[datagram.payload] += 1
            return super().dissect(datagram)

    monkeypatch.setattr(lines, "Dissector", Counting)
    monkeypatch.setattr(lines, "_FEW", 0)
    return PacketTexts(rows.context).of(rows), seen


def batch_of(template, payloads):
    """Return the first row of a batch once for each payload."""
    ends = np.array(list(accumulate(map(len, payloads))))
    batch = template.take(np.zeros(len(payloads), np.int64))
    columns = {name: getattr(batch, name) for name in batch.__struct_fields__}
    columns["data"] = np.frombuffer(b"".join(payloads), np.uint8)
    columns["length"] = np.array(list(map(len, payloads)), np.int32)
    columns["offset"] = columns["frame_offset"] = ends - columns["length"]
    columns["frame_length"] = columns["original_length"] = columns["length"]
    columns["destination_port"] = np.full(len(payloads), 1234, np.uint16)
    return type(batch)(**columns)


@pytest.fixture(scope="module")
def one():
    with closing(open_file(CAPTURES / "a_rover.pcap")) as source:
        return concatenate(list(source.batches())).take(slice(0, 1))


def odd(values):
    """Put numbers that JSON does not know, and characters that it escapes, where there are such fields."""
    if isinstance(values, dict):
        return {name: odd(value) for name, value in values.items()}
    if isinstance(values, list):
        return [odd(value) for value in values]
    if isinstance(values, float):
        return (math.nan, math.inf, -0.0)[int(values) % 3]
    return '%s "\\\n é 🛰'[: max(1, len(values))] if isinstance(values, str) else values


@pytest.mark.long
def test_every_type_is_told_alike(one, monkeypatch):
    """Those that hold lists of messages with lists are dissected, and no others."""
    routes, packets, nested = [], [], set()
    for msg_id, name in enumerate(TYPES.types(), 0x1A00):
        dice = Random(name)
        messages = [{}, {}, *(arbitrary(TYPES, name, dice) for _ in range(examples(3, 3, 1)))]
        messages.append(odd(messages[-1]))
        cdrs = [TYPES.encode(name, values, big_endian=big) for values in messages for big in (False, True)]
        packets += [cfe.emit_command(msg_id, 1, DEFAULT.emit(cdr)) for cdr in cdrs]
        routes.append(Route("/%s", name, msg_id, CI, "command"))
        steps = [step for step in TYPES.plan(name)[1].steps if isinstance(step, Repeat)]
        if any(step.plan.lists and not step.plan.single for step in steps):
            nested.update(packets[-len(cdrs) :])
    batch, context = batch_of(one, packets), Context(Mission(routes=tuple(routes)), TYPES)
    rows = ColumnRows(context, 0, batch, ColumnDecoder(context).decode(batch))
    dissector = Dissector(context, detail=False)
    texts, seen = counted(monkeypatch, rows)
    for row, text in enumerate(texts):
        told = {"schema": 1, **as_json(dissector.dissect(batch[row]))}
        assert text == json.dumps(told, ensure_ascii=False, separators=(",", ":"))
        assert told["message"] is not None, told
    assert seen.keys() == nested
    assert 0 < len(nested) < len(packets) / 5


def test_packets_that_columns_tell_are_not_dissected(monkeypatch):
    with closing(open_file(CAPTURES / "a_rover.pcap")) as source:
        batch = concatenate(list(source.batches()))
    context = Context()
    rows = ColumnRows(context, 0, batch, ColumnDecoder(context).decode(batch))
    texts, seen = counted(monkeypatch, rows)
    assert len(texts) == len(rows) > 1800
    alone = {batch[row].payload for row in (rows.columns.packet_offset < 0).nonzero()[0].tolist()}
    assert seen == Counter(alone)
