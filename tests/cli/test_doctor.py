"""``edoras doctor`` and ``edoras report`` as a shell sees them."""

import csv
import json
import re
import shutil
import subprocess
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path

import pytest
import zstandard
from effort import long_but
from places import ROOT
from rewriting import datagrams, write

CAPTURES = {
    "a_rover": (("rover_ground",), 3),
    "b_arm_single": (("single_arm_ground",), 0),
    "c1_tlm_rate_limit4": (("rover_ground",), 3),
    "d3_cpu1_cpu2": (("two_rovers_ground", "two_rovers_flight"), 3),
    "e_ci_errors": (("rover_ground",), 3),
    "f_sbn_disconnect": (("two_rovers_ground", "two_rovers_flight"), 3),
}
SMALL = [name for name in CAPTURES if name != "d3_cpu1_cpu2"]


@pytest.mark.quick("a*-True", "b*-False")
@pytest.mark.parametrize("configured", [True, False])
@pytest.mark.parametrize("name", CAPTURES)
def test_json_holds_to_its_schema_and_loss_to_its_exit_code(name, configured, call, captures, missions):
    names, code = CAPTURES[name]
    done = call("doctor", captures(name), "--json", *(missions(*names) if configured else ()))
    assert done.code == code
    assert bool(done.json()["lost"]) == (code == 3)


@pytest.mark.quick("fragments_lost_upward")
@pytest.mark.parametrize("name", ["fragments_lost_upward", "hops_in_turn", "bursts", "copies_on_any"])
def test_the_recording_of_a_capture_gives_the_same_answer(name, call, tmp_path):
    capture, recording = ROOT / f"tests/captures/flights/{name}.pcap.zst", tmp_path / "x.mcap"
    assert call("record", "-q", "-r", capture, "-o", recording).code == 0
    answers = [call("doctor", "--json", "-r", path).json() for path in (capture, recording)]
    for answer in answers:
        # The order of rows is that of the streams, which that of the frames decides.
        answer["balance"], answer["ways"] = (sorted(map(str, answer[part])) for part in ("balance", "ways"))
    names = ("lost", "unaccounted", "uncertain", "messages_lost", "balance", "ways")
    assert [answers[0][name] for name in names] == [answers[1][name] for name in names]
    assert len(answers[0]["warnings"]) == len(answers[1]["warnings"])


def test_commands_alone_are_no_evidence_of_their_arrival(call, captures, missions, tmp_path):
    commands = tmp_path / "commands.pcap"
    write(commands, [item for item in datagrams(captures("a_rover")) if item.destination[1] == 1234])
    done = call("doctor", commands, *missions("rover_ground"))
    assert done.code == 3
    assert done.out.startswith("No evidence: nothing here counts what arrived of 601 /cmd_vel and TO_CMD.")
    assert "No loss" not in done.out
    assert "Nothing here counts" not in done.out


