from __future__ import annotations

from pathlib import Path

import pytest

from edoras_tools.io.formats.table import FILE_FORMATS, MCAP, PCAP, PCAPNG, READ, WRITTEN, written_as


@pytest.mark.parametrize("item", FILE_FORMATS, ids=lambda item: item.name)
def test_reader_and_writer_are_where_the_table_says(item):
    home = f"edoras_tools.io.formats.{item.name.lower()}"
    assert item.source().__module__ in {home, f"{home}.reader"}
    assert {"write", "flush", "close"} <= set(dir(item.sink()))


@pytest.mark.parametrize(
    ("name", "wanted"),
    [
        ("a.pcap", PCAP),
        ("a.PCAPNG", PCAPNG),
        ("x/a.b.mcap", MCAP),
        ("a", None),
        ("a.gz", None),
        ("mcap", None),
    ],
)
def test_the_suffix_tells_what_is_written(name, wanted):
    assert written_as(Path(name)) is wanted


def test_texts_name_all_files():
    assert READ == "pcap, pcapng or MCAP"
    assert WRITTEN == ".mcap, .pcapng or .pcap"
