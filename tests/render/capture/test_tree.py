from __future__ import annotations

import pytest
from msgspec.structs import replace

from edoras_tools.errors import ConfigError, WireError
from edoras_tools.model import Finding, Layer, LayerField
from edoras_tools.render.capture import tree
from edoras_tools.render.terminal.palette import Paint
from edoras_tools.render.terminal.text import plain_cells

PLAIN = Paint(False)


def text(decoded, width=120):
    return "\n".join(tree.tree_lines(decoded, width, PLAIN))


def with_fields(decoded, *fields):
    return replace(decoded, layers=(Layer("ros", "a message", 0, 76, tuple(fields)),))


def test_dotted_names_nest(packets):
    rows = [row for row in tree.rows(packets["twist"]) if row.style == "green" or row.role == "group"]
    drawn = [(row.role, row.depth, row.label) for row in rows]
    assert drawn == [
        ("layer", 0, "geometry_msgs/msg/Twist"),
        ("group", 1, "linear"),
        *(("field", 2, axis) for axis in "xyz"),
        ("group", 1, "angular"),
        *(("field", 2, axis) for axis in "xyz"),
    ]


def test_a_group_spans_its_fields(packets):
    angular = next(row for row in tree.rows(packets["twist"]) if row.label == "angular")
    assert (angular.start, angular.end) == (52, 76)
    assert "52-75     ▾ angular" in text(packets["twist"])


def test_fields_of_one_name_stay_apart(packets):
    decoded = with_fields(packets["twist"], LayerField("x", 1, 0, 4), LayerField("x", 2, 4, 8))
    assert [row.value for row in tree.rows(decoded) if row.label == "x"] == ["1", "2"]


def test_a_group_that_comes_back_is_one_group(packets):
    fields = LayerField("a.x", 1, 0, 4), LayerField("b", 2, 4, 8), LayerField("a.y", 3, 8, 12)
    labels = [row.label for row in tree.rows(with_fields(packets["twist"], *fields)) if row.depth]
    assert labels == ["a", "x", "y", "b"]


@pytest.mark.parametrize(
    ("field", "expected"),
    [
        (LayerField("apid", 39, 0, 2, "0x027"), "0x027 (39)"),
        (LayerField("msg_id", 0x1827, 0, 2, "0x1827 /cmd_vel"), "0x1827 /cmd_vel"),
        (LayerField("packet_type", 1, 0, 1, "telecommand (1)"), "telecommand (1)"),
        (LayerField("count", 4, 0, 1, "4"), "4"),
        (LayerField("count", 4, 0, 1), "4"),
        (LayerField("spare", b"\0\1", 0, 2, "0001"), "00 01"),
        (LayerField("app_name", "CFE_SB", 0, 6, "CFE_SB"), '"CFE_SB"'),
        (LayerField("data", [1, 2.5, True], 0, 6), "[1, 2.5, true]"),
        (LayerField("data", list(range(100)), 0, 6), "] (100 items)"),
        (LayerField("data", bytes(100), 0, 6), "… (100 bytes)"),
        (LayerField("data", "a" * 2000, 0, 6), "(2,000 characters)"),
        (LayerField("data", [{"x": 1}], 0, 6), "[{x: 1}]"),
        (LayerField("data", None, 0, 0), "None"),
    ],
)
def test_values_as_people_read_them(packets, field, expected):
    (row,) = [row for row in tree.rows(with_fields(packets["twist"], field)) if row.role == "field"]
    assert row.value.endswith(expected)


def test_repeated_layers_take_a_line_each(packets):
    lines = [line for line in text(packets["subscriptions"]).splitlines() if "▸" in line]
    assert len(lines) == 4
    assert "msg_id: 0x00001827 (6183)  priority: 0  reliability: 0" in lines[0]


def test_documentation_stands_beside_fields_where_there_is_room(packets):
    assert "bytes of CDR that follow" in text(packets["twist"], 120)
    assert "bytes of CDR that follow" not in text(packets["twist"], 80)