@pytest.mark.each(3)
@pytest.mark.long("d3_cpu1_cpu2", "c1_tlm_rate_limit4")
@pytest.mark.parametrize("name", CAPTURES)
def test_people_read_verdicts_first(name, call, captures, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    done = call("doctor", "-v", captures(name))
    assert max(map(len, done.out.splitlines())) <= 100
    marked = [line for line in done.out.splitlines() if line.startswith(("✗", "!", "·"))]
    assert all(re.match(r"[✗!·] \w+ ", line) for line in marked)
    assert done.out.index(marked[0]) < done.out.index("Link  MsgId")


@pytest.mark.long
def test_many_verdicts_alike_are_one_entry(call, captures, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    told = call("doctor", captures("e_ci_errors"), "--json").json()["verdicts"]
    out = call("doctor", "-v", captures("e_ci_errors")).out
    for severity, mark, lost in (("error", "✗", True), ("warning", "!", False)):
        alike = [item for item in told if (item["rule"], item["severity"]) == ("bad_command", severity)]
        assert len(alike) >= 4
        head = f"{mark} bad_command  {len(alike)} times"
        assert out.count(f"{mark} bad_command") == out.count(head) == 1
        entry = out.partition(head)[2].partition("\n\n")[0]
        assert all(item["reason"] in entry for item in alike)
        assert ("lost in all" in entry.splitlines()[0]) == lost
        when = [float(item) for item in re.findall(r"^  ([\d.]+) s", entry, re.MULTILINE)]
        assert when == sorted(when)
        assert len(when) == len(alike)


@pytest.mark.long
def test_two_senders_of_one_msg_id_are_told_apart(call, captures, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    done = call("doctor", "-v", captures("d3_cpu1_cpu2"))
    rows = [line for line in done.out.splitlines() if line.startswith("TO    0x0800")]
    assert {re.search(r"66:\d :\d+", row)[0] for row in rows} == {
        f"66:{number} :{port}" for number in (1, 2) for port in (49211, 57839)
    }
    assert "\n6,601 messages were lost: " in done.out
    alone = call("doctor", "-v", captures("a_rover"))
    assert "Sent by" not in alone.out


def test_the_sentence_of_the_rover(call, captures):
    done = call("doctor", "-v", captures("a_rover"))
    assert (
        "92 of 600 commands on 0x1827 lost at EDORAS_APP_PIPE: it keeps 4 of one MsgId, and CI hands over a "
        "burst every 500 ms"
    ) in done.out
    assert "92 of 600 0x1827 were lost." in done.out


def test_a_file_alone_is_diagnosed_and_quiet_is_line_1(call, captures, missions):
    rover, mission = captures("a_rover"), missions("rover_ground")
    line = "About 1 in 7 commands never arrived: 92 of 600 /cmd_vel were lost.\n"
    screen = call("doctor", rover, *mission)
    assert (screen.code, screen.out.startswith(line)) == (3, True)
    for words in ([rover, *mission], [*mission, rover]):
        assert call(*words).out.startswith(line)
    assert call("-q", rover, *mission).out == call("doctor", "-q", rover, *mission).out == line
    assert call("none.pcap").err == ["edoras: none.pcap: there is no such file; check the name"]
    assert call("sniif", rover).code == 2
    page = call("doctor", "--json", rover, *mission).json()["summary"]
    assert page["headline"] == line.rstrip()
    assert all(item in " ".join(screen.out.split()) for item in (page["problems"][0]["text"], page["fine"]))


def test_the_last_line_of_the_screen_can_be_typed(call, captures, missions):
    words = "-c", missions("rover_ground")[1], captures("a_rover")
    more = call("doctor", *words).out.splitlines()[-1]
    command = more.removeprefix("More: edoras ").partition(" | ")[0].split()
    assert "Link  MsgId" in call(*command).out
    assert "More:" not in call("doctor", "-v", *words).out


@pytest.mark.long
def test_what_is_chosen_is_shown_and_the_rest_is_counted(call, captures, missions, tmp_path):
    rover = captures("a_rover")
    options = *missions("rover_ground"), "--topic", "telemetry_pose"
    done = call("doctor", rover, *options)
    assert done.code == 0
    assert "Only topic=telemetry_pose is shown" in " ".join(done.out.split())
    assert "92 lost" in done.out
    assert "app_pipe_limit" not in done.out
    assert call("doctor", rover, "--json", *options).json()
    page = tmp_path / "page.html"
    assert call("report", rover, "-o", page, *options).code == 0
    assert "rate of 0x0827" in page.read_text()
    assert "rate of 0x1827" not in page.read_text()
    cut = call("doctor", rover, *options, "--start", "30", "--json").json()
    assert cut["not_examined"] > 500
    unknown = call("doctor", rover, *missions("rover_ground"), "--topic", "nothing")
    assert unknown.err == [
        "edoras: no configured topic matches 'nothing'; there are: /cmd_vel, /telemetry_pose"
    ]
    listed = call("doctor", rover, "--list-lost", "csv", "--start", "30", "--msg-id", "0x1827")
    assert 0 < len(listed.out.splitlines()) - 1 < 92


@pytest.mark.long
@pytest.mark.parametrize(
    "name",
    long_but(
        ["a_rover", "b_arm_single", "e_ci_errors"], ["a_rover", "b_arm_single", "d3_cpu1_cpu2", "e_ci_errors"]
    ),
)
def test_every_listing_has_as_many_as_are_lost(name, call, captures):
    lost = call("doctor", captures(name), "--json").json()["lost"]
    code = 3 if lost else 0
    listed = call("doctor", captures(name), "--list-lost", "json")
    assert (listed.code, listed.err, listed.json()["lost"]) == (code, [], lost)
    assert [item["count"] for item in listed.json()["missing"]] == [1] * lost
    told = call("doctor", captures(name), "--list-lost", "csv")
    assert (told.code, len(list(csv.DictReader(told.out.splitlines())))) == (code, lost)
    table = call("doctor", captures(name), "--list-lost", "table").out
    assert table.splitlines()[-1].startswith(f"{lost:,} message")


@pytest.mark.long
@pytest.mark.parametrize(
    ("order", "together"),
    long_but([(1, True), (-1, False)], [(1, True), (-1, True), (1, False), (-1, False)]),
    ids=["aligned", "aligned, the later first", "clock assumed", "clock assumed, the later first"],
)
def test_a_listing_of_several_files_has_as_many_as_are_lost(order, together, call, captures, tmp_path):
    traffic = datagrams(captures("d3_cpu1_cpu2"))
    ports = {1235} if together else {1234}
    parts = [
        write(tmp_path / "a.pcap", [item for item in traffic if item.destination[1] not in ports]),
        write(tmp_path / "b.pcap", [item.at(10**9) for item in traffic if item.destination[1] in ports]),
    ][::order]
    found = call("doctor", *parts, "--json").json()
    (note,) = found["warnings"]
    assert "its clock is " in note
    assert ("its clock is assumed" in note) == (not together)
    listed = call("doctor", *parts, "--list-lost", "json")
    assert (listed.code, listed.err) == (3, [f"edoras: {note}"])
    assert listed.json()["lost"] == len(listed.json()["missing"]) == found["lost"] > 6000
    rows = [row for row in found["balance"] if row["lost"]]
    by_msg_id = Counter(item["msg_id"] for item in listed.json()["missing"])
    assert by_msg_id == sum((Counter({row["msg_id"]: row["lost"]}) for row in rows), Counter())


@pytest.mark.long
def test_a_listing_of_two_files_has_the_values_of_each(call, captures, missions, tmp_path):
    """Packets of both are numbered from 1 in their own file; CI of the first counted none of the second."""
    rover, others = datagrams(captures("a_rover")), datagrams(captures("d3_cpu1_cpu2"))
    shift_ns = rover[0].time_ns - others[0].time_ns
    commands = [item.at(shift_ns) for item in others if item.destination[1] == 1234]
    parts = write(tmp_path / "a.pcap", rover), write(tmp_path / "b.pcap", commands)
    values = []
    for order in (1, -1):
        found = call("doctor", *parts[::order], *missions("rover_ground"), "--list-lost", "json").json()
        values.append([item["message"] for item in found["missing"]])
    assert len(values[0]) == 92 + sum(item.payload[:2] == b"\x18\x27" for item in commands)
    assert None not in values[0]
    assert values[0] == values[1]


def test_what_was_refused_is_listed_by_its_rule(call, captures):
    found = call("doctor", captures("e_ci_errors"), "--list-lost", "json").json()["missing"]
    assert {item["what"].partition(" ")[0] for item in found} >= {"bad_command"}
    assert all(item["number"] is not None for item in found)


@pytest.mark.long
def test_the_headline_holds_all_that_is_lost_and_the_worst_comes_first(call, captures, missions, tmp_path):
    done = call("doctor", "-v", captures("d3_cpu1_cpu2"), *missions("rover_ground"))
    head = done.out.split("✗")[0]
    assert "6,601 messages were lost: 3,641 of 4,239 0x0828 (TO), 2,214 of 3,719 0x0828 (SBN)" in head
    losses = [
        int(text.replace(",", ""))
        for text in re.findall(r"([\d,]+) of [\d,]+ lost, in \d+ periods", done.out)
    ]
    assert losses[0] == max(losses)
    assert "the worst: " in done.out
    page = tmp_path / "page.html"
    assert call("report", captures("d3_cpu1_cpu2"), "-o", page).code == 3
    table = page.read_text().split('id="balance"')[1].split("</table>")[0]
    assert "<th>Not seen</th>" in table
    assert "<th>Superseded</th>" not in table  # empty in every row


def test_predict_needs_no_traffic(call, missions):
    done = call("doctor", "--predict", "--json", *missions("two_rovers_ground", "two_rovers_flight"))
    assert done.code == 0
    limits = {row["msg_id"]: row["limit_hz"] for row in done.json()["routes"]}
    assert limits == {
        "0x1827": 8.0,
        "0x1828": 8.0,
        "0x0828": 8.0,
        "0x0829": 8.0,
        "0x1829": 0.0,
        "0x182a": 0.0,
        "0x082a": 40.0,
        "0x082b": 40.0,
    }
    polled = call(
        "doctor", "--predict", "--json", "--set", "sbn_msg_limit=16", *missions("two_rovers_flight")
    )
    assert {row["limit_hz"] for row in polled.json()["routes"]} == {0.0, 80.0}
    assert "8.0 Hz" in call("doctor", "--predict", *missions("rover_ground")).out


def test_two_captures_are_held_against_each_other(call, captures, frames, write_pcap, tmp_path):
    whole = frames(captures("a_rover"))
    cut = write_pcap(tmp_path / "cut.pcap", [item for at, item in enumerate(whole) if at % 50 or at < 100])
    done = call("doctor", captures("a_rover"), "--against", cut, "--json")
    assert done.code == 3
    assert done.json()["lost"] > 0
    same = call("doctor", captures("a_rover"), "--against", captures("a_rover"))
    assert same.code == 0
    assert "Nothing lost between the two." in same.out
    other = call("doctor", captures("a_rover"), "--against", captures("e_ci_errors"))
    assert (other.code, other.out, len(other.err)) == (1, "", 1)
    assert "no datagram in common" in other.err[0]
    part = call(
        "doctor", captures("a_rover"), "--against", cut, "--link", "to", "--end", "30", "--json"
    ).json()
    assert {row["link"] for row in part["routes"]} == {"to"}
    assert 0 < part["lost"] < done.json()["lost"]


def test_a_bag_is_held_against_the_capture_it_was_made_of(call, captures, missions, tmp_path):
    bag, mission = tmp_path / "bag.mcap", missions("rover_ground")
    assert call("record", "-r", captures("a_rover"), *mission, "-o", bag, "-q").code == 0
    done = call("doctor", captures("a_rover"), *mission, "--bag", bag, "--json")
    (found,), judged = done.json()["bags"], done.json()["diagnosis"]
    assert (done.json()["lost"], judged["lost"], judged["schema"]) == (0, 92, 2)
    assert [(row["topic"], row["same"], row["lost"]) for row in found["routes"]] == [
        ("/cmd_vel", 600, 0),
        ("/telemetry_pose", 63, 0),
    ]
    table = call("doctor", captures("a_rover"), *mission, "--bag", bag, "--topic", "cmd_vel")
    # The bag lacks nothing, and the capture without it shows 92 lost: a bag adds, it never replaces.
    assert (done.code, table.code) == (3, 3)
    assert "92 of 600 /cmd_vel were lost" in table.out
    assert "Nothing lost between the two." in table.out
    assert "/telemetry_pose" not in table.out
    alone = call("doctor", "--bag", bag, "--bag", bag, "--json").json()
    assert alone["lost"] == 0
    assert {row["topic"] for row in alone["bags"][0]["routes"]} >= {"/cmd_vel", "/cfs/robot_command"}


@pytest.mark.long
def test_two_hosts_lost_the_same_messages(call):
    ground, flight = (
        ROOT / "tests/captures" / f"n12_two_hosts_{name}.pcap.zst" for name in ("ground", "flight")
    )
    for first, second in ((ground, flight), (flight, ground)):
        told = call("doctor", first, "--against", second, "--json").json()
        assert (told["lost"], told["common"]) == (0, True)
        assert abs(told["offset_ns"]) < 5_000_000
        # The shaper of the flight host stands in front of both captures.
        assert sum(row["neither"] for row in told["routes"]) == 83


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        ((), 2, "name the input to examine"),
        (("--predict",), 2, "--predict needs a mission"),
        (("--against", "x.pcap"), 2, "--against needs two captures"),
        (("--bag", "x.mcap"), 2, "--bag needs a capture, or a second bag"),
        (("--bag", "x.mcap", "--bag", "y.mcap", "--start", "3"), 2, "no effect on bags alone"),
        (("x.pcap", "--bag", "x.mcap", "--set", "app_msg_limit=8"), 2, "--set has no effect with --bag"),
        (("none.pcap",), 1, "none.pcap"),
        (("x.pcap", "--set", "nothing=1"), 2, "'nothing' is not known"),
        (("x.pcap", "--start", "3", "--end", "2"), 2, "--end is not after --start"),
        (("-i", "lo", "--start", "3"), 2, "use --duration"),
    ],
)
def test_what_cannot_be_done_is_said_in_one_line(arguments, code, words, call):
    done = call("doctor", *arguments)
    assert done.code == code
    assert len(done.err) == 1
    assert words in done.err[0]


class Page(HTMLParser):
    """Reads a page: its text, and everything that would need a network."""

    VOID = frozenset({"meta", "br", "img", "link", "input", "wbr"})

    def __init__(self, text):
        super().__init__()
        self.open, self.words, self.outside, self.tags = [], [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        if tag not in self.VOID:
            self.open.append(tag)
        named = [value for name, value in attributes if name in {"src", "href", "action"}]
        self.outside += [value for value in named if not value.startswith("#")]

    def handle_startendtag(self, tag, attributes):
        self.tags.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)


@pytest.fixture(scope="module")
def reports(tmp_path_factory):
    """The folder of the captures' reports, each written once."""
    return tmp_path_factory.mktemp("reports")


@pytest.fixture
def report(call, reports):
    """A function: the path of a capture's report."""

    def write(capture, *options):
        missions = "".join(f"-{Path(item).stem}" for item in options if item != "-c")
        path = reports / f"{capture.stem}{missions}.html"
        if not path.exists():
            assert call("report", capture, "-o", path, *options).code in {0, 3}
        return path

    return write


@pytest.mark.each(2)
@pytest.mark.quick("a_rover", "f_sbn_disconnect")
@pytest.mark.parametrize("name", long_but(SMALL, CAPTURES))
def test_a_report_is_one_page_that_needs_nothing(name, report, captures, missions):
    text = report(captures(name), *missions(*CAPTURES[name][0])).read_text()
    page = Page(text)
    assert page.open == []
    assert [item for item in page.outside if not item.startswith("#")] == []
    assert "script" not in page.tags
    assert "@import" not in text
    assert "url(" not in text
    assert '<meta name="viewport" content="width=device-width' in text
    assert "prefers-color-scheme: dark" in text
    words = " ".join(page.words)
    assert words.index("Verdicts") < words.index("Rates against limits") < words.index("Accounts")
    assert page.tags.count("svg") >= 2


def test_a_report_sums_up_leads_to_its_parts_and_says_how_it_was_made(report, captures, missions):
    text = report(captures("f_sbn_disconnect"), *missions("two_rovers_ground")).read_text()
    anchors = re.findall(r'<a href="#([\w-]+)">', text)
    assert "verdicts" in anchors
    assert set(anchors) == set(re.findall(r'<section id="([\w-]+)">', text))
    counted = [
        int(item) for item in re.findall(r"<td>(\d+)</td><td>[\d,]+</td></tr>", text.partition("<nav")[0])
    ]
    assert sum(counted) > 0
    assert text.count("<code>edoras inject ") > 0  # a line for each command to paste
    assert re.search(r"<footer.*edoras-tools \d.* UTC<br><code>edoras report .*-c .*two_rovers_ground", text)


@pytest.mark.each(2)
@pytest.mark.quick("a_rover", "f_sbn_disconnect")
@pytest.mark.parametrize("name", long_but(SMALL, CAPTURES))
def test_the_picture_of_the_links_holds_all_that_was_lost(name, report, call, captures, missions):
    options = missions(*CAPTURES[name][0])
    text = report(captures(name), *options).read_text()
    picture = text.partition('<div class="links">')[2].partition("</div>")[0]
    lost = sum(int(item.replace(",", "")) for item in re.findall(r">([\d,]+) lost<", picture))
    assert lost == call("doctor", captures(name), "--json", *options).json()["lost"]
    assert text.index('class="links"') < text.index('id="verdicts"')
    if name == "a_rover":
        assert "600 in, 508 out" in picture


def test_many_verdicts_alike_are_one_table_of_a_report(report, call, captures):
    told = call("doctor", captures("e_ci_errors"), "--json").json()["verdicts"]
    text = report(captures("e_ci_errors")).read_text()
    tables = [part.partition("</table>")[0] for part in text.split('<table class="alike">')[1:]]
    rows = [table.count("<tr><td>") for table in tables]
    alike = [
        [item for item in told if item["rule"] == "bad_command" and item["severity"] == grade]
        for grade in ("error", "warning")
    ]
    assert {len(members) for members in alike} <= set(rows)
    assert text.count("<article") == len(told) - sum(rows) + len(rows)


@pytest.mark.long
def test_charts_of_a_report_are_told_apart(report, captures):
    text = report(captures("d3_cpu1_cpu2")).read_text()
    part = text.partition('id="rates-against-limits"')[2].partition("</section>")[0]
    titles = re.findall(r"<h3>(.*?)</h3>", part)
    assert len(set(titles)) == len(titles) > 8


def test_a_part_of_a_capture_keeps_its_times(call, captures, missions, tmp_path):
    path = tmp_path / "part.html"
    call("report", captures("a_rover"), "-o", path, *missions("rover_ground"), "--start", "30", "--end", "50")
    axis = {float(item) for item in re.findall(r'<text class="mid"[^>]*>([\d.]+) s<', path.read_text())}
    assert {35.0, 40.0, 45.0} <= axis <= {30.0, 35.0, 40.0, 45.0, 50.0}


def test_a_report_shows_hostile_names_as_text(call, tmp_path, captures, missions):
    hostile = tmp_path / "<b>x&y.pcap"
    shutil.copy(captures("a_rover"), hostile)
    path = tmp_path / "out.html"
    done = call("report", hostile, "-o", path, *missions("rover_ground"))
    assert done.code == 3
    text = path.read_text()
    assert "<b>" not in text
    assert "&lt;b&gt;x&amp;y.pcap" in text


def test_a_report_never_overwrites_its_input(call, captures, tmp_path):
    own = tmp_path / "a.pcap"
    shutil.copy(captures("a_rover"), own)
    assert call("report", own, "-o", own).code == 2
    assert call("report", own, "-o", own / "no.html").code == 1
    assert call("report", own, "-o", tmp_path / "new" / "dir.html").code == 3


def test_there_is_no_report_of_what_could_not_be_read(call, captures, tmp_path):
    cut, path = tmp_path / "cut.pcap", tmp_path / "out.html"
    cut.write_bytes(captures("a_rover").read_bytes()[:30])
    done = call("report", cut, "-o", path)
    assert (done.code, path.exists()) == (1, False)
    assert "no packet was read" in done.err[0]


@pytest.mark.parametrize(("width", "scheme"), long_but([(400, "dark")], [(400, "dark"), (1200, "light")]))
def test_chromium_shows_the_report(width, scheme, report, captures, missions, tmp_path):
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    assert browser, "chromium is missing: install it, as apt install chromium"
    path = report(captures("f_sbn_disconnect"), *missions("two_rovers_ground", "two_rovers_flight"))
    probe = (
        "<script>addEventListener('load',()=>{const b=document.body,r=[...document.querySelectorAll('svg')];"
        "document.title=JSON.stringify({over:b.scrollWidth>innerWidth,charts:r.length,"
        "empty:r.filter(s=>s.getBoundingClientRect().height<20||!s.childElementCount).length,"
        "letter:Math.min(...[...document.querySelectorAll('svg text')].map(t=>"
        "parseFloat(getComputedStyle(t).fontSize)*t.getScreenCTM().a)),"
        "ground:getComputedStyle(b).backgroundColor,cards:document.querySelectorAll('.verdict').length})})</script>"
    )
    probed = tmp_path / "probed.html"
    probed.write_text(path.read_text().replace("</body>", probe + "</body>"))
    done = subprocess.run(
        [
            browser,
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            f"--user-data-dir={tmp_path / 'profile'}",
            f"--window-size={width},900",
            f"--blink-settings=preferredColorScheme={0 if scheme == 'dark' else 1}",
            "--virtual-time-budget=3000",
            "--dump-dom",
            probed.as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    found = json.loads(re.search(r"<title>(\{.*?\})</title>", done.stdout).group(1))
    assert not found["over"]
    assert found["charts"] >= 5
    assert found["empty"] == 0
    assert found["cards"] >= 10
    assert found["letter"] >= 11, "px: the smallest letters of the charts"
    red, green, blue = (int(value) for value in re.findall(r"\d+", found["ground"])[:3])
    assert (red + green + blue < 200) == (scheme == "dark")


def test_live_rings_once_for_each_new_verdict(capsys):
    from edoras_tools.diagnosis.examination import Diagnosis
    from edoras_tools.diagnosis.verdict import Severity, Verdict
    from edoras_tools.render.doctor import LiveVerdicts

    def diagnosis(*verdicts):
        return Diagnosis(verdicts, (), [], [], 1, 0, 1)

    one = Verdict(Severity.ERROR, "lost", msg_id=0x1827, lost=3, rule="app_pipe_limit")
    grown = Verdict(Severity.ERROR, "lost more", msg_id=0x1827, lost=9, rule="app_pipe_limit")
    other = Verdict(Severity.ERROR, "cut", msg_id=0x1827, rule="ci_cut")
    note = Verdict(Severity.NOTE, "older", rule="older_losses")
    with LiveVerdicts("lo") as live:
        for found in (diagnosis(one, note), diagnosis(grown, note), diagnosis(grown, other)):
            live.update(found)
    said = capsys.readouterr().err
    assert said.count("\a") == 2
    assert "lost more" not in said
    assert "older" not in said


@pytest.mark.each(2)
@pytest.mark.parametrize(
    ("name", "share", "code", "told"),
    [
        ("a_rover", "1%", 3, "92 of 600 /cmd_vel lost or unaccounted for: more than 1 %"),
        ("a_rover", "0.16", 0, ""),
        ("b_arm_single", "0", 0, ""),
        ("e_ci_errors", "100%", 3, "packet 595: ends before its message does"),
    ],
)
def test_a_share_may_be_lost(name, share, code, told, call, captures, missions):
    done = call("doctor", captures(name), *missions(*CAPTURES[name][0]), "--max-loss", share)
    assert done.code == code
    assert told in "\n".join(done.err)


@pytest.mark.parametrize(
    ("options", "code", "told"),
    [
        (["--max-loss", "23%"], 0, []),
        (["--max-loss", "23%", "--strict"], 3, ["64 of 275 0x1827 lost, or may be"]),
    ],
)
def test_what_may_be_lost_counts_where_the_judge_is_strict(options, code, told, call):
    path = ROOT / "tests/captures/season3/q25_robot_off_then_bridge_off.pcap.zst"
    done = call("doctor", path, "-q", *options)
    assert (done.code, [line.partition(": ")[2].partition(": ")[0] for line in done.err]) == (code, told)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["{}", "--strict", "--bag", "x"], "--strict belongs to a diagnosis and has no effect with --bag"),
        (["{}", "--max-loss", "1%", "--list-lost", "csv"], "has no effect with --list-lost: leave one out"),
        (["{}", "--max-loss", "1%", "--against", "x.pcap"], "has no effect with --against: leave one out"),
        (["{}", "--list-lost", "csv", "--against", "x.pcap"], "--list-lost and --against exclude each other"),
        (["{}", "--set", "app_msg_limit=8", "--against", "x.pcap"], "--set has no effect with --against"),
        (["--predict", "{}"], "--predict does not read a capture"),
        (["--predict", "-i", "lo"], "--predict has no effect on live traffic"),
        (["{}", "--duration", "5"], "--duration ends live traffic; of a file, --end selects a part"),
    ],
)
def test_options_without_effect_are_refused(arguments, told, call, captures, missions):
    words = [item.replace("{}", str(captures("a_rover"))) for item in arguments]
    done = call("doctor", *words, *missions("rover_ground"))
    assert (done.code, done.out, len(done.err)) == (2, "", 1)
    assert told in done.err[0]


