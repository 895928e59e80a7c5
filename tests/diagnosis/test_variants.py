"""Real captures doctored by a script, each with the answer that is known: what is lost, what is said."""

import random
import struct
from collections import Counter
from contextlib import closing
from dataclasses import dataclass, field
from functools import cache

import pytest
from captures import ROBOT_GOT
from effort import long_but
from msgspec.structs import replace
from places import MISSIONS, ROOT
from rewriting import Udp, datagrams, write

from edoras_tools.decode import Options
from edoras_tools.diagnosis.summary import summarize
from edoras_tools.io.formats.open import open_file
from edoras_tools.links import table
from edoras_tools.pipelines.doctor import examine
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.render.doctor import limits
from tests.support.balance import arrived, ended, wrong_rows

TRUTH = {
    "a_rover": 92,
    "b_arm_single": 0,
    "d3_cpu1_cpu2": 6599,  # and up to 2 that a silent peer may have heard
    "n1_to_remove_all": 0,
    "n3_cfs_restart": 38,
    "n5_app_restarts": 158,
    "n10_uplink_loss": 34,
    "p6b_extended_header": 23,
}
"""Messages lost in each capture as it is, counted at the robot or at a relay."""
ROVER = ["rover_ground"]
MISSION = {"b_arm_single": ["single_arm_ground"]}
PORTS = {"n10_uplink_loss": [("ci", 5234)]}
SECOND, MS = 10**9, 10**6


@dataclass(frozen=True)
class Variant:
    """What is done to a capture, and what the doctor must say then.

    Attributes:
        change: makes other datagrams of those of the capture.
        how: the options of ``write``.
        more: how many more messages are lost than in the capture as it is.
        says: rules that must speak.
        silent: rules that must not.
        ports: links' ports that are named.
    """

    change: object = list
    how: dict = field(default_factory=dict)
    more: int = 0
    says: tuple = ()
    silent: tuple = ("not_examined", "not_cfs", "captured_twice", "duplicated", "clock_jump")
    ports: tuple = ()


def taps(count, step_ns=20_000):
    return lambda items: [replace(item, tap=tap).at(tap * step_ns) for item in items for tap in range(count)]


def to_ipv6(items):
    def moved(end):
        return f"fd00::{end[0].rpartition('.')[2]}", end[1]

    return [replace(item, source=moved(item.source), destination=moved(item.destination)) for item in items]


def shuffled(within_ns=None):
    def change(items):
        chance = random.Random(3)
        if within_ns is None:
            return chance.sample(items, len(items))
        return sorted(items, key=lambda item: item.time_ns + chance.randrange(within_ns))

    return change


def unnumbered(items):
    return [replace(item, identification=0) for item in items]


def port(old, new):
    def moved(end):
        return (end[0], new if end[1] == old else end[1])

    return lambda items: [
        replace(item, destination=moved(item.destination), source=item.source) for item in items
    ]


def at_host(items, address, shift_ns=0):
    """Return the datagrams of a loopback capture as of a host of their own, and at another time."""

    def moved(end):
        return (address, end[1]) if end[0] == "127.0.0.1" else end

    return [
        replace(item, source=moved(item.source), destination=moved(item.destination)).at(shift_ns)
        for item in items
    ]


def merged(items, more):
    return sorted([*items, *more], key=lambda item: item.time_ns)


def beside(payload, source=("10.9.9.9", 5004), target=("10.9.9.8", 1234), count=400):
    def change(items):
        chance = random.Random(11)
        more = [
            Udp(items[0].time_ns + at * 50 * MS, source, target, payload(chance, at), at + 1)
            for at in range(count)
        ]
        return merged(items, more)

    return change


def msg_id(item):
    return int.from_bytes(item.payload[:2], "big") if item.destination[1] in {1234, 1235} else -1


def without(chosen):
    return lambda items: [item for at, item in enumerate(items) if not chosen(at, item)]


def some(wanted, places):
    """Tell which datagrams of a MsgId are the n-th of it."""
    seen = iter(range(1 << 30))
    return lambda _, item: msg_id(item) == wanted and next(seen) in places


def doubled(places):
    return lambda items: [item for at, one in enumerate(items) for item in [one] * (1 + (at in places))]


def some_doubled(wanted, later_ns):
    def change(items):
        again = [item.at(later_ns) for item in items[::9] if msg_id(item) == wanted]
        return sorted([*items, *again], key=lambda item: item.time_ns)

    return change


