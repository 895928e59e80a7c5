from __future__ import annotations

import re

import pytest
from msgspec.structs import replace

from edoras_tools.errors import ConfigError
from edoras_tools.render.capture import tree
from edoras_tools.render.capture.tree import Region
from edoras_tools.render.terminal.palette import Paint
from edoras_tools.render.terminal.text import plain_cells

PLAIN = Paint(False)


def test_every_byte_once_with_its_offset():
    data = bytes(range(256)) * 2
    for width, per_line in ((80, 16), (60, 8)):
        lines = tree.dump_lines(data, [], width, PLAIN)
        assert [int(line[:4], 16) for line in lines] == list(range(0, len(data), per_line))
        digits = per_line * 3 + 1
        assert b"".join(bytes.fromhex(line[5 : 5 + digits]) for line in lines) == data


def test_ascii_stands_in_one_column():
    lines = tree.dump_lines(b"The quick brown fox \x00\x1b[2J\xff", [], 80, PLAIN)
    assert [line[56:] for line in lines] == ["The quick brown ", "fox ··[2J·"]


@pytest.mark.parametrize(
    ("chosen", "expected"),
    [
        ((0, 2), "[00 01]02 03 04 05 06 07 "),
        ((3, 4), " 00 01 02[03]04 05 06 07 "),
        ((5, 8), " 00 01 02 03 04[05 06 07]"),
        ((4, 4), " 00 01 02 03 04 05 06 07 "),
        ((6, 99), " 00 01 02 03 04 05[06 07 "),
    ],
)
def test_what_is_chosen_stands_in_brackets_without_colour(chosen, expected):
    (line,) = tree.dump_lines(bytes(range(8)), [], 80, PLAIN, highlight=chosen)
    assert line[5:].startswith(expected)


def test_brackets_close_at_the_end_of_a_line():
    first, second = tree.dump_lines(bytes(32), [], 80, PLAIN, highlight=(8, 16))
    assert first[5:55] == " 00 00 00 00 00 00 00 00 [00 00 00 00 00 00 00 00]"
    assert "[" not in second
    assert "]" not in second


def test_what_is_chosen_is_reversed_edge_to_edge_with_colour():
    (line,) = tree.dump_lines(bytes(range(8)), [Region("a", 0, 8, "cyan")], 80, Paint(True), highlight=(2, 5))
    assert "\x1b[7;36m02 03 04\x1b[0m" in line
    assert "[02" not in re.sub(r"\x1b\[[0-9;]*m", "", line)


def test_inner_regions_lie_over_outer_ones():
    shown = [Region("outer", 0, 8, "cyan"), Region("inner", 2, 4, "red"), Region("outside", 90, 99, "red")]
    (line,) = tree.dump_lines(bytes(range(8)), shown, 80, Paint(True))
    assert "\x1b[36m00 01\x1b[0m \x1b[31m02 03\x1b[0m \x1b[36m04 05 06 07\x1b[0m" in line


def test_regions_follow_the_base(packets):
    twist = packets["twist"]
    assert [(item.name, item.start, item.end) for item in tree.regions(twist)][:2] == [
        ("ccsds", 0, 6),
        ("cfe_command", 6, 8),
    ]
    assert [(item.name, item.start, item.end) for item in tree.regions(twist, "frame")][:2] == [
        ("headers", 0, 42),
        ("ccsds", 42, 48),
    ]
    fragment = replace(twist, datagram=twist.datagram._replace(payload_offset=-1))
    assert tree.regions(fragment, "frame") == []


def test_neighbours_of_one_name_are_one_region(packets):
    names = [item.name for item in tree.regions(packets["subscriptions"])]
    assert names == ["sbn", "sbn_sub", "sbn_subscription"]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("ccsds", (0, 6)),
        ("ccsds.packet_data_length", (4, 6)),
        ("ros.angular", (52, 76)),
        ("ros.angular.z", (68, 76)),
    ],
)
def test_choose_by_name(packets, name, expected):
    assert tree.choose(packets["twist"], name) == expected


@pytest.mark.parametrize(
    ("name", "complaint"),
    [
        ("udp", "packet 1 has no layer 'udp'; there are ccsds, cfe_command, edoras, cdr, ros"),
        (
            "edoras.length",
            "layer edoras of packet 1 has no field 'length'; there are buffer_length, buffer_capacity",
        ),
    ],
)
def test_choose_says_what_there_is(packets, name, complaint):
    with pytest.raises(ConfigError, match=f"^{re.escape(complaint)}$"):
        tree.choose(packets["twist"], name)


def test_choose_in_a_packet_without_layers(packets):
    bare = replace(packets["twist"], layers=())
    with pytest.raises(ConfigError, match="there are no layers"):
        tree.choose(bare, "ccsds")


@pytest.mark.parametrize("width", [20, 40, 60, 200])
def test_legend_keeps_the_width(packets, width):
    shown = tree.regions(packets["twist"], "frame")
    lines = tree.legend(shown, width, Paint(True))
    assert all(plain_cells(line) <= width for line in lines)
    assert sum(line.count("■") for line in lines) == len(shown)


def test_empty():
    assert tree.dump_lines(b"", [], 80, PLAIN, highlight=(0, 0)) == []
    assert tree.legend([], 80, PLAIN) == []
