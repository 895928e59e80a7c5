"""``edoras archive``: what its commands print, and how they end."""

from __future__ import annotations

import csv
import filecmp
import importlib.util
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from html import escape

import duckdb
import polars as pl
import pytest
from effort import long_but
from places import CAPTURES, MISSIONS
from schema import held

from edoras_tools.addons.archive.index import open_index
from edoras_tools.errors import ConfigError
from edoras_tools.io.outputs import lock_older

NAMES = ("a_rover", "b_arm_single")
DRIVES = 92
"""Lost commands: the arm's have the MsgId of the rover's, and its application loses them otherwise."""


@pytest.fixture(scope="module")
def indexed(edoras, tmp_path_factory):
    """A folder with the index of two captures and of one that is none, and what its making printed."""
    folder = tmp_path_factory.mktemp("archive")
    (folder / "text.pcap").write_text("hello")
    files = [CAPTURES / f"{name}.pcap" for name in NAMES]
    options = ["-c", MISSIONS / "rover_ground.yaml", "--jobs", "1", "--index", folder / "x.duckdb", "--json"]
    done = edoras("archive", *files, folder, *options, text=True)
    return folder, done


@pytest.fixture
def index(indexed, monkeypatch):
    """The index, which the environment names."""
    monkeypatch.setenv("EDORAS_ARCHIVE", str(indexed[0] / "x.duckdb"))
    return indexed[0]


def test_making_it(indexed):
    folder, done = indexed
    assert done.returncode == 3, done.stderr
    assert done.stderr == ""
    said = held(json.loads(done.stdout), ["archive", "--json"])
    assert (said["found"], said["read"], said["unchanged"], said["lost_workers"]) == (3, 3, 0, 0)
    (error,) = said["errors"]
    assert error.startswith(f"{folder / 'text.pcap'}: looks like text")


def test_again_nothing_is_read(call, index):
    done = call("archive", index, "-c", MISSIONS / "rover_ground.yaml", "--jobs", "1")
    assert (done.code, done.out) == (3, "")
    assert done.err[0] == f"{index / 'x.duckdb'}: 1 capture: 0 read, 1 unchanged"
    assert done.err[1].startswith(f"edoras: {index / 'text.pcap'}: looks like text")
    assert (
        call("archive", "index", CAPTURES / "a_rover.pcap", "-q", "-c", MISSIONS / "rover_ground.yaml").code
        == 0
    )


def test_list(call, index):
    done = call("archive", "list")
    lines = done.out.splitlines()
    assert done.code == 0
    assert [word for word in lines[1].split() if "rover" in word] != []
    assert " 1,827 " in lines[1]
    assert lines[3].endswith("unreadable")
    assert lines[4].startswith(str(index / "text.pcap"))
    said = call("archive", "list", "--json").json()["captures"]
    assert [row["lost"] for row in said] == [92, said[1]["lost"], None]
    rows = list(csv.DictReader(io.StringIO(call("archive", "list", "--csv").out)))
    assert [row["datagrams"] for row in rows] == ["1827", "944", ""]
    assert call("archive", "list", "--until", "2026-11-21T06:15", "--json").json()["captures"] == said[:1]


def test_losses(call, index):
    done = call("archive", "losses", "--topic", "/cmd*", "--until", "2026-11-21T06:15")
    assert done.code == 3
    assert done.out.splitlines()[1].split()[-6:] == ["600", "92", "0", "15.3", "%", "limit"]
    assert done.out.splitlines()[-1] == "92 lost, 0 unaccounted for, in 1 capture."
    (row,) = call("archive", "losses", "--json", "--over", "10%", "--until", "2026-11-21T06:15").json()[
        "losses"
    ]
    assert (row["topic"], row["share"], row["causes"]) == ("/cmd_vel", 92 / 600, ["limit"])
    assert call("archive", "losses", "--csv").out.startswith("capture,start_ns,topic,")


@pytest.mark.parametrize(
    ("options", "code", "told"),
    [
        (["--topic", "/telemetry*"], 0, "No loss in 2 captures.\n"),
        (["--until", "2026-11-21T06:15", "--over", "99%"], 0, "No loss over this share in 1 capture.\n"),
        (["--since", "2030-01-01"], 1, "has no capture of this time with messages; "),
        (["--topic", "/nix"], 1, "has no capture of this time with messages of these topics; "),
    ],
)
def test_no_loss_is_said_of_captures_with_such_messages_alone(options, code, told, call, index):
    done = call("archive", "losses", *options)
    assert done.code == code
    assert done.out == told if code == 0 else told in done.err[0]


