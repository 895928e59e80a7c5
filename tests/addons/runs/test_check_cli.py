"""``edoras check`` as a shell sees it."""

import json
import re

import pytest
from places import ROOT


@pytest.fixture
def rover(captures, missions):
    return captures("a_rover"), missions("rover_ground")


@pytest.fixture
def expect(tmp_path):
    def write(text):
        path = tmp_path / "expect.yaml"
        path.write_text(text)
        return path

    return write


def test_exit_codes_and_lines(call, rover, expect):
    path, mission = rover
    done = call("check", path, expect("topics: {/cmd_vel: {count: 600}}\n"), *mission)
    assert (done.code, done.err) == (0, [])
    assert done.out.splitlines()[2:] == ["✓ /cmd_vel  count 600  600 messages", "", "1 expectation met."]
    done = call("check", "-r", path, expect("lost: 0\nduration: at least 60s\n"), *mission)
    assert done.code == 3
    assert "✗ capture  lost 0  92 of 1,183 (7.78%)" in done.out.splitlines()
    assert done.out.splitlines()[-1] == "1 of 2 expectations not met."


def test_quiet_says_only_what_is_not_met(call, rover, expect):
    path, mission = rover
    assert call("check", path, expect("lost: at most 8%\n"), *mission, "-q").out == ""
    assert "✗ capture" in call("check", path, expect("lost: 0\n"), *mission, "-q").out


@pytest.mark.quick("e_ci_errors")
@pytest.mark.parametrize("name", ["a_rover", "e_ci_errors"])
def test_json_holds_to_its_schema(name, call, captures, missions, expect):
    path = expect(
        "topics:\n  /cmd_vel:\n    lost: 0\n    fields: [{always: linear.x < 9}]\n"
        "events: {never: Pipe Overflow}\nfindings: []\nverdicts: []\n"
    )
    done = call("check", captures(name), path, *missions("rover_ground"), "--json")
    told = done.json()
    assert (done.code, told["passed"]) == (3, False)
    assert told["failed"] == sum(not item["passed"] for item in told["results"])


def test_a_draft_and_what_it_says(call, rover, tmp_path, monkeypatch):
    path, mission = rover
    done = call("check", "--init", path, *mission)
    assert done.code == 0
    assert "edoras: /cmd_vel: lost 92 of 600 in 1 run; the draft accepts up to 18.6%" in done.err
    monkeypatch.chdir(tmp_path)
    assert call("check", "--init", path, *mission, "-o", "new/expect.yaml", "-q").err == []
    written = (tmp_path / "new/expect.yaml").read_text()
    assert written == done.out
    assert call("check", path, "new/expect.yaml", *mission).code == 0
    done = call("check", "--init", path, *mission, "-o", "new/expect.yaml")
    assert (done.code, (tmp_path / "new/expect.yaml").read_text()) == (2, written)
    assert "exists; name another output, or replace it with --force" in done.err[0]


def test_what_nobody_examined_is_never_green(call, tmp_path):
    path, expect = ROOT / "tests/captures/n10_uplink_loss.pcap.zst", tmp_path / "expect.yaml"
    done = call("check", "--init", path, "-o", expect)
    assert done.code == 3
    assert done.err[0].endswith("incomplete: name the ports, and draft again")
    done = call("check", path, expect)
    assert done.code == 3
    (unmet,) = [line for line in done.out.splitlines() if line.startswith("✗")]
    assert unmet.startswith("✗ verdicts  not_examined is not allowed  226 datagrams on port 5234")
    named = ("--port", "ci:5234")
    assert call("check", "--init", path, "-o", expect, "--force", *named).code == 0
    assert call("check", path, expect, *named).code == 0


def test_junit_beside_the_lines(call, rover, expect, tmp_path):
    junitparser = pytest.importorskip("junitparser")
    path, mission = rover
    done = call(
        "check", path, expect("lost: 0\nduration: at least 1s\n"), *mission, "--junit", tmp_path / "r.xml"
    )
    assert done.code == 3
    (suite,) = junitparser.JUnitXml.fromfile(str(tmp_path / "r.xml"))
    assert (suite.tests, suite.failures) == (2, 1)


