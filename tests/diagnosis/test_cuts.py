"""Captures that begin late or end early, at many places each: the balance claims no more than is true."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
from effort import LONG, every
from places import ROOT

from edoras_tools.decode import Options
from edoras_tools.diagnosis.examination import Examination
from edoras_tools.io.formats.open import open_file
from edoras_tools.links import ROBOT_PORT
from edoras_tools.links.bare import CI, ROBOT_COMMAND
from edoras_tools.pipelines.workbench import Settings
from tests.support.balance import arrived, ended, wrong_rows

PLACES = 40
CI_PORT, TWIST = 1234, 0x1827
COMMANDS = ("a_rover", "c4_cmd_rate", "n3_cfs_restart", "n5_app_restarts", "p6b_extended_header")
FOLDER = ROOT / "tests/captures"
OTHERS = sorted(
    {path.name.partition(".")[0] for path in FOLDER.glob("*.pcap.zst")} - {"c1_tlm_rate_limit4", *COMMANDS}
)
PORTS = {"n10_uplink_loss": ((CI, 5234),)}
COUNTED = {"limit", "overflow", "unknown", "after"}
"""Causes that only 0x803 tells apart: a part of a capture may lack the count that says which it was."""


@pytest.fixture(scope="module")
def batches():
    """Return the batches of a capture by its name."""
    found = {}

    def read(name):
        if name not in found:
            found[name] = list(open_file(FOLDER / f"{name}.pcap.zst").batches())
        return found[name]

    return read


def examined(batches, start_ns, end_ns, ports=()):
    bench = Settings(configs=[], options=Options(ports=ports)).workbench()
    examination = Examination(bench.columns.context)
    for batch in batches:
        part = batch.take(np.flatnonzero((batch.time_ns >= start_ns) & (batch.time_ns <= end_ns)))
        if len(part):
            examination.add(part, bench.columns.decode(part))
    return examination.diagnose()


def never_arrived(batches):
    """Return when each command was sent that the robot never got in all of the capture."""
    items = [item for batch in batches for item in batch]
    got = {bytes(item.payload) for item in items if item.destination.port == ROBOT_PORT}
    sent = [item for item in items if item.destination.port == CI_PORT and item.payload[:2] == b"\x18\x27"]
    return np.array([item.time_ns for item in sent if bytes(item.payload[-ROBOT_COMMAND.size :]) not in got])


def cuts(batches, side):
    """Yield (start, end) of what is left: the first so many forty-firsts of the capture, or all but those."""
    first, last = int(batches[0].time_ns[0]), int(batches[-1].time_ns[-1])
    for place in every(7, range(1, PLACES + 1)):
        at = first + (last - first) * place // (PLACES + 1)
        yield (first, at) if side == "end" else (at, last)


def adds_up(found):
    """Check the sums of a diagnosis: of every row, every headline, and every hop of a command's chain."""
    assert wrong_rows(found.balance) == []
    for line in found.headlines:
        assert arrived(line) is None or line.sent == arrived(line) + ended(line).total(), line
    for chain in found.chains:
        counted = [hop for hop in chain.hops if hop.observed]
        for hop in counted:
            assert min(hop.came, hop.out, hop.lost, hop.doubled, hop.entered, *hop.rest.values()) >= 0
            assert hop.came + hop.doubled == hop.out + hop.lost + sum(hop.rest.values())
        for one, following in zip(chain.hops, chain.hops[1:], strict=False):
            assert following.came == one.out + following.entered - following.elsewhere, (
                chain.msg_id,
                following.hop,
            )


@pytest.mark.quick("n5*start")
@pytest.mark.parametrize("side", ["end", "start"])
@pytest.mark.parametrize("name", ["c1_tlm_rate_limit4", *COMMANDS])
def test_the_sum_is_right_at_every_cut(batches, name, side):
    whole, missing = batches(name), never_arrived(batches(name))
    lost, most_lost = [], []
    for start_ns, end_ns in cuts(whole, side):
        found = examined(whole, start_ns, end_ns)
        adds_up(found)
        lost.append(found.lost)
        most_lost.append(found.lost + found.uncertain)
        # What is said to be lost, and what is said to be missing, never came in the whole capture.
        most = int(((missing >= start_ns) & (missing <= end_ns)).sum())
        route = [row for row in found.balance if row.msg_id == TWIST]
        assert sum(row.all_lost + row.unaccounted for row in route) <= most
    # What was lost once stays lost, however long the capture goes on; there it may only be uncertain.
    more = pairwise(zip(lost, most_lost, strict=True))
    both = ((before, after) if side == "end" else (after, before) for before, after in more)
    assert all(shorter[0] <= longer[1] for shorter, longer in both)


