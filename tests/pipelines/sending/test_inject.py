from __future__ import annotations

import json
import struct
from random import Random

import pytest
import zstandard
from declared_commands import DECLARED
from places import MISSIONS, ROOT

from edoras_tools.cfs.arguments import ARGUMENTS
from edoras_tools.cfs.commands import CALLS, NAMED, Argument
from edoras_tools.cfs.names import COMMANDS
from edoras_tools.decode import Options
from edoras_tools.errors import ConfigError, EdorasError, FieldError, RouteError
from edoras_tools.links.bare import CI, TO
from edoras_tools.links.sbn import SBN
from edoras_tools.pipelines.sending.inject import (
    Injection,
    arbitrary,
    command_names,
    described_commands,
    injection_receiver,
    make,
)
from edoras_tools.pipelines.sending.options import Receiver, SendOptions
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.ros import TypeStore
from edoras_tools.sessions.outgoing import Changes, ChecksumRule
from edoras_tools.wire import cfe

TWIST = "geometry_msgs/msg/Twist"


@pytest.fixture(scope="module")
def bench():
    return Settings([MISSIONS / f"two_rovers_{side}.yaml" for side in ("ground", "flight")]).workbench()


@pytest.fixture
def made(bench):
    def run(*what, to=None, **injection):
        injection = Injection(*what, **injection)
        options = SendOptions(to=to or injection_receiver(injection, bench.mission)).placed(bench.mission)
        loaded, options = make(injection, bench, options)
        return loaded.out, options

    return run


CMD = "/robot_1/ground/cmd_vel"


@pytest.mark.parametrize("text", ["{linear: {x: 0.5}}", '{"linear": {"x": 0.5}}', "linear:\n  x: 0.5\n"])
@pytest.mark.parametrize("name", [CMD, CMD[1:], "twist_cmd_1", "0x1827"])
def test_a_message_by_any_name_from_yaml_and_json(name, text, made):
    out, options = made(name, text)
    assert out[0] == (
        struct.pack(">HHHBB", 0x1827, 0, 69, 1, 0)
        + struct.pack("<QQ", 52, 52)
        + bytes.fromhex("00010000")
        + struct.pack("<6d", 0.5, 0, 0, 0, 0, 0)
    )
    assert options.passes == 1


def test_a_message_from_a_file(made, tmp_path):
    (tmp_path / "twist.yaml").write_text("angular: {z: -1}\n")
    assert made(CMD, f"@{tmp_path / 'twist.yaml'}")[0][0][-8:] == struct.pack("<d", -1)


def test_nothing_but_defaults(made):
    assert made(CMD)[0][0][28:] == bytes(48)


@pytest.mark.parametrize(
    ("name", "to", "link"),
    [
        (CMD, Receiver.CI, CI),
        ("/robot_1/pose", Receiver.SBN, SBN),
        ("/robot_1/ground/pose", Receiver.GROUND, TO),
    ],
)
def test_a_topic_knows_where_it_goes(name, to, link, bench, made):
    assert injection_receiver(Injection(name), bench.mission) is to
    assert made(name)[0].link is link


def test_commands_by_msg_id_and_by_name(made):
    assert made(command=(0x1880, 4), payload=b"\x29\x08")[0][0] == bytes.fromhex("1880 0000 0003 0400 2908")
    assert made("noop", "ci")[0][0] == bytes.fromhex("1884 0000 0001 0000")
    assert made("noop", "0x1827")[0][0] == bytes.fromhex("1827 0000 0001 0000")
    assert made("time-noop")[0][0] == bytes.fromhex("1805 0000 0001 0000")
    assert made("to-reset-counters")[0][0] == bytes.fromhex("1880 0000 0001 0100")
    assert made("TO_ENABLE")[0][0] == bytes.fromhex("1880 0000 0011 0600") + b"127.0.0.1".ljust(16, b"\0")
    assert made("to-enable", "127.0.0.2")[0][0][8:17] == b"127.0.0.2"