def test_live_traffic_is_judged_at_the_end(edoras, expect):
    """Nothing comes in the meantime, which is no success."""
    done = edoras("check", "--listen", "0", "--duration", "200ms", expect("duration: at least 1s\n"))
    assert done.returncode == 3
    assert "✗ capture  input datagrams of a link  none" in done.stdout.decode()


def test_what_nothing_counts_is_not_taken_for_no_loss(rover, call, expect, tmp_path):
    """Of commands without telemetry it is not known what was lost: no bound of it is met, none is drafted."""
    path, mission = rover
    blind = tmp_path / "blind.pcap"
    assert call("record", path, *mission, "--link", "ci", "-o", blind).code == 0
    done = call("check", blind, expect("lost: 0\ntopics: {/cmd_vel: {lost: at most 1%}}\n"), *mission)
    assert done.code == 3
    assert "✗ /cmd_vel  lost at most 1%  0 of 600 (0.00%); the rest is not observable: no 0x884" in done.out
    assert call("doctor", blind, *mission, "--max-loss", "1%").code == 3
    drafted = call("check", "--init", blind, *mission)
    assert "  lost:" not in drafted.out
    assert "what was lost is not observable: no 0x884" in "".join(drafted.err)
    (tmp_path / "drafted.yaml").write_text(drafted.out)
    assert call("check", blind, tmp_path / "drafted.yaml", *mission).code == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["check"], "name the expectations last"),
        (["check", "expect.yaml"], "two files are needed"),
        (["check", "a.pcap", "none.yaml"], "none.yaml: cannot be read"),
        (["check", "a.pcap", "bad.yaml"], "did you mean /cmd_vel?"),
        (
            ["check", "a.pcap", "expect.yaml", "-o", "x"],
            "--output is an option of --init, --force of --init and --junit",
        ),
        (["check", "a.pcap", "expect.yaml", "--force"], "--force of --init and --junit"),
        (["check", "a.pcap", "expect.yaml", "--duration", "1"], "--duration ends live traffic"),
        (
            ["check", "--listen", "0", "expect.yaml", "--start", "1"],
            "--start and --end select part of a file",
        ),
        (["check", "a.pcap", "expect.yaml", "--junit", "a.pcap"], "would overwrite its own input"),
        (["check", "a.pcap", "expect.yaml", "--junit", "expect.yaml"], "would overwrite its own input"),
        (["check", "--init"], "--init drafts from a recording"),
        (["check", "--init", "-i", "lo"], "--init drafts from a recording"),
        (["check", "--init", "a.pcap", "--json"], "--init only drafts"),
        (["check", "--init", "a.pcap", "-o", "a.pcap", "--force"], "would overwrite its own input"),
    ],
)
def test_bad_input_is_one_line(arguments, words, call, rover, tmp_path, monkeypatch):
    path, mission = rover
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.pcap").write_bytes(path.read_bytes())
    (tmp_path / "expect.yaml").write_text("lost: 0\n")
    (tmp_path / "bad.yaml").write_text("topics: {/cmd_vle: {count: 1}}\n")
    before = {item.name: item.read_bytes() for item in tmp_path.iterdir()}
    done = call(*arguments, *mission)
    assert (done.code, done.out, len(done.err)) == (2, "", 1)
    text = json.loads(done.err[0])["error"] if "--json" in arguments else done.err[0]
    assert words in (f"{text['message']}; {text['hint']}" if isinstance(text, dict) else text)
    assert {item.name: item.read_bytes() for item in tmp_path.iterdir()} == before


def test_half_a_file_fails_after_its_results(call, rover, expect, tmp_path):
    path, mission = rover
    half = tmp_path / "half.pcap"
    half.write_bytes(path.read_bytes()[:100_000])
    done = call("check", half, expect("duration: at least 1s\n"), *mission)
    assert done.code == 1
    assert "✗ capture  input read to its end" in done.out
    assert re.search(r"half\.pcap.*cut", done.err[-1])