def by_cause(found):
    """Return how many a diagnosis says are lost, by cause."""
    lost = Counter()
    for row in found.balance:
        for cause, number in row.lost.items():
            lost["counted" if cause in COUNTED else cause] += number
    return lost


@pytest.mark.quick("n10*")
@pytest.mark.parametrize("name", OTHERS)
def test_a_part_of_a_capture_tells_no_loss_that_the_whole_has_not(batches, name):
    read, ports = batches(name), PORTS.get(name, ())
    first_ns, last_ns = int(read[0].time_ns[0]), int(read[-1].time_ns[-1])
    whole = examined(read, first_ns, last_ns, ports)
    assert all(hop.entered == 0 for chain in whole.chains for hop in chain.hops)
    for side in ("end", "start"):
        for start_ns, end_ns in list(cuts(read, side))[:: 1 if LONG else 2]:
            found = examined(read, start_ns, end_ns, ports)
            adds_up(found)
            assert by_cause(found) <= by_cause(whole)


SBN_PORTS = (2234, 2235)


@pytest.mark.parametrize("ports", [SBN_PORTS, SBN_PORTS[:1], SBN_PORTS[1:]], ids=str)
def test_what_one_side_of_a_capture_shows_lost_is_lost_in_all_of_it(batches, ports):
    """Of d3: what both 0x803 count is 6,023, and 578 were sent to a peer that was not there."""
    whole = batches("d3_cpu1_cpu2")
    # Towards these ports, or, of both, in both directions.
    ways = [
        np.isin(item.destination_port, ports) | (np.isin(item.source_port, ports) & (len(ports) > 1))
        for item in whole
    ]
    parts = [item.take(np.flatnonzero(way)) for item, way in zip(whole, ways, strict=True)]
    found = examined(parts, int(whole[0].time_ns[0]), int(whole[-1].time_ns[-1]))
    adds_up(found)
    lost = by_cause(found)
    counted = {SBN_PORTS: 2192 + 3663 + 168, SBN_PORTS[:1]: 2192 + 168, SBN_PORTS[1:]: 3663}
    assert lost["counted"] == counted[ports]
    assert counted[SBN_PORTS] == 6023
    assert lost["sbn_timeout"] <= 578
    assert found.lost + found.unaccounted <= 6601


@pytest.mark.quick("flight-51", "ground-48")
@pytest.mark.parametrize("eightieth", [20, 36, 48, 49, 51, 53, 54, 60, 68, 74, 76])
@pytest.mark.parametrize("side", ["flight", "ground"])
def test_what_was_under_way_when_a_capture_began_is_told_as_such(batches, side, eightieth):
    """Two commands at 4 Hz each cross SBN 0.1 to 0.6 s after they were sent."""
    whole = batches(f"n12_two_hosts_{side}")
    first_ns, last_ns = int(whole[0].time_ns[0]), int(whole[-1].time_ns[-1])
    start_ns = first_ns + (last_ns - first_ns) * eightieth // 80
    found = examined(whole, start_ns, last_ns)
    adds_up(found)
    sent = [item.time_ns for one in whole for item in one if item.payload[:2] in {b"\x18\x27", b"\x18\x28"}]
    before = sum(start_ns - 10**9 <= when < start_ns for when in sent)
    entered = [hop for chain in found.chains for hop in chain.hops if hop.entered]
    assert {hop.hop for hop in entered} <= {"SBN_3_66_Pipe"}
    assert sum(hop.entered for hop in entered) <= before
    # The slow downlink lost 83, and nothing else did: counts that come late are no loss before CI.
    assert found.lost <= 83
    assert by_cause(found).keys() <= {"counted"}


RELAY_DROPPED = [76, 78, 81, 84, 91, 98, 103, 111, 114, 117, 119, 123, 124, 126, 127, 133, 138]
RELAY_DROPPED += [141, 145, 150, 155, 163, 170, 172, 174, 192, 198, 199, 205, 207, 208, 211, 222, 223]
"""Which commands the relay of n10 dropped, as it noted."""