@pytest.mark.each(3)
@pytest.mark.parametrize(
    "name", ["c1_tlm_rate_limit4", "n1_to_remove_all", "n3_cfs_restart", "n5_app_restarts"]
)
def test_what_a_remedy_tells_to_type_can_be_typed(name, call):
    done = call("doctor", ROOT / f"tests/captures/{name}.pcap.zst", "--json")
    remedies = [item["remedy"] for item in done.json()["verdicts"] if item["remedy"]]
    lines = {line for remedy in remedies for line in re.findall(r"edoras (inject [^;]+)", remedy)}
    assert lines
    for line in lines:
        planned = call(*line.split(), "--dry-run")
        assert (planned.code, planned.err) == (0, []), line


def test_a_remedy_names_a_ci_that_is_elsewhere(call, tmp_path):
    """The capture on other addresses: 127.0.0.1 becomes 10.5.0.3, and UDP checksums none."""
    data = (ROOT / "tests/captures/n1_to_remove_all.pcap.zst").read_bytes()
    moved = bytearray(zstandard.ZstdDecompressor().decompressobj().decompress(data))
    at = 24
    while at < len(moved):
        frame = at + 16
        length = int.from_bytes(moved[at + 8 : at + 12], "little")
        moved[frame + 26 : frame + 34] = bytes([10, 5, 0, 3]) * 2
        moved[frame + 40 : frame + 42] = bytes(2)
        at = frame + length
    (tmp_path / "moved.pcap").write_bytes(moved)
    done = call("doctor", tmp_path / "moved.pcap", "--json")
    (remedy,) = {item["remedy"] for item in done.json()["verdicts"] if item["rule"] == "to_stopped"}
    assert remedy.endswith("edoras inject to-add 0x0800 --target 10.5.0.3:1234")


def test_a_page_of_the_doctor_is_the_report(call, captures, missions, tmp_path):
    page = tmp_path / "r.html"
    done = call("doctor", "-o", page, captures("a_rover"), *missions("rover_ground"))
    assert done.code == 3
    assert done.err[0].startswith(f"{page}: ")
    assert page.read_text().startswith("<!DOCTYPE html>")
