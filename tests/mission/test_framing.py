"""``frames`` of a mission file: ports with transfer frames, and every mistake in it with its line."""

import pytest

from edoras_tools.decode import Context
from edoras_tools.errors import ConfigError
from edoras_tools.links.bare import CI, TO
from edoras_tools.mission import FramedPort, loads
from edoras_tools.wire.transfer_frames import FrameFormat

FILE = "link:\n  ros__parameters:\n    frames:\n"


def read(*lines):
    return loads({"f.yaml": (FILE + "".join(f"      {line}\n" for line in lines)).encode()})


def test_ports_formats_and_links():
    mission = read(
        "down: {port: 5111, kind: tm, length: 1115}",
        "up: {port: 5112, kind: tc, fecf: false, segment_header: true}",
        "far: {port: 5113, kind: aos, length: 892, ocf: true, insert_zone: 4, "
        "header_error_control: true, link: sbn}",
    )
    assert mission.frames[:2] == (
        FramedPort("down", 5111, FrameFormat("tm", 1115), TO, "f.yaml", 4),
        FramedPort("up", 5112, FrameFormat("tc", fecf=False, segment_header=True), CI, "f.yaml", 5),
    )
    assert mission.frames[2].format == FrameFormat("aos", 892, True, True, 4, True)
    assert (mission.frames[2].link.label, mission.warnings, mission.routes) == ("sbn", (), ())


def test_a_port_belongs_to_the_link_of_its_packets_alone():
    context = Context(read("down: {port: 5111, kind: tm, length: 99}"))
    assert [link.label for link in context.links if context.ports[link][5111]] == ["to"]
    assert 5111 in context.capture_ports()


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("down: {port: 5111}", "frames.down: kind is missing; tm, aos or tc is needed"),
        ("down: {port: 5111, kind: tn}", 'frames.down.kind: "tn" is not known; tm, aos or tc is needed'),
        ("down: {port: 5111, kind: tm}", "frames.down.length: missing; an integer from 1 to 2048 is needed"),
        ("down: {port: 5111, kind: tm, length: 8}", "frames.down.length: 8 has no room for data; at least 9"),
        ("down: {kind: tm, length: 99}", "frames.down.port: missing; an integer from 1 to 65535 is needed"),
        ("down: {port: 0, kind: tm, length: 99}", "frames.down.port: 0 is out of range"),
        (
            "down: {port: 5111, kind: tc, fecf: 1}",
            "frames.down.fecf: 1 is an integer; true or false is needed",
        ),
        ("down: {port: 5111, kind: tc, link: robot}", 'frames.down.link: "robot" is not known'),
        ("down: 5111", "frames.down: a value; write NAME: {port: 5111, kind: tm, length: 1115}"),
    ],
)
def test_a_mistake_has_its_line(line, said):
    with pytest.raises(ConfigError) as caught:
        read(line)
    assert str(caught.value).startswith(f"f.yaml:4: {said}")


def test_a_port_has_one_kind_of_frames():
    with pytest.raises(ConfigError, match=r"f\.yaml:5: frames.b.port: 5111 is the port of a already"):
        read("a: {port: 5111, kind: tc}", "b: {port: 5111, kind: tc}")


def test_what_is_not_read_is_told():
    (told,) = read("up: {port: 5112, kind: tc, length: 9}").warnings
    assert told.startswith(
        "f.yaml:4: frames.up.length: ignored; read are port, kind, link, fecf, transport, segment_header"
    )