@pytest.mark.parametrize("wrong", [["none"], [CAPTURES, "-c", "none.yaml"]])
def test_an_index_that_gets_nothing_is_not_left(wrong, call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert call("archive", *wrong).code in {1, 2}
    assert list(tmp_path.iterdir()) == []


def test_a_folder_without_captures_is_said_to_be_one(call, tmp_path):
    done = call("archive", tmp_path, "--index", tmp_path / "x.duckdb")
    assert (done.code, done.err[0][-36:]) == (0, "x.duckdb: 0 captures: 0 read, 0 unchanged"[-36:])
    assert done.err[1] == "no capture was found; name files, or folders with .mcap, .pcapng or .pcap"


SQL = (
    "SELECT parse_filename(capture) AS run, lost, began, 0.5::DECIMAL(3, 1) AS half, evidence FROM captures \
JOIN verdicts USING (capture, lost) ORDER BY run LIMIT 1"
)


def test_query(call, index, monkeypatch):
    done = call("archive", "query", SQL, "--json")
    said = done.json()
    assert said["columns"] == ["run", "lost", "began", "half", "evidence"]
    (row,) = said["rows"]
    assert row[:4] == ["a_rover.pcap", 92, "2026-11-21 06:13:56.850346", 0.5]
    assert isinstance(row[4], list)
    table = call("archive", "query", SQL).out.splitlines()
    assert table[0].split() == said["columns"]
    monkeypatch.setattr("sys.stdin", io.StringIO("SELECT 1 AS a, NULL AS b"))
    assert call("archive", "query", "-", "--csv").out == "a,b\n1,\n", "for a shell, and as export writes it"
    assert call("archive", "query", "SELECT 0 / 0.0 AS a", "--json").json()["rows"] == [["NaN"]]
    many = call("archive", "query", "FROM range(1200)").out.splitlines()
    assert (len(many), many[-1]) == (1002, "and 200 rows more: --format csv")


def test_report(call, index, tmp_path):
    path = tmp_path / "r.html"
    done = call("archive", "report", "-o", path)
    assert (done.code, done.out) == (0, "")
    text = path.read_text()
    assert "<h1>" in text
    assert not re.search(r"(?:src|href)=.(?!#)", text), "it loads nothing"
    (head,) = re.findall(r'class="end-note lost">(.*?)</p>', text)
    lost = sum(row["lost"] or 0 for row in call("archive", "list", "--json").json()["captures"])
    assert head.startswith(f"{lost:,} lost, 0 unaccounted for, in ")
    table = re.search(r'id="worst-routes".*?</section>', text, re.DOTALL)[0]
    assert "<td>/cmd_vel</td><td>CI</td>" in table
    assert f"<td>{DRIVES}</td>" in table
    assert escape(str(index / "text.pcap")) in re.search(r'id="not-whole".*?</section>', text, re.DOTALL)[0]
    assert text.count("<svg") == len(re.findall(r"<figure", text)) > 2
    (index / "<b>.duckdb").write_bytes((index / "x.duckdb").read_bytes())
    assert call("archive", "report", "-o", path, "--force", "--index", index / "<b>.duckdb").code == 0
    assert "<b>" not in path.read_text()
    assert call("archive", "report", "-o", path, "--force", "--since", "2030-01-01").code == 1
    assert call("archive", "report", "-o", index / "x.duckdb").code == 2


@pytest.mark.long
@pytest.mark.parametrize(("width", "scheme"), long_but([(400, "dark")], [(400, "dark"), (1280, "light")]))
def test_chromium_shows_the_report(width, scheme, call, index, tmp_path):
    call("archive", "report", "-o", tmp_path / "r.html")
    text = (tmp_path / "r.html").read_text()
    probe = (
        "<script>addEventListener('load',()=>{const b=document.body,r=[...document.querySelectorAll('svg')];"
        "document.title=JSON.stringify({over:b.scrollWidth>innerWidth,charts:r.length,"
        "empty:r.filter(s=>s.getBoundingClientRect().height<20||!s.childElementCount).length,"
        "letter:Math.min(...[...document.querySelectorAll('svg text')].map(t=>"
        "parseFloat(getComputedStyle(t).fontSize)*t.getScreenCTM().a)),"
        "cut:(d=>d.scrollWidth>d.clientWidth)(document.querySelector('table.rules').parentElement),"
        "ground:getComputedStyle(b).backgroundColor})})</script>"
    )
    (tmp_path / "r.html").write_text(text.replace("</body>", probe + "</body>"))
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    assert browser, "chromium is missing: install it, as apt install chromium"
    options = ["--headless", "--no-sandbox", "--disable-gpu", f"--window-size={width},900", "--dump-dom"]
    options += [f"--user-data-dir={tmp_path / 'profile'}", "--virtual-time-budget=3000"]
    options += [f"--blink-settings=preferredColorScheme={0 if scheme == 'dark' else 1}"]
    done = subprocess.run(
        [browser, *options, (tmp_path / "r.html").as_uri()],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    found = json.loads(re.search(r"<title>(\{.*?\})</title>", done.stdout)[1])
    assert (found["over"], found["empty"], found["charts"]) == (False, 0, text.count("<svg"))
    assert found["letter"] >= 11, "px: the smallest letters of the charts"
    assert not found["cut"], "rules: examples are folded, figures in sight"
    red = int(re.search(r"rgb\((\d+)", found["ground"])[1])
    assert (red < 60) == (scheme == "dark")


@pytest.mark.long
def test_export_is_read_by_others(call, index, tmp_path, monkeypatch):
    folder = tmp_path / "it's"
    done = call("archive", "export", "-o", folder, "--json")
    said = done.json()
    assert done.code == 0
    for name, count in said["rows"].items():
        assert call("archive", "query", f"SELECT count(*) FROM {name}", "--json").json()["rows"] == [[count]]
        if not count:
            assert not (folder / name).exists()
            continue
        assert len(pl.scan_parquet(folder / name, hive_partitioning=True).collect()) == count
    lost = pl.scan_parquet(folder / "outcomes").filter(pl.col("topic") == "/cmd_vel").collect()
    assert lost["lost"].sum() == DRIVES
    assert {"date", "link", "topic", "sent"} <= set(lost.columns)
    monkeypatch.chdir(folder)
    found = duckdb.sql(
        "SELECT date, sum(lost) FROM 'outcomes/**/*.parquet' WHERE topic = '/cmd_vel' GROUP BY date"
    ).fetchall()
    assert [(str(date), lost) for date, lost in found] == [("2026-11-21", DRIVES)]
    assert [path.name for path in (folder / "outcomes").iterdir()] == ["date=2026-11-21"]
    assert call("archive", "export", "-o", folder).code == 2
    assert call("archive", "export", "-o", folder, "--force", "-q").code == 0
    assert call("archive", "export", "-o", index / "x.duckdb", "--force").code == 2
    assert [path.name for path in tmp_path.iterdir()] == ["it's"]


KILLED = """
import os, signal, sys
from pathlib import Path
from edoras_tools.cli import programs

def rename(self, target, rename=Path.rename):
    if self.name != "new":
        return rename(self, target)
    if WHERE == "behind":
        rename(self, target)
    os.kill(os.getpid(), signal.SIGKILL)

Path.rename = rename
sys.argv[0] = "edoras"
programs.main()
"""
"""An export with ``--force`` that is killed where it gives the new folder its name."""


@pytest.mark.quick("between")  # the worse: neither folder is in place
@pytest.mark.parametrize("where", ["between", "behind"])
def test_an_export_that_was_killed_is_put_right_by_the_next(where, call, index, tmp_path):
    folder, other = tmp_path / "out", tmp_path / "kept"
    assert call("archive", "export", "-o", folder).code == 0
    folder.rename(other)
    shutil.copytree(other, folder)
    code = KILLED.replace("WHERE", repr(where))
    words = ["archive", "export", "-o", folder, "--force", "--index", index / "x.duckdb"]
    run = [sys.executable, "-c", code, *map(str, words)]
    assert subprocess.run(run, check=False).returncode == -signal.SIGKILL
    assert folder.exists() == (where == "behind")
    assert (tmp_path / ".out.part").exists()
    refused = call("archive", "export", "-o", folder)
    assert refused.code == 2
    assert refused.err == [f"edoras: {folder} exists; name another folder, or replace it with --force"]
    assert sorted(item.name for item in tmp_path.iterdir()) == ["kept", "out"]
    same = filecmp.dircmp(folder, other)
    assert (same.left_only, same.right_only, same.diff_files) == ([], [], [])
    assert call("archive", "export", "-o", folder, "--force").code == 0


def test_one_export_at_a_time(call, index, tmp_path):
    (tmp_path / ".out.part").mkdir()
    lock = lock_older(tmp_path / ".out.part")
    done = call("archive", "export", "-o", tmp_path / "out")
    os.close(lock)
    told = (
        f"edoras: {tmp_path / 'out'}: cannot be written: another program is writing it; name another output"
    )
    assert (done.code, done.err) == (1, [told])


FORBIDDEN = (
    "SELECT * FROM read_csv('/etc/passwd')",
    "SELECT * FROM read_text('/etc/hostname')",
    "SELECT * FROM glob('/etc/*')",
    "COPY captures TO 'out.csv'",
    "EXPORT DATABASE 'out'",
    "IMPORT DATABASE '.'",
    "ATTACH 'other.db'",
    "INSTALL httpfs",
    "LOAD httpfs",
    "SET enable_external_access = true",
    "RESET lock_configuration",
    "SELECT list(range) FROM range(1000000000)",
    "SELEC 1",
    "SELECT * FROM nowhere",
    "SELECT lst FROM (SELECT 1 AS lost)",
    "",
)


def test_a_query_reads_and_writes_nothing_else(index, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with open_index(index / "x.duckdb") as opened:
        for sql in FORBIDDEN:
            with pytest.raises(ConfigError) as refused:
                list(opened.answer(sql)[1])
            assert len(str(refused.value).splitlines()) == 1, refused.value
    assert list(tmp_path.iterdir()) == []


def test_names_of_columns_are_printed_without_escapes(call, index):
    assert "\x1b" not in call("archive", "query", 'SELECT 1 AS "\x1b]0;x\x07"').out


@pytest.mark.parametrize("way", [["--json"], ["--format", "csv"], []])
def test_a_query_that_takes_too_long_is_ended(call, index, way, monkeypatch):
    monkeypatch.setattr("edoras_tools.addons.archive.index.MOST_S", 0.5)
    cross = "SELECT sum(a.range * b.range) FROM range(1000000000) a, range(1000000000) b"
    done = call("archive", "query", cross, *way)
    assert (done.code, len(done.err)) == (2, 1)
    assert "took more than 0.5 s" in done.err[0]
    late = "SELECT range FROM range(100000000000) WHERE range % 10000000000 = 1"
    assert call("archive", "query", late, *way).code == 2


@pytest.mark.skipif(os.geteuid() != 0, reason="only root makes links of another user")
@pytest.mark.parametrize("linked", ["x.duckdb", "x.duckdb.wal", "out"])
def test_another_user_s_link_is_not_followed(call, index, tmp_path, linked):
    tmp_path.chmod(0o1777)
    os.chown(tmp_path, 65533, 65533)
    (tmp_path / linked).symlink_to(tmp_path / "precious")
    os.lchown(tmp_path / linked, 65534, 65534)
    if linked == "out":
        done = call("archive", "export", "-o", tmp_path / "out")
    else:
        done = call("archive", index, "--index", tmp_path / "x.duckdb")
    assert done.code == 1
    assert "is another user's link in a shared folder; name another output" in done.err[0]
    assert [item.name for item in tmp_path.iterdir()] == [linked]


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["query", "SELEC 1"], "edoras: Parser Error: syntax error at or near"),
        (["query", "DELETE FROM captures"], "edoras: Invalid Input Error: Cannot execute statement of type"),
        (["query", "SELECT 1", "--index", "nowhere"], "edoras: nowhere: there is no such index; make it: "),
        (["list", "--since", "3h"], "edoras: --start needs a date: write 2026-05-01 or 2026-05-01T12:00"),
        (["list", "--since", "12:00"], "edoras: --start needs a date: "),
        (
            [".", "--jobs", "0"],
            "edoras: Invalid value for '--jobs': 0 is less than 1; see edoras archive index -h",
        ),
        ([".", "--jobs", "2", "--scheduler", "tcp://x:1"], "edoras: --jobs is for workers of this machine"),
        (["nowhere"], "edoras: nowhere: there is no such file or folder; check the name"),
        ([".", "-c", "nowhere.yaml"], "edoras: nowhere.yaml: "),
    ],
)
def test_mistakes(arguments, told, call, index, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = call("archive", *arguments)
    assert done.code in {1, 2}
    assert done.err[0].startswith(told)
    assert done.out == ""


def test_without_the_extra(call, monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(
        "edoras_tools.addons.archive.cli.find_spec",
        lambda name: None if name in {"duckdb", "distributed"} else find(name),
    )
    done = call("archive", "list")
    told = "edoras archive needs duckdb, distributed, not installed here: pip install 'edoras-tools[archive]'"
    assert (done.code, done.err) == (2, [f"edoras: {told}"])
    assert call("archive", "list", "-h").code == 0


@pytest.mark.long
def test_other_commands_load_none_of_its_libraries(tmp_path):
    program = f"""
import sys
sys.argv = ["edoras", "record", {str(CAPTURES / "a_rover.pcap")!r}, "-q", "-o", {str(tmp_path / "x.mcap")!r}]
from edoras_tools.cli import main
try:
    main.run(main.program())
except SystemExit:
    pass
print(sorted({{"duckdb", "dask", "distributed", "fsspec", "pyarrow", "tornado"}} & set(sys.modules)))
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=300
    )
    assert done.stdout == "[]\n", done.stderr
    assert (tmp_path / "x.mcap").exists()