def test_what_is_wrong_comes_last_the_gravest_first(packets):
    lines = text(packets["truncated"], 80).splitlines()
    marks = [line for line in lines if line[0] in "✗!·"]
    assert [line.split()[1] for line in marks] == [
        "truncated",
        "length_mismatch",
        "sequence_unset",
        "stopped",
    ]
    assert lines[-1].endswith("cfe_command at byte 6 needs 2 bytes, 1 are there")


def test_a_frame_that_the_capture_cut_says_so(packets):
    short = packets["twist"].datagram._replace(original_length=1000)
    assert "in a frame of 118 (882 more were cut off)" in text(replace(packets["twist"], datagram=short))


def test_a_long_value_is_wrapped_then_cut(packets):
    words = LayerField("message", "word " * 180, 0, 900)
    decoded = replace(with_fields(packets["twist"], words), findings=Finding(0))
    lines = text(decoded, 80).splitlines()
    inside = [line for line in lines if "word" in line]
    assert len(inside) == 8
    assert inside[-1].endswith("…")
    assert {line.index("word") for line in inside[1:]} == {inside[0].index('"word')}


def test_a_stop_of_several_lines_stays_one(packets):
    decoded = replace(packets["twist"], stop=WireError("one\ntwo"), findings=Finding(0))
    assert text(decoded).splitlines()[-1] == r"✗ stopped  one\ntwo"


@pytest.mark.parametrize("width", [40, 60, 80, 120, 200])
def test_never_exceeds_the_width_and_colour_adds_none(packets, width):
    for item in packets.values():
        plain, painted = tree.tree_lines(item, width, PLAIN), tree.tree_lines(item, width, Paint(True))
        assert all(plain_cells(line) <= width for line in painted)
        assert [plain_cells(line.rstrip()) for line in plain] == [
            plain_cells(line) - (len(line) - len(line.rstrip())) for line in plain
        ]
        assert len(plain) == len(painted)
        assert any("\x1b[" in line for line in painted)
        assert not any("\x1b" in line for line in plain)


@pytest.mark.parametrize("width", [80, 120, 200])
def test_looks_as_drawn(packets, golden, width):
    views = [
        "\n".join(
            tree.packet_lines(item, width, colour=False, highlight="ccsds" if item.layer("ccsds") else "")
        )
        for item in packets.values()
    ]
    golden(f"packet_{width}.txt", "\n\n".join(views) + "\n")


def test_bytes_stand_beside_the_tree_where_there_is_room(packets):
    assert not any("UDP payload" in line and "Packet" in line for line in lines(packets, 139))
    assert any("UDP payload" in line and "Packet" in line for line in lines(packets, 140))


def lines(packets, width):
    return tree.packet_lines(packets["twist"], width, colour=False)


@pytest.mark.parametrize("width", [44, 80, 139, 140, 200])
@pytest.mark.parametrize("base", ["payload", "frame"])
@pytest.mark.parametrize("colour", [False, True])
def test_never_exceeds_the_width(packets, width, base, colour):
    for item in packets.values():
        for line in tree.packet_lines(item, width, colour=colour, base=base):
            assert plain_cells(line) <= width
            assert ("\x1b" in line) <= colour


def test_points_into_the_frame(packets):
    shown = tree.packet_lines(packets["twist"], 80, colour=False, highlight="cfe_command", base="frame")
    assert "Frame, 118 bytes, cfe_command at 48-49" in shown
    assert any("[01 00]" in line for line in shown)


def test_a_payload_of_fragments_has_no_place_in_its_frame(packets):
    fragment = replace(packets["twist"], datagram=packets["twist"].datagram._replace(payload_offset=-1))
    shown = tree.packet_lines(fragment, 80, colour=False, highlight="cfe_command", base="frame")
    assert "Frame, 118 bytes" in shown


def test_an_unknown_layer_is_a_mistake(packets):
    with pytest.raises(ConfigError):
        tree.packet_lines(packets["twist"], 80, colour=False, highlight="tcp")