def swapped(items):
    """Let some telemetry overtake the packet before it."""
    out, at = list(items), [place for place, item in enumerate(items) if item.destination[1] == 1235]
    for place in at[50:250:40]:
        before, after = out[place - 1], out[place]
        out[place - 1 : place + 1] = [
            replace(after, time_ns=before.time_ns),
            replace(before, time_ns=after.time_ns),
        ]
    return out


def clock_set(by_ns):
    return lambda items: [item.at(by_ns * (at > len(items) // 2)) for at, item in enumerate(items)]


def mission_time(change):
    """Let cFE's clock say something else: seconds, of its own and since the capture's start."""

    def changed(items):
        for item in items:
            if item.destination[1] != 1235 or len(item.payload) < 16:
                yield item
                continue
            seconds, part = struct.unpack_from(">IH", item.payload, 6)
            told = change(seconds + part / 65536, (item.time_ns - items[0].time_ns) / 1e9)
            head = struct.pack(">IH", int(told), int(told % 1 * 65536))
            yield replace(item, payload=item.payload[:6] + head + item.payload[12:])

    return changed


def rtp(chance, at):
    return bytes([0x80, 96]) + at.to_bytes(2, "big") + chance.randbytes(168)


def dns(chance, _):
    return chance.randbytes(2) + b"\1\0\0\1\0\0\0\0\0\0\5robot\0\0\1\0\1"


def json(_, at):
    return b'{"x": %d}' % at


def noise(chance, _):
    return chance.randbytes(chance.randrange(1, 300))


FIRST = {
    "as it is": Variant(),
    "on any": Variant(taps(2), {"layer": "any"}, says=("captured_twice",), silent=("duplicated",)),
    "on any, cooked 2": Variant(taps(2), {"layer": "any2"}, says=("captured_twice",), silent=("duplicated",)),
    "at one tap of any": Variant(how={"layer": "any2"}),
    "with a VLAN": Variant(how={"layer": "vlan"}),
    "cut to 200": Variant(how={"snap": 200}, says=("cut_frames",)),
    "cut to 96": Variant(how={"snap": 96}, says=("cut_frames",)),
    "raw IP": Variant(how={"layer": "raw"}),
    "IPv6": Variant(to_ipv6),
    "fragments of 64": Variant(how={"cut": 64}),
    "shuffled": Variant(shuffled(), says=("out_of_order",)),
}
"""Done to every capture."""
QUIET = ("not_examined", "clock_jump")
ROVERS = {
    "IPv6 on any": Variant(
        lambda items: taps(2)(to_ipv6(items)), {"layer": "any"}, says=("captured_twice",), silent=()
    ),
    "IPv6 with a VLAN": Variant(to_ipv6, {"layer": "vlan"}),
    "fragments of 8": Variant(how={"cut": 8}),
    "fragments on any": Variant(taps(2), {"cut": 64, "layer": "any"}, silent=()),
    "at three taps": Variant(taps(3), says=("captured_twice",), silent=("duplicated",)),
    "twice at one place": Variant(doubled(range(10**6)), says=("captured_twice",), silent=("duplicated",)),
    "without identification": Variant(unnumbered),
    "without identification, at two taps": Variant(
        lambda items: taps(2)(unnumbered(items)), says=("captured_twice",), silent=()
    ),
    "without identification, twice": Variant(
        lambda items: doubled(range(10**6))(unnumbered(items)), says=("captured_twice",), silent=()
    ),
    "some doubled by the network": Variant(
        some_doubled(0x827, 30_000), says=("duplicated",), silent=("captured_twice",)
    ),
    "some commands doubled by the capture": Variant(
        some_doubled(0x1827, 30_000), says=("captured_twice",), silent=("duplicated",)
    ),
    "some doubled by the capture at once": Variant(
        some_doubled(0x827, 0), says=("captured_twice",), silent=("duplicated",)
    ),
    "telemetry that overtakes": Variant(swapped),
    "records up to 30 ms out of order": Variant(shuffled(30 * MS), says=("out_of_order",)),
    "records backwards": Variant(lambda items: items[::-1], says=("out_of_order",)),
    "cut to 160": Variant(how={"snap": 160}, says=("cut_frames",)),
    "cut to 128": Variant(how={"snap": 128}, says=("cut_frames",)),
    "cut to 80": Variant(how={"snap": 80}, says=("cut_frames",)),
    "cut to 60, before the counters of 0x803": Variant(
        how={"snap": 60}, more=-92, says=("cut_frames", "not_observable")
    ),
    "a year later": Variant(lambda items: [item.at(365 * 86400 * SECOND) for item in items]),
    "the capture's clock set forward": Variant(clock_set(300 * SECOND), says=("clock_jump",), silent=()),
    "the capture's clock set back": Variant(clock_set(-300 * SECOND), says=("clock_jump",), silent=()),
    "cFE's clock slips by 0.7 s": Variant(mission_time(lambda told, since: told + 0.7 * (since > 30))),
    "cFE's clock slips by 2 s": Variant(
        mission_time(lambda told, since: told + 2 * (since > 30)), says=("clock_jump",), silent=()
    ),
    "cFE's clock slips back by 2 s": Variant(
        mission_time(lambda told, since: told - 2 * (since > 30)), says=("clock_jump",), silent=()
    ),
    "cFE's clock set by an hour": Variant(
        mission_time(lambda told, since: told + 3600 * (since > 30)), says=("clock_jump",), silent=()
    ),
    "cFE's clock drifts by 1 %": Variant(mission_time(lambda told, since: told + 0.01 * since)),
    "cFE's clock drifts by -5 %": Variant(mission_time(lambda told, since: told - 0.05 * since)),
    "cFE's clock drifts by 10 %": Variant(mission_time(lambda told, since: told + 0.1 * since)),
    "RTP on CI's port of others": Variant(beside(rtp), says=("not_cfs",), silent=QUIET),
    "RTP to CI's host": Variant(beside(rtp, target=("127.0.0.1", 1234)), says=("not_cfs",), silent=QUIET),
    "one RTP datagram": Variant(beside(rtp, count=1), says=("not_cfs",), silent=QUIET),
    "a DNS client's answers": Variant(
        beside(dns, ("10.9.9.1", 53), ("10.9.9.8", 1235)), says=("not_cfs",), silent=QUIET
    ),
    "JSON on SBN's port": Variant(beside(json, target=("10.9.9.8", 2236)), says=("not_cfs",), silent=QUIET),
    "noise on CI's port": Variant(beside(noise), says=("not_cfs",), silent=QUIET),
    "noise to the ground": Variant(
        beside(noise, target=("127.0.0.1", 1235)), says=("not_cfs",), silent=QUIET
    ),
    "other traffic elsewhere": Variant(beside(noise, target=("10.9.9.8", 5353))),
    "CI at another port": Variant(port(1234, 5234), ports=(("ci", 5234),)),
    "TO to another port": Variant(port(1235, 6235), ports=(("to", 6235),)),
    "SBN at another port": Variant(port(2236, 7236), ports=(("sbn", 7236),)),
    "poses lost after TO": Variant(
        without(some(0x827, set(range(2, 62, 2)))), more=30, says=("lost_after_cfs",)
    ),
}
"""Done to a_rover."""
UNNAMED = {
    "CI": (port(1234, 5234), "name the port with --set port=ci:5234"),
    "TO": (port(1235, 6235), "name the port with --set port=to:6235"),
}
HIDDEN = {
    ("n3_cfs_restart", "cut to 96"): (1, 0),
    ("n5_app_restarts", "cut to 96"): (19, 0),
    ("a_rover", "cut to 60, before the counters of 0x803"): (0, 92),
}
"""Messages not said to be lost, as what tells why is cut off: those, and how many are unaccounted for."""
CASES = [(name, what, variant) for name in TRUTH for what, variant in FIRST.items()]
CASES += [("a_rover", what, variant) for what, variant in ROVERS.items()]
NEAR_OTHERS = {
    *("on any", "without identification", "IPv6 with a VLAN", "TO to another port", "fragments of 8"),
    *("cut to 160", "cut to 128", "cFE's clock drifts by 1 %", "cFE's clock drifts by -5 %"),
    *("the capture's clock set back", "cFE's clock slips back by 2 s"),
    *("RTP to CI's host", "one RTP datagram", "noise to the ground"),
}
QUICK = [
    (name, what, variant)
    for name, what, variant in CASES
    if (what == "as it is" and name in {"b_arm_single", "n10_uplink_loss"})
    or (what == "cut to 96" and name in {"n5_app_restarts", "p6b_extended_header"})
    or (name == "a_rover" and what not in NEAR_OTHERS)
]
"""A link layer is taken off before anything is judged: one capture will do; the rest is for ``make long``."""
ENDS = "source", "destination"


@cache
def captured(name):
    return datagrams(ROOT / f"tests/captures/{name}.pcap.zst")


def diagnosed(path, name, ports=()):
    links = tuple((table.link_of_label(link), number) for link, number in (*ports, *PORTS.get(name, ())))
    config = [MISSIONS / f"{item}.yaml" for item in MISSION.get(name, ROVER)]
    source = open_file(path)
    bench = Settings(config, options=Options(ports=links)).workbench(source.info)
    with closing(source):
        return examine(source, bench).diagnosis


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A function: the diagnosis of a capture as it is, made once."""
    path = tmp_path_factory.mktemp("whole") / "x.pcap"
    return cache(lambda name: diagnosed(write(path, captured(name)), name))


@pytest.mark.each(4)
@pytest.mark.parametrize(
    ("name", "what", "variant"), long_but(QUICK, CASES), ids=[f"{one}: {two}" for one, two, _ in CASES]
)
def test_the_answer_is_known(tmp_path, name, what, variant):
    hidden, open_ = HIDDEN.get((name, what), (0, 0))
    path = write(tmp_path / "x.pcap", variant.change(captured(name)), **variant.how)
    found = diagnosed(path, name, variant.ports)
    rules = {item.rule for item in found.verdicts}
    assert (found.lost, found.unaccounted) == (TRUTH[name] + variant.more - hidden, open_), sorted(rules)
    assert rules >= set(variant.says)
    assert not rules & set(variant.silent) - set(variant.says)


def address_of(part):
    """Return where Telemetry Output of a spacecraft sends from."""
    rows, endpoints = part.case.rows, part.case.endpoints
    own = rows.link == table.link_of_label("to")
    (address,) = {endpoints[row].address for row in rows.source[own]}
    return address


@pytest.mark.each(3)
@pytest.mark.quick("*-300", "n5*")
@pytest.mark.parametrize("late_ms", [0, 300, 2300, 40_000])
@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("a_rover", "a_rover"),
        ("a_rover", "n3_cfs_restart"),
        ("n5_app_restarts", "n3_cfs_restart"),
        ("n5_app_restarts", "n1_to_remove_all"),
        ("n1_to_remove_all", "a_rover"),
        # builds with different headers
        ("a_rover", "p6b_extended_header"),
        ("p6b_extended_header", "n5_app_restarts"),
    ],
)
def test_two_cfs_of_one_name_lose_each_its_own(tmp_path, one, other, late_ms):
    first, second = captured(one), captured(other)
    shift_ns = first[0].time_ns - second[0].time_ns + late_ms * MS
    items = merged(at_host(first, "10.0.0.1"), at_host(second, "10.0.0.2", shift_ns))
    found = diagnosed(write(tmp_path / "x.pcap", items), one)
    lost = Counter()
    for row in found.balance:  # equal telemetry is of one spacecraft, though of two cFS
        place = row.instance and row.instance.rpartition(" ")[2]
        lost[address_of(found.parts[row.spacecraft]) if row.spacecraft else place] += row.all_lost
    assert wrong_rows(found.balance) == []
    assert found.unaccounted == 0
    assert lost == Counter({"10.0.0.1": TRUTH[one]}) + Counter({"10.0.0.2": TRUTH[other]})


AT_ONE_PLACE = {
    # What is lost before CI is counted by two CIs at one port: nothing tells which of them was meant.
    ("a_rover", "p6b_extended_header"): (115, 0),
    ("a_rover", "n1_to_remove_all"): (92, 0),
    ("a_rover", "n3_cfs_restart"): (92, 38),
    ("p6b_extended_header", "n3_cfs_restart"): (23, 38),
}
"""Lost, and unaccounted for."""


@pytest.mark.each(3)
@pytest.mark.quick("a_rover-n3*", "p6b*")
@pytest.mark.parametrize("late_ms", [0, 2300, 20_000])
@pytest.mark.parametrize(("one", "other"), AT_ONE_PLACE)
def test_two_cfs_of_one_name_at_one_address_are_told_by_their_clocks(whole, tmp_path, one, other, late_ms):
    first, second = captured(one), captured(other)
    shift_ns = first[0].time_ns - second[0].time_ns + late_ms * MS
    items = merged(first, [item.at(shift_ns) for item in second])
    found = diagnosed(write(tmp_path / "x.pcap", items), one)
    assert wrong_rows(found.balance) == []
    assert (found.lost, found.unaccounted) == AT_ONE_PLACE[one, other]
    # Each publishes what is seen of it: the counts of the other are no gaps.
    assert published(found) == sum((published(whole(name)) for name in (one, other)), Counter())
    assert len({row.instance for row in found.balance if row.link == "to"}) == 2


def published(found):
    came = Counter()
    for row in found.balance:
        came[row.msg_id, row.hop] += row.came * (row.link == "to")
    return came


@pytest.mark.each(2)
@pytest.mark.parametrize(
    ("one", "other"), [("a_rover", "p6b_extended_header"), ("p6b_extended_header", "n3_cfs_restart")]
)
def test_two_builds_on_one_host_one_after_the_other_lose_each_its_own(tmp_path, one, other):
    first, second = captured(one), captured(other)
    later = [item.at(first[-1].time_ns + 100 * SECOND - second[0].time_ns) for item in second]
    found = diagnosed(write(tmp_path / "x.pcap", [*first, *later]), one)
    assert wrong_rows(found.balance) == []
    assert (found.lost, found.unaccounted) == (TRUTH[one] + TRUTH[other], 0)


def test_a_telemetry_output_that_may_have_been_told_to_stop_lost_nothing(tmp_path):
    """It was told to send nothing for 15 s; in a capture of telemetry alone nothing tells that it was."""
    kept = [item for item in captured("n1_to_remove_all") if item.destination[1] == 1235]
    found = diagnosed(write(tmp_path / "x.pcap", kept), "n1_to_remove_all")
    assert wrong_rows(found.balance) == []
    assert (found.lost, found.unaccounted, found.uncertain) == (0, 0, 30)
    told = [item for item in found.verdicts if item.rule == "unexplained_gap"]
    assert len(told) == 2
    assert all("no command to cFS is in the capture" in item.reason for item in told)
    assert all("sent to CI" in item.remedy for item in told)


def test_a_peer_that_may_not_have_been_connected_missed_nothing(tmp_path):
    """The bridge was killed and came back; of SBN only what cFS sends was captured."""
    kept = [item for item in captured("f_sbn_disconnect") if item.destination[1] != 2234]
    found = diagnosed(write(tmp_path / "x.pcap", kept), "f_sbn_disconnect")
    assert wrong_rows(found.balance) == []
    assert (found.lost, found.unaccounted, found.uncertain) == (0, 0, 11)
    (told,) = [item for item in found.verdicts if item.rule == "unexplained_gap"]
    assert "what the peer sends is not in the capture" in told.reason


def test_what_a_peer_sends_unseen_is_no_ground_for_a_cause(tmp_path):
    """Two cFS that hand on each other's packets, their SBN not captured: its pipes lost some, no network."""
    kept = [item for item in captured("d3_cpu1_cpu2") if item.destination[1] == 1235]
    found = diagnosed(write(tmp_path / "x.pcap", kept), "d3_cpu1_cpu2")
    assert wrong_rows(found.balance) == []
    assert not {item.rule for item in found.verdicts} & {"no_subscriber", "lost_after_cfs"}


def test_a_pipe_is_not_blamed_for_as_much_as_it_can_lose_where_others_lost_more(tmp_path):
    """A limit counted 258: 29 of a command, 229 of telemetry that is not here, nor is what the robot gets."""
    name = "season3/q01_two_causes_one_counter"
    kept = [item for item in captured(name) if item.destination[1] != 8585 and msg_id(item) != 0x827]
    found = diagnosed(write(tmp_path / "x.pcap", kept), name)
    assert wrong_rows(found.balance) == []
    assert (found.lost, found.unaccounted) == (258, 0)
    (row,) = [item for item in found.balance if item.msg_id == 0x1827 and item.hop == "software bus"]
    assert 10 <= row.proven <= 29 <= row.proven + row.shared  # ten have an event


@pytest.mark.long
def test_what_two_cfs_tell_of_one_loss_is_counted_once(tmp_path):
    """Gaps behind one, counters of the other: without SBN nothing tells that they are the same messages."""
    kept = [item for item in captured("d3_cpu1_cpu2") if item.destination[1] in {1234, 1235}]
    found = diagnosed(write(tmp_path / "x.pcap", kept), "d3_cpu1_cpu2")
    lost = Counter()
    for item in found.verdicts:
        lost[item.rule] += item.lost or 0
    # Two of the gaps fall into seconds in which the cFS that they are behind counted losses itself.
    assert (lost["unexplained_gap"] + 2, lost["unattributed_loss"]) == (2118, 2218 - 2118)
    assert wrong_rows(found.balance) == []


@pytest.mark.parametrize("link", UNNAMED)
def test_a_port_that_is_not_named_is_said_first(tmp_path, link):
    change, remedy = UNNAMED[link]
    found = diagnosed(write(tmp_path / "x.pcap", change(captured("a_rover"))), "a_rover")
    assert found.bad
    assert (found.verdicts[0].rule, found.verdicts[0].remedy) == ("not_examined", remedy)
    assert limits(found)[0] == found.verdicts[0].reason
    assert (
        summarize(found).headline.partition(" ")[2].startswith("datagrams were not examined. In the rest: ")
    )
    assert sum(item.datagrams for item in found.unnamed) <= found.left_out


@pytest.mark.parametrize("payload", [rtp, dns, json, noise], ids=lambda item: item.__name__)
def test_a_capture_without_cfs_says_so_and_no_more(tmp_path, payload):
    items = beside(payload)(captured("b_arm_single")[:1])[1:]
    found = diagnosed(write(tmp_path / "x.pcap", items), "a_rover")
    assert found.bad
    assert found.datagrams == 0
    assert {item.rule for item in found.verdicts} == {"not_cfs"}


ONLY_0X803_COUNTS = 144
"""Messages of the capture of two cFS that leave no gap: nothing of their MsgId came after them."""


SNAPS = (60, 64, 68, 72, 76, 80, 100, 120, 160, 172, 190)


@pytest.mark.long
@pytest.mark.parametrize("snap", long_but(SNAPS[::3], SNAPS))
def test_frames_that_are_cut_anywhere_say_no_more_than_whole_ones(whole, tmp_path, snap):
    """Two cFS that hand on each other's packets: of SBN 11 bytes less are left than of Telemetry Output."""
    name = "d3_cpu1_cpu2"
    found = diagnosed(write(tmp_path / "x.pcap", captured(name), snap=snap), name)
    assert found.verdicts[0].rule == "cut_frames"
    assert wrong_rows(found.balance) == []
    whole = whole(name)

    def lost_by(found):
        return sum((Counter(row.lost) for row in found.balance), Counter())

    # Each is told once: what SBN lost is not missing again behind Telemetry Output, which hands the rest on.
    # Where times are cut off, nothing tells whose they are.
    proven = found.lost + found.unaccounted
    assert proven <= whole.lost <= proven + found.uncertain + ONLY_0X803_COUNTS
    assert set(lost_by(found)) <= {"unknown", *lost_by(whole)}
    assert lost_by(found)["sbn_timeout"] == lost_by(whole)["sbn_timeout"]
    if snap >= 86:  # the counters of every 0x803 are there
        assert lost_by(found) == lost_by(whole)


@pytest.mark.each(3)
@pytest.mark.quick("*-74")
@pytest.mark.parametrize("snap", [60, 74, 140])
@pytest.mark.parametrize(
    "name", ["e_ci_errors", "f_sbn_disconnect", "n5_app_restarts", "n12_two_hosts_flight"]
)
def test_what_a_cut_hides_is_nobodys_loss(whole, tmp_path, name, snap):
    whole = whole(name)
    found = diagnosed(write(tmp_path / "y.pcap", captured(name), snap=snap), name)
    assert found.lost <= whole.lost
    assert found.lost + found.unaccounted <= whole.lost + whole.unaccounted
    assert all("no event" not in line for item in found.verdicts for line in item.evidence)
    # Who is silent is told by headers alone.
    silent = [sum(row.lost.get("sbn_timeout", 0) for row in one.balance) for one in (found, whole)]
    assert silent[0] == silent[1]


def between(items, start, end):
    """Tell which datagrams were captured in some seconds of a capture."""
    first = items[0].time_ns
    return [start * SECOND <= item.time_ns - first < end * SECOND for item in items]


@pytest.mark.each(3)
@pytest.mark.quick("a_rover-*", "b_arm_single-20-30", "n10_uplink_loss-20-30")
@pytest.mark.parametrize(("start", "end"), [(8, 10), (20, 30)])
@pytest.mark.parametrize("name", ["a_rover", "b_arm_single", "c4_cmd_rate", "n10_uplink_loss"])
def test_what_is_cut_out_of_the_middle_is_not_lost(whole, tmp_path, name, start, end):
    items = captured(name)
    kept = [item for item, inside in zip(items, between(items, start, end), strict=True) if not inside]
    found = diagnosed(write(tmp_path / "x.pcap", kept), name)
    whole = whole(name)
    assert wrong_rows(found.balance) == []
    assert any(item.rule == "not_examined" and "a hole of" in item.reason for item in found.verdicts)
    assert "lost_after_cfs" not in {item.rule for item in found.verdicts}
    assert found.lost <= whole.lost
    assert found.unaccounted <= whole.unaccounted


@pytest.mark.parametrize(
    "name",
    [
        *("restarted_at_once", "overload_of_a_dead_bridge", "housekeeping_to_a_peer"),
        *("killed_and_back_at_once", "floods_of_poses"),
    ],
)
def test_what_is_lost_on_loopback_is_lost_on_a_network_too(whole, tmp_path, name):
    """A network may delay a message by two seconds, no more: one lost elsewhere does not excuse it."""
    here, there = "127.0.0.", "10.77.0."  # of one length: commands have it, too

    def moved(item):
        ends = {end: (getattr(item, end)[0].replace(here, there), getattr(item, end)[1]) for end in ENDS}
        return replace(item, payload=item.payload.replace(here.encode(), there.encode()), **ends)

    items = [moved(item) for item in captured(f"flights/{name}")]
    found, same = diagnosed(write(tmp_path / "x.pcap", items), name), whole(f"flights/{name}")
    assert (found.lost, found.unaccounted, found.uncertain) == (same.lost, same.unaccounted, same.uncertain)


@pytest.mark.quick("a_rover-700", "n1*-700")
@pytest.mark.parametrize("milliseconds", [150, 700, 1500])
@pytest.mark.parametrize("name", ["a_rover", "b_arm_single", "n1_to_remove_all", "p6b_extended_header"])
def test_a_slow_network_loses_nothing(tmp_path, name, milliseconds):
    items = [item.at(milliseconds * MS * (item.destination[1] == 1235)) for item in captured(name)]
    found = diagnosed(write(tmp_path / "x.pcap", sorted(items, key=lambda item: item.time_ns)), name)
    assert (found.lost, found.unaccounted) == (TRUTH[name], 0)


@pytest.mark.each(2)
@pytest.mark.parametrize("direction", ["down", "up"])
def test_a_network_that_fails_one_way_is_no_hole_of_the_capture(tmp_path, direction):
    items, port = captured("a_rover"), {"down": 1235, "up": 1234}[direction]
    kept = [
        item
        for item, inside in zip(items, between(items, 20, 30), strict=True)
        if not (inside and item.destination[1] == port)
    ]
    found = diagnosed(write(tmp_path / "x.pcap", kept), "a_rover")
    assert "not_examined" not in {item.rule for item in found.verdicts}
    if direction == "down":
        assert sum(row.lost.get("after", 0) for row in found.balance) == 90


@pytest.mark.each(3)
@pytest.mark.quick("*-72")
@pytest.mark.parametrize("snap", [60, 72, 96])
@pytest.mark.parametrize("name", ROBOT_GOT)
def test_what_reached_the_robot_is_counted_where_its_values_are_cut(tmp_path, name, snap):
    found = diagnosed(write(tmp_path / "x.pcap", captured(name), snap=snap), name)
    assert wrong_rows(found.balance) == []
    (line,) = [item for item in found.headlines if item.sent == ROBOT_GOT[name][1]]
    assert (arrived(line), line.sent) == ROBOT_GOT[name]
    ends = ended(line)
    assert line.sent == arrived(line) + line.missing + ends["waiting"] + ends["uncertain"]


def test_there_are_forty_at_the_least():
    assert len({what for _, what, _ in CASES}) + len(UNNAMED) >= 40
