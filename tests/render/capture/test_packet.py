from __future__ import annotations

import pytest
from msgspec.structs import replace

from edoras_tools.errors import ConfigError
from edoras_tools.render.capture import packet
from edoras_tools.render.terminal.text import plain_cells


@pytest.mark.parametrize("width", [80, 120, 200])
def test_looks_as_drawn(packets, golden, width):
    views = [
        "\n".join(
            packet.packet_lines(item, width, colour=False, highlight="ccsds" if item.layer("ccsds") else "")
        )
        for item in packets.values()
    ]
    golden(f"packet_{width}.txt", "\n\n".join(views) + "\n")


def test_bytes_stand_beside_the_tree_where_there_is_room(packets):
    assert not any("UDP payload" in line and "Packet" in line for line in lines(packets, 139))
    assert any("UDP payload" in line and "Packet" in line for line in lines(packets, 140))


def lines(packets, width):
    return packet.packet_lines(packets["twist"], width, colour=False)


@pytest.mark.parametrize("width", [44, 80, 139, 140, 200])
@pytest.mark.parametrize("base", ["payload", "frame"])
@pytest.mark.parametrize("colour", [False, True])
def test_never_exceeds_the_width(packets, width, base, colour):
    for item in packets.values():
        for line in packet.packet_lines(item, width, colour=colour, base=base):
            assert plain_cells(line) <= width
            assert ("\x1b" in line) <= colour


def test_points_into_the_frame(packets):
    shown = packet.packet_lines(packets["twist"], 80, colour=False, highlight="cfe_command", base="frame")
    assert "Frame, 118 bytes, cfe_command at 48-49" in shown
    assert any("[01 00]" in line for line in shown)


def test_a_payload_of_fragments_has_no_place_in_its_frame(packets):
    fragment = replace(packets["twist"], datagram=packets["twist"].datagram._replace(payload_offset=-1))
    shown = packet.packet_lines(fragment, 80, colour=False, highlight="cfe_command", base="frame")
    assert "Frame, 118 bytes" in shown


def test_an_unknown_layer_is_a_mistake(packets):
    with pytest.raises(ConfigError):
        packet.packet_lines(packets["twist"], 80, colour=False, highlight="tcp")
