"""An interface that goes away and comes back while commands read it, in a namespace of the test's own."""

import contextlib
import json
import signal
import struct

import pytest
from namespace import Cable, inside
from schema import held
from waiting import Program

HEADER = bytes.fromhex("1827 0000 0045 01 00") + struct.pack("<QQ", 52, 52) + bytes.fromhex("00010000")
CABLE = Cable("cable")


def twist(number):
    return HEADER + struct.pack("<6d", number, 0, 0, 0, 0, 0)


def down():
    CABLE.switch("down")
    yield "down"
    CABLE.switch("up")


def gone():
    CABLE.remove()
    yield "not there"
    CABLE.lay()


def unplugged():
    CABLE.switch("down", CABLE.far)
    yield "without carrier"
    CABLE.switch("up", CABLE.far)


WAYS = (down, gone, unplugged)


def line(program, word):
    """The next line on standard error that has a word."""
    while word not in (text := program.line(program.err)):
        pass
    return text.strip()


def through(program, each):
    """Send some, take the interface away and bring it back, in each way; return what was said."""
    said = []
    for number, way in enumerate(WAYS):
        each(number)
        for why in way():
            said.append(line(program, "waiting"))
            assert said[-1] == f"edoras: cable is {why}; waiting for it"
        said.append(line(program, "back"))
    each(len(WAYS))
    return said


def told_of_the_recording(call, path, report, read):
    """The recording knows it: for programs, for people, for the doctor; also once it was copied."""
    assert call("info", "--json", path).json()["outages"] == report["outages"]
    events = [item.data for item in read.topics["/edoras/events"]]
    for item in report["outages"]:  # and of a longer one, when it began
        words = f"cable was {item['why']} for {(item['end_ns'] - item['start_ns']) / 1e9:.1f} s"
        assert any(words.encode() in data for data in events)
    copy = path.with_name("copy.mcap")
    assert call("record", "-q", "-r", path, "-o", copy).code == 0
    assert call("info", "--json", copy).json()["outages"] == report["outages"]
    found = call("doctor", "--json", copy).json()
    assert found["outages"] == report["outages"]
    said = [item for item in found["verdicts"] if item["rule"] == "not_examined" and "away" in item["reason"]]
    assert [item["start_ns"] for item in said] == [item["start_ns"] for item in report["outages"]]


@pytest.mark.quick("mcap")
@pytest.mark.parametrize("suffix", ["mcap", "pcap"])
def test_record_goes_on(command, call, missions, recording, datagrams, suffix, tmp_path):
    path = tmp_path / f"x.{suffix}"

    def work():
        CABLE.lay()
        arguments = ["--json", "-i", "cable", *missions("rover_ground"), "-o", path]
        with Program(command, "record", *arguments) as program:
            line(program, "capturing")

            def each(number):
                for one in range(20):
                    CABLE.send(twist(100 * number + one))

            through(program, each)
            return program.end(signal.SIGINT)

    out, err = inside(work)
    report = held(json.loads(out), ["record", "--json"])
    sent = [100 * number + one for number in range(4) for one in range(20)]
    if suffix == "mcap":
        came = [struct.unpack_from("<d", item.data, 4)[0] for item in recording(path).topics["/cmd_vel"]]
    else:
        came = [struct.unpack_from("<d", item.payload, 28)[0] for item in datagrams(path)]
    assert came == sent
    assert [item["why"] for item in report["outages"]] == ["down", "not there", "without carrier"]
    assert all(0 < item["start_ns"] <= item["end_ns"] for item in report["outages"])
    assert "edoras: cable was away " in err
    if suffix == "mcap":
        told_of_the_recording(call, path, report, recording(path))
    assert err.rstrip().endswith(", 3 times")


@pytest.mark.long
@pytest.mark.parametrize("words", [("sniff", "--json"), ("live", "--ws-port", "0"), ("doctor",)])
def test_others_go_on(command, missions, words):
    def work():
        CABLE.lay()
        with Program(command, *words, "-i", "cable", *missions("rover_ground")) as program:
            with contextlib.suppress(IndexError):
                line(program, "capturing")
            said = through(program, lambda number: CABLE.send(twist(number)))
            program.end(signal.SIGINT)
            return said

    assert len(inside(work)) == 2 * len(WAYS)


@pytest.mark.long
@pytest.mark.parametrize("lays", [False, True])
def test_an_interface_is_waited_for(command, missions, recording, tmp_path, lays):
    """One that is not there, or is down."""
    path = tmp_path / "x.mcap"

    def work():
        if lays:
            CABLE.lay()
            CABLE.switch("down")
        with Program(
            command,
            "record",
            "--json",
            "--wait-interface",
            "-i",
            "cable",
            *missions("rover_ground"),
            "-o",
            path,
        ) as program:
            why = "is down" if lays else "is not there"
            assert program.line(program.err) == f"edoras: cable {why}; waiting for it\n"
            CABLE.switch("up") if lays else CABLE.lay()
            line(program, "back")
            assert program.line(program.err) == "capturing on cable; Ctrl-C ends\n"
            CABLE.send(twist(7))
            return program.end(signal.SIGINT)

    out, _ = inside(work)
    (outage,) = json.loads(out)["outages"]
    assert outage["why"] == ("down" if lays else "not there")
    assert len(recording(path).topics["/cmd_vel"]) == 1


def test_waiting_goes_with_an_interface(call):
    done = call("sniff", "--listen", "0", "--wait-interface")
    assert (done.code, done.err[-1]) == (
        2,
        "edoras: --wait-interface can only be used with -i IFACE",
    )
