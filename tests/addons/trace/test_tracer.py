"""The way of single messages, beside the balance, the doctor's delays and what was counted on both sides."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
import truth
from places import ROOT

from edoras_tools.addons.trace.rounds import rounds_into, rounds_out
from edoras_tools.addons.trace.tracing import Tracer, messages_in, with_ending
from edoras_tools.diagnosis.matching.crossing import latency_of
from edoras_tools.diagnosis.missing import missing
from edoras_tools.pipelines.clocks import open_aligned
from edoras_tools.pipelines.doctor import examine
from edoras_tools.pipelines.workbench import Settings

FOLDER = ROOT / "tests/captures"
ROVER = (ROOT / "samples/missions/rover_ground.yaml",)
TWO_ROVERS = (ROOT / "samples/missions/two_rovers_ground.yaml",)
NAMES = {
    "a_rover": ROVER,
    "season3/q01_two_causes_one_counter": ROVER,
    "n12_two_hosts_ground": TWO_ROVERS,
    "n5_app_restarts": ROVER,
    "d3_cpu1_cpu2": TWO_ROVERS,
    "c4_cmd_rate": ROVER,
    "cfs7/two_robots": TWO_ROVERS,
}


@pytest.fixture(scope="module")
def examined():
    """A function: the case of a capture by its name."""
    return lambda name: truth.examined(FOLDER / f"{name}.pcap.zst", (), tuple(NAMES[name])).case


def traces(case, stream):
    tracer = Tracer(case)
    return [tracer.nth([stream], nth) for nth in range(1, messages_in(stream) + 1)]


def stream_of(case, msg_id):
    return next(item for item in case.streams if item.msg_id == msg_id)


@pytest.mark.each(2)
@pytest.mark.parametrize(
    ("name", "got"), [("a_rover", (508, 92)), ("season3/q01_two_causes_one_counter", (211, 29))]
)
def test_commands_and_the_delays_of_the_doctor(examined, name, got):
    """As many as the robot counted, each with the delay that the doctor has, in parts that add up."""
    case = examined(name)
    every = traces(case, stream_of(case, 0x1827))
    ends = Counter((item.ended.ending, item.ended.witness, item.ended.cause) for item in every)
    assert ends == {("delivered", "measured", ""): got[0], ("lost", "proven", "limit"): got[1]}
    (hop,) = (hop for hop in case.hops if hop.into.msg_id == 0x1827)
    delivered = [item for item in every if item.ended.ending == "delivered"]
    assert sorted(item.delay_ns for item in delivered) == sorted(hop.delays_ns.tolist())
    assert latency_of(np.array([item.delay_ns for item in delivered])) == hop.latency == every[0].usual
    for item in delivered:
        assert sum(filter(None, item.after_ns)) == item.delay_ns
        times = [step.time_ns for step in item.steps if step.time_ns is not None]
        assert times == sorted(times)
        assert [step.hop for step in item.steps[-3:]] == ["the application's pipe", "application", "robot"]
    for item in every:
        assert item.steps[0].witness == "unknown"
        assert (item.steps[3].waiting, item.steps[3].limit) == (4, 4) or item.ended.ending == "delivered"


def test_telemetry_and_its_delays(examined):
    """As in the marks of the capture: the ground got 109, 229 counts are missing, all lost at TO's pipe."""
    case = examined("season3/q01_two_causes_one_counter")
    every = traces(case, stream_of(case, 0x0827))
    ends = Counter((item.ended.ending, item.ended.witness) for item in every)
    assert ends == {("sent_out", "measured"): 109, ("lost", "proven"): 229}
    out = [item for item in every if item.ended.ending == "sent_out"]
    assert latency_of(np.array([item.delay_ns for item in out])) == out[0].usual
    assert out[0].usual.p50 == 556.804  # as doctor -v has it
    assert all(sum(filter(None, item.after_ns)) == item.delay_ns for item in out)


def test_two_hosts():
    """What crossed the network in both directions; what gave way is told as one of several."""
    paths = sorted(FOLDER.glob("n12_two_hosts_*.pcap.zst"))
    settings = Settings(configs=TWO_ROVERS)
    source, _ = open_aligned(paths, settings)
    case = examine(source, settings.workbench(source.info)).diagnosis.case
    pose = traces(case, stream_of(case, 0x1829))
    assert Counter(item.ended.ending for item in pose) == {"sent_out": 126, "lost": 14}
    came = [item for item in pose if item.ended.ending == "sent_out"]
    assert latency_of(np.array([item.delay_ns for item in came])) == came[0].usual
    commands = traces(case, stream_of(case, 0x1827))
    ends = Counter((item.ended.ending, item.ended.one_of) for item in commands)
    assert ends == {("sent_out", None): 27 + 30 + 17, ("open", 66): 66}
    assert "64 (gave way to a newer one), 2 (passed on" in commands[0].ended.text
    # Equal values were sent again: which of them came out is the model's word, and so is its delay.
    hop = next(hop for hop in case.hops if hop.into.msg_id == 0x1827)
    sure = [item.delay_ns for item in commands if item.delay_witness == "measured" and item.delay_ns]
    assert sorted(sure) == sorted(hop.delays_ns.tolist())
    assert latency_of(np.array(sure)) == hop.latency
    assert Counter(item.ended.witness for item in commands) == {"by model": 67, "measured": 7, "unknown": 66}


