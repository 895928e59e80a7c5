"""Transcripts: what comes in when, and what goes out when. ``c`` is a command's number; times are in ms."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.errors import ConfigError
from edoras_tools.links.bare import CI, TO
from edoras_tools.links.sbn import SBN
from edoras_tools.model import NO_MSG_ID, Peer
from edoras_tools.sessions.faults import machine as module
from edoras_tools.sessions.faults.machine import HEAD_BYTES, FaultPlan
from edoras_tools.sessions.faults.rules import FAULT_KINDS, PROFILES, parse_profile, parse_rule
from edoras_tools.wire import cfe, envelope, sbn

MS = 1_000_000
CDR = bytes.fromhex("00010000") + bytes(8)


def command(number, msg_id=0x1827):
    return cfe.emit_command(msg_id, 1, envelope.DEFAULT.emit(CDR + bytes([number])), sequence_count=number)


def machine(*rules, seed=1, **keywords):
    return FaultPlan(tuple(parse_rule(rule) for rule in rules), seed).start(**keywords)


def run(faults, arrivals, until=None):
    """Play (ms, number) or (ms, number, MsgId); return [(ms, number)] as sent, looking each ms."""
    arrivals = [(*item, 0x1827)[:3] for item in arrivals]
    sent = []
    last = until if until is not None else max(at for at, *_ in arrivals)
    for now in range(last + 1):
        sent += [(now, delivery.payload[-1]) for delivery in faults.due(now * MS)]
        for at, number, msg_id in arrivals:
            if at == now:
                deliveries, _ = faults.apply(command(number, msg_id), link=CI, to_cfs=True, now=now * MS)
                sent += [(now, delivery.payload[-1]) for delivery in deliveries]
    return sent


STEADY = [(10 * number, number) for number in range(8)]

TRANSCRIPTS = {
    "drop:1": [],
    "drop:0": STEADY,
    "drop:1,every=4": [(10 * number, number) for number in (0, 1, 2, 4, 5, 6)],
    "drop:1,from=20ms,until=40ms": [(10 * number, number) for number in (0, 1, 4, 5, 6, 7)],
    "drop:1,from=10ms,until=20ms,period=30ms": [(10 * number, number) for number in (0, 2, 3, 5, 6)],
    "drop:1,switch=off": STEADY,
    "silence:25ms,from=20ms": [(10 * number, number) for number in (0, 1, 5, 6, 7)],
    "silence:5ms,from=10ms,period=20ms": [(10 * number, number) for number in (0, 2, 4, 6)],
    "silence:15ms,every=4": [(10 * number, number) for number in (0, 1, 2, 5, 6)],
    "duplicate:1,every=4": [
        (0, 0),
        (10, 1),
        (20, 2),
        (30, 3),
        (30, 3),
        (40, 4),
        (50, 5),
        (60, 6),
        (70, 7),
        (70, 7),
    ],
    "duplicate:1,copies=2,every=8": [*STEADY, (70, 7), (70, 7)],
    "delay:25ms": [(10 * number + 25, number) for number in range(8)],
    "burst:40ms": [(40, 0), (40, 1), (40, 2), (40, 3), (80, 4), (80, 5), (80, 6), (80, 7)],
    "reorder:1,every=4": [(0, 0), (10, 1), (20, 2), (40, 4), (40, 3), (50, 5), (60, 6), (95, 7)],
    "reorder:1,every=4,by=2": [(0, 0), (10, 1), (20, 2), (40, 4), (50, 5), (50, 3), (60, 6), (95, 7)],
    "rate:50": [(0, 0), (20, 2), (40, 4), (60, 6)],
    "rate:50,keep=latest": [(0, 0), (20, 1), (40, 3), (60, 5), (80, 7)],
    # 28 + 37 bytes at 40 bytes a ms: 1.625 ms each.
    "bandwidth:320k": [(10 * number + 2, number) for number in range(8)],
}


@pytest.mark.parametrize("rule", TRANSCRIPTS)
def test_what_comes_in_and_what_goes_out(rule):
    within = ",within=25ms" if rule.startswith("reorder") else ""
    assert run(machine(rule + within), STEADY, until=150) == TRANSCRIPTS[rule]


def test_a_full_line_makes_datagrams_wait_and_a_full_queue_loses_them():
    faults = machine("bandwidth:5200,queue=100")  # 65 bytes take 100 ms
    burst = [(0, number) for number in range(5)]
    assert run(faults, burst, until=500) == [(100, 0), (200, 1)]
    assert faults.struck == [5]


def test_a_rate_of_each_msg_id_leaves_others_alone_and_one_of_the_link_does_not():
    both = [(0, 1), (0, 2, 0x1828), (5, 3), (5, 4, 0x1828)]
    assert run(machine("rate:100"), both) == [(0, 1), (0, 2)]
    assert run(machine("rate:100,per=link"), both) == [(0, 1)]
    assert run(machine("rate:100,msg_id=0x1828"), both) == [(0, 1), (0, 2), (5, 3)]


def test_jitter_is_late_by_chance_and_never_overtakes():
    sent = run(machine("jitter:30ms"), [(number, number) for number in range(50)], until=100)
    assert [number for _, number in sent] == list(range(50))
    late = [at - number for at, number in sent]
    assert 0 <= min(late) < 30
    assert 15 < max(late) <= 31


def test_rules_act_by_stage_whatever_order_they_are_written_in():
    for rules in (("delay:5ms", "duplicate:1"), ("duplicate:1", "delay:5ms")):
        assert run(machine(*rules), [(0, 7)], until=9) == [(5, 7), (5, 7)]
    # A copy is made after the limit, so it does not use the limit up.
    assert run(machine("duplicate:1", "rate:1"), [(0, 7)]) == [(0, 7), (0, 7)]


def test_a_sequence_skips_ahead_and_goes_on_from_there():
    faults = machine("sequence:100,every=3")
    counts = []
    for number in range(8):
        deliveries, done = faults.apply(command(number), link=CI, to_cfs=True, now=number)
        counts.append(int.from_bytes(deliveries[0].payload[2:4], "big") & 0x3FFF)
        assert bool(done) is (number % 3 == 2)
    assert counts == [0, 1, 102, 103, 104, 205, 206, 207]


def test_a_switched_rule_is_in_force_from_then_on_and_a_silence_begins_then():
    faults = machine("silence:20ms,switch=off")
    assert run(faults, [(0, 0), (30, 1)]) == [(0, 0), (30, 1)]
    faults.switch(0, True, now=40 * MS)
    assert faults.concerns(CI, to_cfs=True)
    late = [faults.apply(command(1), link=CI, to_cfs=True, now=at * MS)[0] for at in (45, 59, 60, 70)]
    assert [len(item) for item in late] == [0, 0, 1, 1]
    faults.switch(0, False, now=80 * MS)
    assert not faults.concerns(CI, to_cfs=True)


def test_scopes_choose_by_link_direction_msg_id_type_and_expression():
    app = sbn.emit(sbn.MsgType.APP, Peer(66, 3), command(1, 0x1829))
    beat = sbn.emit(sbn.MsgType.HEARTBEAT, Peer(66, 3))
    cases = [
        ("drop:1,link=sbn", CI, True, command(1), 1),
        ("drop:1,link=sbn|ci", CI, True, command(1), 0),
        ("drop:1,to=ground", CI, True, command(1), 1),
        ("drop:1,to=bridge", SBN, False, app, 0),
        ("drop:1,msg_id=0x1827|0x1829", SBN, True, app, 0),
        ("drop:1,msg_id=0x1827", SBN, True, app, 1),
        ("drop:1,msg_id=0x1829", SBN, True, beat, 1),
        ("drop:1,sbn=heartbeat", SBN, True, beat, 0),
        ("drop:1,sbn=0xA0", SBN, True, app, 1),
        ("drop:1,sbn=APP", CI, True, app, 1),
        ("drop:1,where=long, and complete", CI, True, command(1), 0),
        ("drop:1,where=short", CI, True, command(1), 1),
    ]
    for rule, link, to_cfs, payload, left in cases:
        faults = machine(
            rule, where=lambda text: lambda data, _: text == "long, and complete" and len(data) > 9
        )
        assert len(faults.apply(payload, link=link, to_cfs=to_cfs, now=0)[0]) == left, rule


def test_an_expression_needs_something_that_compiles_it():
    with pytest.raises(ConfigError, match="where is not available here"):
        machine("drop:1,where=msg_id == 0x1827")


def test_faults_say_what_was_done_to_what_by_which_rule():
    original = command(3)
    _, (fault,) = machine("truncate:9,to=cfs").apply(original, link=CI, to_cfs=True, now=5, stream=2)
    assert (fault.time_ns, fault.kind, fault.original) == (5, "truncate", original)
    assert (fault.detail, fault.rule) == ("cut from 37 to 9 bytes", "truncate:9,to=cfs")
    assert (fault.link, fault.to_cfs, fault.msg_id, fault.stream) == (CI, True, 0x1827, 2)
    _, (fault,) = machine("drop:1").apply(b"\x18", link=CI, to_cfs=True, now=0)
    assert fault.msg_id == NO_MSG_ID


def test_the_latest_takes_the_place_of_one_that_waits_and_that_one_is_told_lost():
    faults = machine("rate:10,keep=latest")
    done = [faults.apply(command(number), link=CI, to_cfs=True, now=number) for number in range(3)]
    assert [[delivery.payload[-1] for delivery in deliveries] for deliveries, _ in done] == [[0], [], []]
    assert [fault.original[-1] for _, faults_ in done for fault in faults_] == [1, 1]
    assert [delivery.payload[-1] for delivery in faults.due(100 * MS)] == [2]


def test_what_is_held_back_is_bounded_and_what_is_over_is_told(monkeypatch):
    monkeypatch.setattr(module, "HOLD_BYTES", 1000)
    faults = machine("delay:1s")
    told = [
        fault
        for number in range(9)
        for fault in faults.apply(command(number), link=CI, to_cfs=True, now=0)[1]
    ]
    assert [fault.kind for fault in told].count("overflow") == faults.overflowed == 9 - faults.waiting
    assert len(faults.due(10**9)) == 3
    assert (faults.waiting, faults.held_bytes) == (0, 0)


def verdicts(faults, payloads, sizes, **keywords):
    """Play payloads in batches of these sizes; return what was sent and what was done."""
    sent, told, first, now = [], [], 0, 0
    for size in sizes:
        chosen = payloads[first : first + size]
        if not chosen:
            break
        first, now = first + size, now + 1
        heads = np.zeros((len(chosen), HEAD_BYTES), np.uint8)
        for row, payload in enumerate(chosen):
            start = payload[:HEAD_BYTES]
            heads[row, : len(start)] = np.frombuffer(start, np.uint8)
        length = np.array([len(payload) for payload in chosen])
        found = faults.decide(heads, length, chosen.__getitem__, now=now, **keywords)
        for row, payload in enumerate(chosen):
            if found is None or not found[:, row].any():
                sent.append(payload)
                continue
            deliveries, done = faults.strike(payload, found[:, row], row, now=now, **keywords)
            sent += [delivery.payload for delivery in deliveries]
            told += [(fault.kind, fault.detail, fault.original) for fault in done]
    return sent, told


RULES = [
    "drop:0.3",
    "drop:0.2,msg_id=0x1827",
    "drop:1,every=7,to=cfs",
    "silence:2ns,p=0.05",
    "corrupt:0.3,bits=2",
    "sequence:5,p=0.1",
    "duplicate:0.2",
    "reorder:0.1,by=2",
    "truncate:12,p=0.2",
    "checksum,p=0.5",
    "drop:0.5,sbn=APP",
    "drop:1,where=even",
]


@given(
    rules=st.lists(st.sampled_from(RULES), min_size=1, max_size=4),
    sizes=st.lists(st.integers(1, 40), min_size=5, max_size=30),
    seed=st.integers(0, 2**64 - 1),
    link=st.sampled_from([CI, SBN]),
)
def test_how_many_come_at_once_has_no_say(rules, sizes, seed, link):
    keywords = {"link": link, "to_cfs": True}
    payloads = [command(number, 0x1827 + number % 3) for number in range(120)]
    if link is SBN:
        kinds = (sbn.MsgType.APP, sbn.MsgType.HEARTBEAT)
        payloads = [sbn.emit(kinds[index % 5 == 0], Peer(66, 3), item) for index, item in enumerate(payloads)]
    payloads.append(b"")

    def start():
        return machine(*rules, seed=seed, where=lambda _: lambda data, _link: len(data) % 2 == 0)

    batched, told = verdicts(start(), payloads, [*sizes, 200], **keywords)
    faults, alone, done, first = start(), [], [], 0
    for now, size in enumerate([*sizes, 200], 1):
        for payload in payloads[first : first + size]:
            deliveries, found = faults.apply(payload, now=now, **keywords)
            alone += [delivery.payload for delivery in deliveries]
            done += [(fault.kind, fault.detail, fault.original) for fault in found]
        first += size
    assert batched == alone
    assert told == done


def struck(faults, count=2000, step=1, stream=0):
    return [
        number
        for number in range(count)
        if not faults.apply(b"\0" * 8, link=CI, to_cfs=True, now=number * step, stream=stream)[0]
    ]


def test_the_same_seed_drops_the_same_whenever_they_come_and_whatever_else_is_on():
    plain = struck(machine("drop:0.1"))
    assert 150 < len(plain) < 250
    assert struck(machine("drop:0.1"), step=10**7) == plain
    assert struck(machine("corrupt:0.5", "drop:0.1", "delay:0,p=0.2")) == plain
    assert struck(machine("drop:0.1", seed=2)) != plain
    assert struck(machine("drop:0.1"), stream=1) != plain
    # A more likely fault strikes what a less likely one strikes, and more.
    assert set(plain) < set(struck(machine("drop:0.3")))
    two = set(struck(machine("drop:0.1", "drop:0.1")))
    assert set(plain) < two


VALUES = {**dict.fromkeys(("corrupt", "drop", "duplicate", "reorder"), ":0.5"), "checksum": ""}


@given(st.data())
def test_whatever_comes_nothing_but_datagrams_comes_out(data):
    names = data.draw(st.lists(st.sampled_from(sorted(FAULT_KINDS)), max_size=5))
    rules = [name + VALUES.get(name, ":9") for name in names]
    faults = machine(*rules, seed=data.draw(st.integers(0, 99)))
    now = 0
    for payload in data.draw(st.lists(st.binary(max_size=60), max_size=12)):
        now += data.draw(st.integers(0, 10**9))
        link = data.draw(st.sampled_from([CI, TO, SBN]))
        deliveries, _ = faults.apply(payload, link=link, to_cfs=data.draw(st.booleans()), now=now)
        assert all(item.due_ns <= now for item in deliveries)
        deliveries += faults.due(now)
        assert all(len(item.payload) <= 65507 for item in deliveries)
    faults.due(1 << 62)
    assert faults.waiting == 0
    assert faults.next_ns is None


@pytest.mark.parametrize("name", PROFILES)
def test_profiles_are_rules(name):
    assert FaultPlan(parse_profile(name))
