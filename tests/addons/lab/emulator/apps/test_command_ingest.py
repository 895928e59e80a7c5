from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.addons.lab.emulator.apps.command_ingest import CommandIngest
from edoras_tools.addons.lab.emulator.messages import whole_packet
from edoras_tools.cfs.profile import SimProfile
from edoras_tools.wire import cfe

TWIST = cfe.emit_command(0x1827, 1, bytes(range(1, 69)), sequence_flags=0, with_checksum=False)


@pytest.fixture
def ingest() -> CommandIngest:
    return CommandIngest(SimProfile())


def feed(ingest: CommandIngest, *datagrams: bytes) -> list[bytes | str | None]:
    out: list[bytes | str | None] = []
    for data in datagrams:
        ingest.receive_datagram(data)
        ingested = ingest.read()
        assert ingested is not None
        out.append(str(ingested.event).strip() if ingested.event else ingested.packet)
    return out


def test_the_transcript_of_the_short_ones(ingest):
    dropped = "CI_LAB_APP 8: CI: L369, cmd 1827 00 dropped, bad length="
    assert feed(ingest, TWIST, TWIST[:7], TWIST[:6], TWIST[:1], b"") == [
        TWIST,
        f"{dropped}7",
        f"{dropped}6",
        f"{dropped}1",
        None,
    ]
    # Error counter, command counter, checksums, socket; spare; packets, errors: as in e_ci_errors.
    assert ingest.housekeeping().hex() == "00000001000000000000000001000000030000000000" + "0000"


def test_a_length_field_that_disagrees_is_accepted_and_the_buffer_s_old_bytes_go_along(ingest):
    truncated, short_length = TWIST[:40], TWIST[:4] + b"\0\1" + TWIST[6:]
    assert feed(ingest, TWIST, truncated, short_length) == [TWIST, TWIST, short_length]
    assert whole_packet(short_length) == short_length[:8]


def test_a_datagram_over_the_buffer_is_cut_silently(ingest):
    data = cfe.emit_command(0x1827, 1, bytes(1392))
    (packet,) = feed(ingest, data)
    assert packet == data[:768]
    assert (ingest.ingest_packets, ingest.ingest_errors) == (1, 0)


@pytest.mark.parametrize(
    ("command", "says"),
    [
        (cfe.emit_command(0x1884, 0), "CI_LAB_APP 5: CI: NOOP command"),
        (
            cfe.emit_command(0x1884, 0, b"abcd"),
            "CI_LAB_APP 16: Invalid msg length: ID = 0x1884,  CC = 0, Len = 12, Expected = 8",
        ),
        (cfe.emit_command(0x1884, 9), "None"),  # it says nothing of it, and does not count it
        (cfe.emit_command(0x1884, 1), "CI_LAB_APP 6: CI: RESET command"),
    ],
)
def test_commands_to_ci_itself(ingest, command, says):
    assert str(ingest.command(command)) == says


def test_the_socket_keeps_only_so_much():
    ingest = CommandIngest(SimProfile(socket_queue=3))
    assert [ingest.receive_datagram(TWIST) for _ in range(5)] == [True] * 3 + [False] * 2
    assert (len(ingest), ingest.socket_drops) == (3, 2)


@given(st.lists(st.binary(max_size=1500), max_size=20))
def test_any_datagram_is_counted_once(datagrams):
    ingest = CommandIngest(SimProfile())
    for data in datagrams:
        feed(ingest, data)
    assert ingest.ingest_packets == sum(len(data) >= 8 for data in datagrams)
    assert ingest.ingest_errors == sum(0 < len(data) < 8 for data in datagrams)
    assert ingest.read() is None
    assert len(ingest.housekeeping()) == 24