@pytest.mark.each(3)
@pytest.mark.long("d3_cpu1_cpu2", "c4_cmd_rate")
@pytest.mark.parametrize("name", NAMES)
def test_no_trace_says_more_than_the_ledger(examined, name):
    """Of each cause and ending no more messages are proven than the ledger has there, and on the ways out.

    ``sent_out`` is no entry: what went on to the bus of another cFS is what arrived.
    """
    case = examined(name)
    for stream, way in zip(case.streams, case.ledger.ways, strict=False):
        if stream not in case.commands.fates or not case.commands.fates[stream].seen:
            continue
        every = traces(case, stream)
        proven = Counter((i.ended.ending, i.ended.cause) for i in every if i.ended.witness == "proven")
        sums = Counter()
        out = [hop.out for hop in case.hops if hop.into is stream and not hop.out.link.last_hop]
        onward = [case.ledger.way(item) for item in out]
        for entry in (entry for own in (way, *onward) for entry in own.entries()):
            sums[entry.ending, entry.cause] += entry.number
        sums["lost", "passed_on"] = case.commands.fates[stream].ends["passed_on"]
        sums["sent_out", ""] = int(case.commands.fates[stream].arrived.sum())
        assert all(number <= sums[key] for key, number in proven.items())
        came = sum(item.ended.ending in {"delivered", "sent_out"} for item in every)
        assert came <= int(case.commands.fates[stream].arrived.sum())


@pytest.mark.each(2)
@pytest.mark.long("d3_cpu1_cpu2", "c4_cmd_rate")
@pytest.mark.parametrize("name", NAMES)
def test_each_lost_message_has_a_way(examined, name):
    case = examined(name)
    tracer = Tracer(case)
    for item in missing(case)[::7]:
        if item.number is not None:
            found = tracer.packet(item.number)
        else:
            found = tracer.missing(item.link, item.msg_id, item.time_ns, item.first)
        if found is not None:
            ended = with_ending(found, item.what, item.one_of).ended
            assert ended.ending == "lost"
            assert ended.witness != "proven" or item.one_of is None


@pytest.mark.long
def test_a_message_that_comes_out_by_two_ways(examined):
    """To the robot and to the SBN peer: each as often as its stream has it, the shared way in front."""
    case = examined("cfs7/two_robots")
    every = traces(case, stream_of(case, 0x1827))
    ways = Counter(way.ended.ending for item in every for way in (item, *item.also))
    came = {hop.out.link.last_hop: len(hop.in_rows) for hop in case.hops if hop.into.msg_id == 0x1827}
    assert (ways["delivered"], ways["sent_out"] + ways["lost"]) == (came[True], came[False]) == (240, 190)
    assert ways["lost"] == 46  # sent to a peer that had timed out
    assert Counter(item.ended.ending for item in every) == {"delivered": 240}
    assert sum(bool(item.also) for item in every) == 190
    for item in every:
        for other in item.also:
            assert other.steps[:3] == item.steps[:3]
            assert other.steps[-1].packet != item.steps[-1].packet
            assert other.as_json() in item.as_json()["also"]


@pytest.mark.long
def test_what_follows_a_guess_is_no_proof(examined):
    """Where others had the same values, no counter behind proves what became of this one."""
    case = examined("cfs7/two_robots")
    for stream in case.streams:
        for item in traces(case, stream):
            guess = [
                step for step in item.steps[3:] if (step.hop, step.witness) == ("application", "by model")
            ]
            assert not guess or item.ended.witness in {"by model", "unknown"}
            assert not guess or item.delay_witness == "by model"


def test_a_packet_is_followed_both_ways(examined):
    case = examined("a_rover")
    tracer = Tracer(case)
    first = tracer.nth([stream_of(case, 0x1827)], 12)
    numbers = [step.packet for step in first.steps if step.packet is not None]
    assert len(numbers) == 2
    assert [tracer.packet(number) for number in numbers] == [first, first]
    assert tracer.packet(10**9) is None


def test_the_rounds_of_a_pipe(examined):
    """4 of 5 in 500 ms, as 10 Hz and a limit of 4 have it."""
    case = examined("a_rover")
    rounds = rounds_into(case, stream_of(case, 0x1827))
    assert rounds.sizes() == {(4, 5): 92, (5, 5): 28}
    assert abs(rounds.round_ns - 500_000_000) < 1_000_000
    assert (rounds.limit, rounds.limit_from, rounds.round_from) == (4, "assumed", "measured")
    assert rounds.depth()[:5].tolist() == [1, 2, 3, 4, 4]
    case = examined("season3/q01_two_causes_one_counter")
    rounds = rounds_out(case, stream_of(case, 0x0827))
    assert len(rounds) == 338
    assert int(rounds.out.sum()) == 109
    assert max(out for out, _ in rounds.sizes()) == rounds.limit == 4