def test_every_name_of_a_command_is_a_bare_header(made):
    for name in (name for name, item in NAMED.items() if item.argument is Argument.NONE):
        packet = made(name)[0][0]
        assert len(packet) == 8
        assert name == "sbn-noop" or packet[6] in COMMANDS[int.from_bytes(packet[:2], "big")]
    assert {"to-enable", "noop", "to-add", "es-noop"} <= set(command_names())


START_IN_FLIGHT = (
    "1806 0000 0071 0400"
    + b"EDORAS_APP".ljust(20, b"\0").hex()
    + b"EdorasAppMain".ljust(20, b"\0").hex()
    + b"/cf/edoras_app.so".ljust(64, b"\0").hex()
    + "0000 0100 0000 3200"
)
"""The command that a real cFS started the application by (capture n5_app_restarts)."""


@pytest.mark.parametrize(
    ("what", "payload"),
    [
        (("to-add", "0x827"), "1880 0000 0009 0200 2708 0000 0000 0400"),
        (("to-add", "SB_HK"), "1880 0000 0009 0200 0308 0000 0000 0400"),
        (("to-add", "/robot_1/ground/pose"), "1880 0000 0009 0200 2808 0000 0000 0400"),
        (("TO_REMOVE", "2087"), "1880 0000 0005 0400 2708 0000"),
        (("evs-reset-filters", "CFE_SB"), "1801 0000 0015 0e00 4346 455f 5342" + "00" * 14),
        (("es-restart-app", "CI_LAB_APP"), "1806 0000 0015 0600 4349 5f4c 4142 5f41 5050" + "00" * 10),
        (("es-start-app", "EDORAS_APP"), START_IN_FLIGHT),
        (("es-start-app", "EDORAS_APP,/cf/edoras_app.so,EdorasAppMain,50,65536"), START_IN_FLIGHT),
        (("es-stop-app", "EDORAS_APP"), "1806 0000 0015 0500 4544 4f52 4153 5f41 5050" + "00" * 10),
        (("es-restart", "power-on"), "1806 0000 0003 0200 0200"),
        (("sbn", "noop"), "18fa 0000 0001 0000"),
        (("noop", "sbn"), "18fa 0000 0001 0000"),
    ],
)
def test_commands_with_an_argument(what, payload, made):
    assert made(*what)[0][0] == bytes.fromhex(payload)


def test_how_many_may_wait_is_part_of_adding(made):
    assert made("to-add", "0x827", limit=32)[0][0][14] == 32


@pytest.fixture(scope="module")
def extended():
    """The first commands that a real cFE with the extended header got, by MsgId; sequence words as 0."""
    packed = (ROOT / "tests/captures/p6b_extended_header.pcap.zst").read_bytes()
    raw, at, found = zstandard.ZstdDecompressor().decompressobj().decompress(packed), 24, {}
    while at < len(raw):
        length = int.from_bytes(raw[at + 8 : at + 12], "little")
        frame = raw[at + 16 : at + 16 + length]
        at += 16 + length
        if frame[36:38] == (1234).to_bytes(2, "big"):
            found.setdefault(frame[42:44].hex(), frame[42:44] + b"\0\0" + frame[46:])
    return found


def test_commands_of_a_cfe_with_the_extended_header(extended, bench):
    options = SendOptions(headers=cfe.WITH_EXTENDED).placed(bench.mission)
    enable = make(Injection("to-enable", "127.0.0.1"), bench, options)[0].out
    assert enable[0] == extended["1880"]
    changes = Changes(checksum=ChecksumRule.FIX)
    fixed = changes.once(enable)[0]
    assert (cfe.checksum(fixed), fixed[11] != 0, fixed[:11]) == (0, True, enable[0][:11])


def test_messages_for_a_cfe_with_the_extended_header(extended):
    settings = Settings([MISSIONS / "rover_ground.yaml"], options=Options(extended_header=True))
    bench = settings.workbench()
    options = SendOptions(headers=cfe.WITH_EXTENDED).placed(bench.mission)
    real = bench.types.decode(TWIST, extended["1827"][32:])
    ours = make(Injection("/cmd_vel", json.dumps(real)), bench, options)[0].out
    assert ours[0] == extended["1827"]


