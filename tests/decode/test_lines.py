"""That both ways give the same lines, ``test_agreement`` tests on every packet."""

from collections import Counter
from contextlib import closing

import pytest
from places import CAPTURES

from edoras_tools.decode import ColumnDecoder, Context, Dissector, contents
from edoras_tools.decode.filters.rows import ColumnRows
from edoras_tools.decode.lines import PacketLines
from edoras_tools.io.formats.open import open_file
from edoras_tools.model import concatenate


@pytest.fixture(scope="module")
def rows():
    with closing(open_file(CAPTURES / "a_rover.pcap")) as source:
        batch = concatenate(list(source.batches()))
    context = Context()
    return ColumnRows(context, 0, batch, ColumnDecoder(context).decode(batch))


@pytest.mark.parametrize("size", [1, 7, 16, 1000])
def test_any_number_at_once_gives_the_same(rows, size):
    made = PacketLines(rows.context)
    whole = list(made.of(rows))
    parts = [rows.take(rows.indices()[first : first + size]) for first in range(0, len(rows), size)]
    assert [line for part in parts for line in made.of(part)] == whole
    assert [line.number for line in whole] == rows.batch.number.tolist()


def test_only_what_columns_do_not_tell_is_dissected_and_equal_bytes_once(rows, monkeypatch):
    seen = Counter()

    class Counting(Dissector):
        def dissect(self, datagram):
            seen[datagram.payload] += 1
            return super().dissect(datagram)

    monkeypatch.setattr(contents, "Dissector", Counting)
    made = list(PacketLines(rows.context).of(rows))
    alone = {rows.batch[row].payload for row in (rows.columns.packet_offset < 0).nonzero()[0].tolist()}
    assert len(made) == len(rows) > 1800
    assert seen.keys() == alone
    assert set(seen.values()) == {1}
