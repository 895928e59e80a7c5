from __future__ import annotations

import pytest
from bare_cfs import BareCfs
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.addons.lab.emulator.apps.network_apps import CommandIngest
from edoras_tools.addons.lab.emulator.messages import whole_packet
from edoras_tools.cfs.profile import SimProfile
from edoras_tools.wire import cfe

TWIST = cfe.emit_command(0x1827, 1, bytes(range(1, 69)), sequence_flags=0, with_checksum=False)


@pytest.fixture
def cfs() -> BareCfs:
    return BareCfs()


@pytest.fixture
def ingest(cfs) -> CommandIngest:
    ingest = CommandIngest(cfs)
    cfs.said()
    return ingest


def feed(cfs: BareCfs, ingest: CommandIngest, *datagrams: bytes) -> list[list[bytes | str]]:
    out: list[list[bytes | str]] = []
    for data in datagrams:
        ingest.receive_datagram(data)
        assert ingest.read()
        out.append([*cfs.published, *cfs.said()])
        cfs.published.clear()
    return out


def test_the_transcript_of_the_short_ones(cfs, ingest):
    dropped = "CI_LAB_APP 8: CI: L369, cmd 1827 00 dropped, bad length="
    assert feed(cfs, ingest, TWIST, TWIST[:7], TWIST[:6], TWIST[:1], b"") == [
        [TWIST],
        [f"{dropped}7"],
        [f"{dropped}6"],
        [f"{dropped}1"],
        [],
    ]
    # Error counter, command counter, checksums, socket; spare; packets, errors: as in e_ci_errors.
    assert ingest.housekeeping().hex() == "00000001000000000000000001000000030000000000" + "0000"


def test_a_length_field_that_disagrees_is_accepted_and_the_buffer_s_old_bytes_go_along(cfs, ingest):
    truncated, short_length = TWIST[:40], TWIST[:4] + b"\0\1" + TWIST[6:]
    assert feed(cfs, ingest, TWIST, truncated, short_length) == [[TWIST], [TWIST], [short_length]]
    assert whole_packet(short_length) == short_length[:8]


def test_a_datagram_over_the_buffer_is_cut_silently(cfs, ingest):
    data = cfe.emit_command(0x1827, 1, bytes(1392))
    assert feed(cfs, ingest, data) == [[data[:768]]]
    assert (ingest.ingest_packets, ingest.ingest_errors) == (1, 0)


@pytest.mark.parametrize(
    ("command", "says"),
    [
        (cfe.emit_command(0x1884, 0), ["CI_LAB_APP 5: CI: NOOP command"]),
        (
            cfe.emit_command(0x1884, 0, b"abcd"),
            ["CI_LAB_APP 16: Invalid msg length: ID = 0x1884,  CC = 0, Len = 12, Expected = 8"],
        ),
        (cfe.emit_command(0x1884, 9), []),  # it says nothing of it, and does not count it
        (cfe.emit_command(0x1884, 1), ["CI_LAB_APP 6: CI: RESET command"]),
    ],
)
def test_commands_to_ci_itself(cfs, ingest, command, says):
    ingest.command(command)
    assert cfs.said() == says


def test_the_socket_keeps_only_so_much():
    ingest = CommandIngest(BareCfs(SimProfile(socket_queue=3)))
    assert [ingest.receive_datagram(TWIST) for _ in range(5)] == [True] * 3 + [False] * 2
    assert (len(ingest.queue), ingest.socket_drops) == (3, 2)


@given(st.lists(st.binary(max_size=1500), max_size=20))
def test_any_datagram_is_counted_once(datagrams):
    cfs = BareCfs()
    ingest = CommandIngest(cfs)
    feed(cfs, ingest, *datagrams)
    assert ingest.ingest_packets == sum(len(data) >= 8 for data in datagrams)
    assert ingest.ingest_errors == sum(0 < len(data) < 8 for data in datagrams)
    assert not ingest.read()
    assert len(ingest.housekeeping()) == 24