@pytest.mark.each(2)
@pytest.mark.long("45", "135")
@pytest.mark.parametrize("tenths_of_a_second", every(5, range(0, 390, 9)))
def test_what_the_first_counts_do_not_tell_may_be_lost(tenths_of_a_second, batches):
    """A capture that begins amid commands does not show whether CI read the ones before its first count.

    In a few seconds a slow network explains what is missing as well: then it may wait.
    """
    whole = batches("n10_uplink_loss")
    sent = np.array([item.time_ns for one in whole for item in one if item.payload[:2] == b"\x18\x27"])
    start_ns, end_ns = int(whole[0].time_ns[0]) + tenths_of_a_second * 10**8, int(whole[-1].time_ns[-1])
    found = examined(whole, start_ns, end_ns, ports=((CI, 5234),))
    (line,) = [item for item in found.headlines if item.topic == f"0x{TWIST:04x}"]
    true = int((sent[RELAY_DROPPED] >= start_ns).sum())
    ends = ended(line)
    assert ends["lost"] <= true
    assert true <= ends["lost"] + ends["waiting"] + ends["not_captured"] + ends["uncertain"]
    if start_ns < sent[0]:
        assert (ends["lost"], ends["not_captured"]) == (true, 0)


BEGINS_IN_A_BACKLOG = (201.7, 204.0, 206.9, 208.9)
"""Seconds into c4 at which CI's socket is full: what it reads first was sent before."""


def lost_by(found, msg_id):
    return sum((Counter(row.lost) for row in found.balance if row.msg_id == msg_id), Counter())


@pytest.mark.quick("201.7-robot")
@pytest.mark.parametrize("robot", [True, False], ids=["robot", "no robot"])
@pytest.mark.parametrize("seconds", BEGINS_IN_A_BACKLOG)
def test_what_waited_when_the_capture_began_is_no_loss_of_what_it_shows(batches, seconds, robot):
    whole = batches("c4_cmd_rate")
    start_ns, end_ns = int(whole[0].time_ns[0]) + int(seconds * 1e9), int(whole[-1].time_ns[-1])
    kept = (
        whole if robot else [item.take(np.flatnonzero(item.destination_port != ROBOT_PORT)) for item in whole]
    )
    found, in_all = examined(kept, start_ns, end_ns), examined(whole, int(whole[0].time_ns[0]), end_ns)
    (fate,) = [item for item in in_all.case.commands.fates.values() if item.stream.msg_id == TWIST]
    sent_ns = in_all.case.rows.time_ns[fate.stream.rows]
    read = int((fate.arrived & (sent_ns >= start_ns)).sum())
    (line,) = [item for item in found.headlines if item.topic == f"0x{TWIST:04x}"]
    assert arrived(line) in ({read} if robot else {None})
    # More than what the pipe lost of these cannot be said to be lost there; the socket's is a lower bound.
    told = lost_by(found, TWIST)
    pipe = lost_by(in_all, TWIST)["limit"]
    later = sum(loss.lost for loss in in_all.case.losses if loss.kind == "limit" and loss.end_ns >= start_ns)
    assert told["limit"] <= min(pipe, later, line.sent - read - told["socket"])
    assert set(told) <= {"limit", "socket"}
    rest = line.missing + ended(line)["uncertain"]
    assert line.sent == (arrived(line) or 0) + rest or not robot
    # The counter's growth is told in full all the same.
    assert found.lost == told.total() + lost_by(found, None)["unknown"]


def test_an_application_that_is_only_started_in_the_capture_did_not_run_before(batches):
    whole = batches("n5_app_restarts")
    last = int(whole[-1].time_ns[-1])
    started = [item for batch in whole for item in batch if item.payload[:2] == b"\x18\x06"][-1]
    found = examined(whole, started.time_ns - 5 * 10**9, last)
    assert started.payload[6] == 4  # START_APP
    (line,) = [item for item in found.headlines if item.topic == f"0x{TWIST:04x}"]
    sent = [item.time_ns for batch in whole for item in batch if item.payload[:2] == b"\x18\x27"]
    before = sum(started.time_ns - 5 * 10**9 <= when <= started.time_ns for when in sent)
    ends = ended(line)
    assert ends["lost"] == pytest.approx(before, abs=2)
    assert arrived(line) is None
    assert line.sent == pytest.approx(ends["lost"] + ends["uncertain"], abs=3)
