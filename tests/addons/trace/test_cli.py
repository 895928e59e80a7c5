"""``edoras trace`` as a shell sees it."""

import re
from xml.etree import ElementTree as ET

import pytest


@pytest.fixture
def rover(captures, missions):
    return [captures("a_rover"), *missions("rover_ground")]


def test_a_message_that_was_lost(call, rover):
    """At most 80 columns, times that add up, the end in words, and exit code 3."""
    done = call("trace", *rover, 159)
    assert (done.code, done.err) == (3, [])
    lines = done.out.splitlines()
    assert lines[0] == "/cmd_vel (0x1827 on CI), message 25 of 600"
    assert "✗ lost: over the message limit of EDORAS_APP_PIPE (proven)" in lines
    assert re.search(r"^● CI .* 6\.233076 s +\+57\.181 ms  by model$", done.out, re.MULTILINE)
    assert "│   4 of 4 waited (limit assumed): full" in lines
    assert max(map(len, lines)) <= 100


@pytest.mark.parametrize(
    "which", [(159,), ("--topic", "/cmd_vel", "--nth", 25), ("/cmd_vel", "--nth", 25), ("--lost", 3)]
)
def test_the_same_message_by_each_of_its_names(call, rover, which):
    path, *mission = rover
    done = call("trace", path, *which, *mission, "--json").json()
    assert done["timing"] is None
    trace = done["trace"]
    assert (trace["nth"], trace["of"], trace["ended"]["ending"]) == (25, 600, "lost")
    assert trace["delay_ns"] == sum(step["after_ns"] or 0 for step in trace["steps"])


def test_the_rounds_of_a_topic(call, rover):
    done = call("trace", *rover, "--topic", "/cmd_vel")
    assert done.code == 0
    assert "mostly 4 of 5 came out per 500 ms: in 92 rounds" in done.out
    assert "● ● ● ● ✗ ● ● ● ● ✗" in done.out
    assert "1 2 3 4 4 1 2 3 4 4" in done.out
    timing = call("trace", *rover, "--topic", "0x1827", "--json").json()["timing"]
    assert {"out": 4, "of": 5, "count": 92} in timing["rounds"]
    assert timing["endings"] == [{"number": 92, "text": "over the message limit of EDORAS_APP_PIPE"}]
    assert sum(not item["out"] for item in timing["messages"]) == 92


@pytest.mark.each(2)
@pytest.mark.parametrize("suffix", ["svg", "html", "mmd"])
@pytest.mark.parametrize("which", [(131,), ("--topic", "/cmd_vel")])
def test_as_a_picture(call, rover, tmp_path, suffix, which):
    path = tmp_path / f"new/t.{suffix}"
    done = call("trace", *rover, *which, "-o", path)
    if (suffix, which[0]) == ("mmd", "--topic"):
        assert done.code == 2
        assert "Mermaid draws one message: add --nth" in done.err[0]
        return
    assert (done.code, done.out) == (0, "")
    text = path.read_text()
    if suffix == "svg":
        tree = ET.fromstring(text)
        assert tree.get("role") == "img"
        assert "/cmd_vel" in tree.get("aria-label")
        assert any("/cmd_vel (0x1827 on CI)" in (item.text or "") for item in tree.iter())
    elif suffix == "mmd":
        assert text.startswith("sequenceDiagram\n    participant P0 as publisher\n")
        assert "+356.968 ms (measured)" in text
    assert call("trace", *rover, *which, "-o", path).code == 2


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "say which message: a packet's number, --topic /cmd_vel --nth 12, or --lost 3"),
        (["--nth", 3], "--nth 3 of which topic? Add --topic"),
        ([99999], "packet 99999 is no message of a link, or a copy of one; edoras sniff shows it"),
        (["--lost", 93], "--lost 93: 92 messages were lost"),
        (["--topic", "/cmd_vel", "--nth", 601], "--nth 601: /cmd_vel has 600 messages"),
        (["--topic", "/cmd_vl", "--nth", 1], "no message of '/cmd_vl' is there; did you mean /cmd_vel?"),
        ([12, "--lost", 1], "name one message: a packet, --topic with --nth, or --lost"),
        ([12, "-o", "x.pdf"], "x.pdf: .pdf is no picture; use .svg, .html or .mmd"),
    ],
)
def test_what_is_not_there(call, rover, words, said):
    path, *mission = rover
    done = call("trace", path, *words, *mission)
    assert (done.code, done.out) == (2 if said[:3] in {"say", "nam", "x.p"} or words[0] == "--nth" else 1, "")
    assert done.err[-1].removeprefix("edoras: ") == said


def test_a_topic_without_a_name_is_named_once(call, captures):
    assert call("trace", captures("a_rover"), "--lost", 3).out.startswith("0x1827 on CI, message 25 of 600\n")
    assert call("trace", captures("a_rover"), "--topic", "0x1827").out.startswith("0x1827 on CI\n")


def test_the_time_that_it_took_is_of_the_delays_of_the_doctor(call, rover):
    """Its steps add up to it, and its p50 is the one of the table."""
    trace = call("trace", *rover, "--topic", "/cmd_vel", "--nth", 12, "--json").json()["trace"]
    times = [step["time_ns"] for step in trace["steps"] if step["time_ns"] is not None]
    assert times[-1] - times[0] == trace["delay_ns"]
    (row,) = [row for row in call("doctor", *rover, "--json").json()["routes"] if row["topic"] == "/cmd_vel"]
    assert trace["usual"]["p50_ms"] == pytest.approx(row["to_robot"]["p50_ms"])
    (line,) = [
        line for line in call("doctor", *rover, "-v").out.splitlines() if line.startswith("CI    0x1827")
    ]
    assert "258 ms" in line


def test_without_a_file(call):
    done = call("trace")
    assert (done.code, done.err) == (2, ["edoras: name the file, and what to follow: edoras trace FILE 417"])