def test_counts(made):
    assert made(CMD, count=50)[1].passes == 50
    assert made(CMD, count=0)[1].passes == 0


def test_random_messages_are_all_different_and_the_same_again(made, bench):
    out, options = made(CMD, every_field_random=True, count=20, seed=4)
    again = made(CMD, every_field_random=True, count=20, seed=4)[0]
    other = made(CMD, every_field_random=True, count=20, seed=5)[0]
    packets = [out[row] for row in range(20)]
    assert packets == [again[row] for row in range(20)]
    assert packets != [other[row] for row in range(20)]
    assert len(set(packets)) == 20
    assert options.passes == 1
    values = bench.types.decode(TWIST, packets[0][24:])
    assert all(value != 0 for part in values.values() for value in part.values())


def test_a_long_random_run_keeps_its_count(made, monkeypatch):
    monkeypatch.setattr("edoras_tools.pipelines.sending.inject._MOST", 64)
    for count in (64, 65, 1000, 127):
        out, options = made(CMD, every_field_random=True, count=count)
        assert len(out) * options.passes == count
        assert len(out) <= 64
    out, options = made(CMD, every_field_random=True, count=0)
    assert (len(out), options.passes) == (64, 0)


@pytest.mark.parametrize(
    ("what", "injection", "error", "words"),
    [
        (
            ["/nope"],
            {},
            RouteError,
            "'/nope' is not configured; there are .*; commands with a name: to-enable",
        ),
        ([CMD, "{linear: {q: 1}}"], {}, FieldError, "linear: .*Vector3 has no field q; it has x, y, z"),
        ([CMD, "{linear: {x: fast}}"], {}, FieldError, "linear.x: takes a number that fits float64, not str"),
        ([CMD, "5"], {}, ConfigError, "needs fields and values"),
        ([CMD, "{linear:{x: 1}"], {}, ConfigError, "is not YAML: line 1, column 9"),
        ([CMD, "@/nowhere/at/all"], {}, ConfigError, "/nowhere/at/all: cannot be read: No such file"),
        ([CMD, "{}"], {"every_field_random": True}, ConfigError, "leave the message out"),
        (
            [CMD],
            {"to": Receiver.SBN},
            RouteError,
            "does not go to sbn: --to ci; topics that go to sbn: /robot_1/pose",
        ),
        (["/robot_1/cmd_vel"], {}, RouteError, "does not go to ci: it comes from cFS"),
        (["noop"], {}, ConfigError, "noop takes a MsgId or an app .*and none is named"),
        (["noop", "nobody"], {}, ConfigError, "not 'nobody'"),
        (["noop", "0x803"], {}, FieldError, "lacks the command bit"),
        (["to-enable", "everywhere"], {}, ConfigError, "takes an IPv4 address"),
        (["es-noop", "twice"], {}, ConfigError, "es-noop takes no argument"),
        (["to-add", "all"], {}, ConfigError, "to-add takes a MsgId, e.g. 0x0827, not 'all'"),
        (["to-remove", "0x10827"], {}, ConfigError, "to-remove takes a MsgId"),
        (["evs-reset-filters"], {}, ConfigError, "takes the name of an application"),
        (["es-restart-app", "A" * 20], {}, ConfigError, "19 bytes at most"),
        (["es-start-app", "OTHER"], {}, ConfigError, "of 'OTHER' write NAME,FILE,ENTRY"),
        (["es-start-app", "OTHER,/cf/other.so"], {}, ConfigError, "takes the name of an application, or"),
        (
            ["es-start-app", "OTHER,/cf/other.so,Main,300"],
            {},
            ConfigError,
            "takes the name of an application",
        ),
        (["es-start-app", f"OTHER,/cf/{64 * 'x'},Main"], {}, ConfigError, "63 bytes at most"),
        (["es-restart", "now"], {}, ConfigError, "es-restart takes processor or power_on, not 'now'"),
        (["to-remove", "0x827"], {"limit": 3}, ConfigError, "--limit is of to-add"),
        ([CMD], {"limit": 3}, ConfigError, "--limit is of to-add"),
        ([], {"command": (0x1880, 300)}, FieldError, "300 exceeds 7 bits"),
        ([], {"command": (0x803, 0)}, FieldError, "lacks the command bit"),
    ],
)
def test_what_cannot_be_sent_says_why(what, injection, error, words, made):
    with pytest.raises(error, match=words) as caught:
        made(*what, **injection)
    assert isinstance(caught.value, EdorasError)
    assert "\n" not in str(caught.value)


