"""Commands that are made up are, byte for byte, those that F Prime's own ground system sends."""

import json
import socket

import pytest
from fprime_session import CAPTURE, DICTIONARY, SESSION, ask, why_not
from rewriting import datagrams
from waiting import HOST

COMMANDS = [item for item in SESSION if "command" in item]
MOVE = "Rover.drive.MOVE"
GOOD = {"distance": 1.5, "mode": "DRIVING", "careful": True}
LEG = {"to": {"x": 1, "y": 2, "heading": 0}, "speeds": [1, 2, 3], "label": "dock", "mode": "DRIVING"}
DESCRIBED = ("--set", f"structs={DICTIONARY}")


def sent(call, *words):
    """Return what ``inject`` sends to flight software's server."""
    with socket.create_server((HOST, 0)) as flight:
        flight.settimeout(60)
        where = ("--target", f"{HOST}:{flight.getsockname()[1]}", "--linger", "0s", "-q")
        done = call("inject", *words, "--to", "fprime:up", *where, *DESCRIBED)
        assert done.code == 0, done.err
        connection = flight.accept()[0]
        with connection:
            data = b""
            while more := connection.recv(65536):
                data += more
    return data


@pytest.mark.each(3)
@pytest.mark.skipif(bool(why_not()), reason=why_not() or "")
@pytest.mark.parametrize("item", COMMANDS, ids=[item["command"] for item in COMMANDS])
def test_a_command_is_what_its_ground_system_sends(item, call):
    ((one),) = ask([item])["send"]
    assert sent(call, item["command"], json.dumps(item["args"])) == bytes.fromhex(one["frames"]["ccsds"])


@pytest.mark.skipif(bool(why_not()), reason=why_not() or "")
def test_each_of_several_has_the_next_count(call):
    item = {"command": MOVE, "args": [1.5, "DRIVING", True]}
    frames = [bytes.fromhex(one["frames"]["ccsds"]) for one in ask([item] * 3)["send"]]
    assert sent(call, MOVE, json.dumps(GOOD), "-n", "3", "--rate", "50") == b"".join(frames)


def test_the_sample_has_the_same_frame(call):
    """The session of the sample began with this command."""
    assert sent(call, "Rover.cmdDisp.CMD_NO_OP") == datagrams(CAPTURE)[0].payload


@pytest.mark.parametrize(
    ("what", "values", "words"),
    [
        ("Rover.drive.MOV", GOOD, "is no command of the dictionary; did you mean Rover.drive.MOVE"),
        (MOVE, {"mode": 1}, "takes distance, mode, careful: distance is not there"),
        (MOVE, GOOD | {"speed": 1}, "takes distance, mode, careful: speed is none of them"),
        (MOVE, [1.5], "takes distance, mode, careful; not [1.5]"),
        (MOVE, GOOD | {"distance": "far"}, "MOVE.distance takes a number, not 'far'"),
        (MOVE, GOOD | {"distance": 1e300}, "MOVE.distance: 1e+300 does not fit float32"),
        (MOVE, GOOD | {"mode": "FLYING"}, "MOVE.mode takes "),
        (MOVE, GOOD | {"mode": [1]}, "MOVE.mode takes "),
        (MOVE, GOOD | {"careful": 1}, "MOVE.careful takes true or false, not 1"),
        ("Rover.cmdDisp.CMD_NO_OP", [1], "takes no argument; not [1]"),
        ("Rover.cmdDisp.CMD_NO_OP_STRING", ["x" * 999], "takes a text of at most"),
        ("Rover.drive.FOLLOW", [[LEG], "a", 1], "takes a list of 2, not [{"),
        (
            "Rover.drive.FOLLOW",
            [[LEG, LEG | {"speeds": [1, 2, -1]}], "a", 1],
            "speeds: -1 does not fit uint16",
        ),
    ],
)
def test_what_does_not_fit_is_one_line(what, values, words, call):
    done = call("inject", what, json.dumps(values), "--to", "fprime:up", "--dry-run", *DESCRIBED)
    assert (done.code, len(done.err)) == (2, 1)
    assert words in done.err[0]


def test_what_is_needed_is_said(call):
    assert "--set structs=FILE.json" in call("inject", MOVE, "--to", "fprime:up", "--dry-run").err[0]
    assert "--to fprime:up" in call("inject", MOVE, "--to", "fprime", "--dry-run", *DESCRIBED).err[0]
