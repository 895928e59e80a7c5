"""Files are named bare or with ``-r`` on every command that reads, and the same part of them is taken."""

import pytest
from places import ROOT

CAPTURES = ROOT / "samples/captures"
ROVER, ARM = CAPTURES / "a_rover.pcap", CAPTURES / "b_arm_single.pcap"
COMMANDS = {
    "sniff": ("sniff", "--json"),
    "info": ("info", "--json"),
    "doctor": ("doctor", "--json"),
    "record": ("record", "--json", "-o", "x.mcap", "--force"),
    "report": ("report", "--json", "-o", "x.html", "--force"),
}


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.mark.quick("info")
@pytest.mark.parametrize("words", COMMANDS.values(), ids=COMMANDS)
def test_bare_and_with_the_option(call, words):
    one, other, both = (
        call(*words, *inputs).out for inputs in ([ROVER, ARM], ["-r", ROVER, "-r", ARM], ["-r", ROVER, ARM])
    )
    assert one == other == both
    assert len(one) > 100


@pytest.mark.each(2)
@pytest.mark.quick("info", "doctor")
@pytest.mark.parametrize("words", COMMANDS.values(), ids=COMMANDS)
def test_a_rosbag2_directory_of_ours_is_a_capture(call, words, folder):
    assert call("record", "-q", ROVER, "--rosbag2", "-o", "bag", "--split-count", "700").code == 0
    assert call("record", "-q", ROVER, "-o", "bag.mcap").code == 0
    one, other = (call(*words, item).out.replace('"bag.mcap"', '"bag"') for item in ("bag", "bag.mcap"))
    assert one.replace('"kind": "rosbag2"', '"kind": "mcap"') == other
    assert len(one) > 100


@pytest.mark.quick("10-20-290")
@pytest.mark.parametrize(
    ("start", "end", "count"),
    [(10, 20, 290), (0.5, None, 1755), (None, 1, 72), (None, 100, 1827)],
)
def test_a_part_of_a_capture(call, start, end, count):
    part = [*(["--start", start] if start else []), *(["--end", end] if end else [])]
    times = [item["time_ns"] for item in call("sniff", "--json", ROVER).lines()]
    wanted = [time for time in times if (start or 0) * 10**9 <= time - times[0] < (end or 10**9) * 10**9]
    assert len(wanted) == count
    assert [item["time_ns"] for item in call("sniff", "--json", ROVER, *part).lines()] == wanted
    assert call("info", "--json", ROVER, *part).json()["datagrams"] == count
    assert call("record", "--json", ROVER, *part, "-o", "part.mcap").json()["datagrams"] == count


@pytest.mark.each(3)
@pytest.mark.parametrize("part", [("--start", "70"), ("--start", "2026-12-01"), ("--start", "07:00")])
@pytest.mark.parametrize("words", [["sniff"], ["info"], ["doctor"], ["record", "-o", "part.mcap"]])
def test_a_time_outside_of_the_capture(words, part, call):
    done = call(*words, ROVER, *part)
    assert done.code == 1
    assert "its times go from 0 to 65.270 s, and 0 is 2026-11-21 06:13:56 UTC" in done.err[-1]


def test_a_file_in_front_of_its_command(edoras):
    one, other = edoras(ROVER, "info"), edoras("info", ROVER)
    assert (one.returncode, one.stdout) == (0, other.stdout)


def test_without_words_it_shows_its_help(edoras):
    done = edoras()
    assert done.returncode == 2
    assert done.stderr.startswith(b"Usage: edoras [OPTIONS] COMMAND")
    assert b"edoras: " not in done.stderr


def test_an_interface_that_is_no_file(call):
    assert call("sniff", "lo").err == ["edoras: lo: there is no such file; for live traffic: -i lo"]


def test_times_count_from_the_start_of_the_capture(call):
    """Whatever is chosen: a time in the list is one for ``--start``, and that of the field ``time``."""
    lines = call("sniff", ROVER, "--msg-id", "to_cmd").out.splitlines()
    assert lines[1].split()[:2] == ["73", "1.775601"]
    assert call("sniff", ROVER, "--start", "1.77", "--end", "1.78").out.splitlines()[1:] == lines[1:]


@pytest.mark.parametrize("topic", ["SB_HK", "SB_*", "TO_CMD"])
def test_names_of_msg_ids_stand_for_topics(call, topic):
    ids = {item["msg_id"] for item in call("sniff", "--json", ROVER, "--topic", topic).lines()}
    assert ids == {"TO_CMD": {"0x1880"}}.get(topic, {"0x0803"})


@pytest.mark.each(3)
@pytest.mark.parametrize(
    ("size", "files"), [("50kB", 5), ("48 KiB", 5), ("0.05M", 5), ("1GB", 1), ("1TiB", 1)]
)
def test_sizes(call, tmp_path, size, files):
    assert call("record", "-q", ROVER, "-o", "a.mcap", "--split-size", size).code == 0
    assert len(list(tmp_path.glob("a_*.mcap"))) == files


def test_minutes(call, tmp_path):
    assert call("record", "-q", ROVER, "-o", "a.mcap", "--split-time", "1min").code == 0
    assert len(list(tmp_path.glob("a_*.mcap"))) == 2