def test_commands_with_arguments_are_as_c_declares_them(made):
    for typed, msg_id, code, declared in DECLARED:
        what, *words = typed.split()
        packet = made(what, " ".join(words), words=tuple(words))[0][0]
        values = [value.encode() if isinstance(value, str) else value for _, value in declared]
        payload = struct.pack("<" + "".join(form for form, _ in declared), *values)
        assert packet == struct.pack(">HHHBB", msg_id, 0, len(payload) + 1, code, 0) + payload, typed


@pytest.mark.parametrize(
    ("typed", "why"),
    [
        ("to-add-pkt stream=0x0827 limit=300", "limit takes a whole number from 0 to 255, not '300'"),
        ("to-add-pkt limit=3", "needs stream=MSGID"),
        ("to-add-pkt stream=0x82777", "stream takes a MsgId, e.g. 0x0827 or SB_HK, not '0x82777'"),
        ("es-stop-app aplication=X", "takes application, not 'aplication'; did you mean application?"),
        ("es-restart restart_type=warm", "restart_type takes processor or power_on, not 'warm'"),
        ("time-set-met seconds=3 microseconds=1000000", "from 0 to 999999, not '1000000'"),
        ("es-stop-app application=ABCDEFGHIJKLMNOPQRST", "TEXT of 1 to 19 bytes"),
        ("to-enable-output address=1.2.3", "an IPv4 address, as 127.0.0.1, not '1.2.3'"),
        ("evs-reset-filter CFE_SB 3 4", "takes application, event_id; what is '4'?"),
    ],
)
def test_an_argument_that_is_none_is_one_clear_line(made, typed, why):
    what, *words = typed.split()
    with pytest.raises(ConfigError) as caught:
        made(what, " ".join(words), words=tuple(words))
    assert why in str(caught.value)
    assert "\n" not in str(caught.value)


def test_every_command_is_listed_with_its_arguments():
    text = described_commands()
    assert len(text.splitlines()) == len(CALLS) == len(ARGUMENTS)
    assert "to-add-pkt                   stream [priority=low] [reliability=low] [limit=4]" in text
    assert "stack_size        0 to 4294967295          bytes (default: 65536)" in described_commands(
        "es-start"
    )


STORE = TypeStore()
NAMES = [
    "geometry_msgs/msg/Twist",
    "sensor_msgs/msg/JointState",
    "sensor_msgs/msg/Imu",
    "nav_msgs/msg/Odometry",
    "sensor_msgs/msg/PointCloud2",
    "std_msgs/msg/Empty",
    "rcl_interfaces/msg/Log",
]


@pytest.mark.parametrize("name", [*NAMES, *STORE.types()[::40]])
def test_values_encode_and_come_back(name):
    if not STORE.has(name):
        pytest.skip("its definition is not complete")
    values = arbitrary(STORE, name, Random(1))
    assert set(values) == {field.name for field in STORE.fields(name)}
    assert STORE.decode(name, STORE.encode(name, values)) == values


def test_a_seed_gives_the_same_message_and_another_seed_another():
    one, same, other = (arbitrary(STORE, NAMES[1], Random(seed)) for seed in (1, 1, 2))
    assert one == same != other
    assert all(one[name] for name in ("name", "position", "velocity", "effort"))
