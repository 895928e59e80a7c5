"""What a run wrote is never lost to a second run: what exists is refused, by every command that writes."""

import re
import resource
import signal
import sys
from functools import cache
from itertools import cycle, product
from pathlib import Path

import here
import pytest
import typer
from effort import long_but
from places import ROOT
from waiting import Program

from edoras_tools.cli.main import program

EDORAS = Path(sys.executable).with_name("edoras")

ROVER = ROOT / "samples/missions/rover_ground.yaml"
CAPTURE = ROOT / "samples/captures/a_rover.pcap"
CFDP = ROOT / "samples/cfs_files/cf_transfer.pcap"
EXPECTED = ROOT / "samples/expectations/rover.yaml"
PERF_LOG = ROOT / "samples/cfs_files/performance.dat"
HOST = "127.0.0.1"
SWEEP = ["sweep", "/cmd_vel", "-c", ROVER, "--sim", "rover", "--rate", "2", "--step-time", "2s"]
WRITERS = {
    "record -o": ("old.mcap", ["record", "-q", "-r", CAPTURE]),
    "record -o pcap": ("old.pcap", ["record", "-q", "-r", CAPTURE]),
    "record -o pcapng": ("old.pcapng", ["record", "-q", "-r", CAPTURE]),
    "record -o live": ("old.mcap", ["record", "-q", "--listen", f"{HOST}:0"]),
    "doctor -o": ("old.html", ["doctor", CAPTURE, "-c", ROVER]),
    "replay -o": ("old.mcap", ["replay", CAPTURE, "--to", "ci", "--target", f"{HOST}:9", "--no-listen"]),
    "inject -o": (
        "old.mcap",
        ["inject", "/cmd_vel", "{}", "-c", ROVER, "--target", f"{HOST}:9", "--no-listen"],
    ),
    "proxy -o": ("old.mcap", ["proxy", "ci", "--target", f"{HOST}:9", "--listen", f"{HOST}:0"]),
    "bridge -o": ("old.mcap", ["bridge", "-c", ROVER, "--ros", "local"]),
    "live -o": ("old.mcap", ["live", "--listen", f"{HOST}:0", "--ws-port", "0"]),
    "observe -o": ("old.mcap", ["observe", "--ros", "dds", "/cmd_vel"]),
    "demo -o": ("old.mcap", ["demo", "rover", "--duration", "50ms"]),
    "recover -o": ("old.mcap", ["recover", "cut.mcap"]),
    **{
        f"export -o {name}": (f"old.{name}", ["export", CAPTURE, "-c", ROVER, "--topic", "/cmd_vel"])
        for name in ("csv", "jsonl", "parquet", "arrow")
    },
    "export -o trace": ("old.json", ["export", PERF_LOG]),
    **{
        f"plot -o {name}": (f"old.{name}", ["plot", CAPTURE, "-c", ROVER, "/cmd_vel.linear.x"])
        for name in ("svg", "png", "html")
    },
    "check -o": ("old.yaml", ["check", "--init", CAPTURE, "-c", ROVER]),
    "check --junit": ("old.xml", ["check", CAPTURE, EXPECTED, "-c", ROVER]),
    "compare --junit": ("old.xml", ["compare", CAPTURE, "--against", CAPTURE, "-c", ROVER]),
    "mission draft -o": ("old.yaml", ["mission", "draft", CAPTURE]),
    "mission learn -o": ("old.yaml", ["mission", "learn", CAPTURE]),
    "xtce -o": ("old.xml", ["xtce", "-c", ROVER]),
    "trace -o": ("old.svg", ["trace", CAPTURE, "-c", ROVER, "--topic", "/cmd_vel", "--nth", "1"]),
    "report -o": ("old.html", ["report", CAPTURE, "-c", ROVER]),
    "archive report -o": ("old.html", ["archive", "report", "--index", "x.duckdb"]),
    "sweep -o": ("old.svg", SWEEP),
    "sweep --svg": ("old.svg", SWEEP),
    "sweep --png": ("old.png", SWEEP),
}
"""Command and option, the file that is there, and the words in front of the option."""
FOLDERS = {
    "demo -o": ("edoras_demo", "two_rovers.mcap", ["demo", "--duration", "50ms"]),
    "record --rosbag2": ("bag", "bag_0.mcap", ["record", "-q", CAPTURE, "--rosbag2", "-o"]),
    "export -o": ("tables", "cmd_vel.csv", ["export", CAPTURE, "-c", ROVER, "--format", "csv", "-o"]),
    "files -o": ("taken", "notes.txt", ["files", CFDP, "-o"]),
    "codegen -o": ("c", "edoras_cdr.c", ["codegen", "std_msgs/msg/Empty", "-o"]),
    "structs -o": ("msgs", "structs.yaml", ["structs", "cfe", "TO_LAB_HkTlm", "-o"]),
    "samples DIR": ("samples", "captures/a_rover.pcap", ["samples"]),
    "help --man": ("man1", "edoras.1", ["help", "--man"]),
    "wireshark install --to": ("lua", "edoras.lua", ["wireshark", "install", "--to"]),
    "wireshark extcap install --to": ("extcap", "edoras-extcap", ["wireshark", "extcap", "install", "--to"]),
    "archive export -o": ("set", "captures/x", ["archive", "export", "--index", "x.duckdb", "-o"]),
}
"""Command and option, the folder that is there, a file in it, and the words in front of the folder."""
KEPT = {
    "--index": "a database that is brought up to date; a file that is none stays as it is",
    "experiment -o": "a folder of runs, which goes on with those that are there",
    "record --socket": "a socket, made where nothing is, and removed at the end",
    "record --fire": "a socket that a recorder made",
}
"""Options that name a file that is neither only read nor written anew."""
READS = {
    *(
        "FILE",
        "FILE...",
        "[FILE]...",
        "[FILE]... [TOPIC]",
        "GOOD",
        "BAD",
        "--read",
        "--config",
        "--msg-path",
        "--structs",
        "--include",
    ),
    *(
        "--against",
        "--bag",
        "--scenario",
        "FILE... FIELD...",
        "FILE... N",
        "FILE... [PACKET]",
        "[FILE]... TOPIC",
        "DIR|URL...",
        "RUN...",
        "PLAN.yaml",
    ),
}
"""Arguments and options that name what is read."""


@cache
def root():
    """The command line."""
    return typer.main.get_command(program())


def named_paths():
    """Every argument and option of every command that names a file or a folder, as ``record -o``."""

    def walk(command, words):
        inner = getattr(command, "commands", {})
        for name, item in inner.items():
            yield from walk(item, [*words, name])
        for item in command.params:
            named = item.metavar or ""
            if "Path" in repr(item.type) or re.search("FILE|DIR|PATH", named):
                yield words, item, named if item.param_type_name == "argument" else item.opts[0]

    return list(walk(root(), []))


def test_every_option_that_writes_is_here():
    """A new option that names a file is in one of the tables above."""
    tried = {name for table in (WRITERS, FOLDERS, KEPT) for name in table}
    short = {"--output": "-o"}
    for words, item, name in named_paths():
        if name in READS and (name, words) != ("DIR", ["samples"]):
            continue
        called = short.get(name, name)
        full = " ".join([*words, called])
        assert called in tried or any(item == full or item.startswith(f"{full} ") for item in tried), full
        if called not in {"--index", "--socket", "--fire"} and words not in (["files"], ["experiment"]):
            options = {one for item in command_of(words).params for one in item.opts}
            assert "--force" in options, f"{full} cannot be told to replace"


def command_of(words):
    """The command of these words."""
    command = root()
    for word in words:
        command = command.commands[word]
    return command


@pytest.fixture(scope="module")
def index(tmp_path_factory):
    """An index of one capture; the worker that makes it is a thread, not a process that is started."""
    from distributed import LocalCluster

    path = tmp_path_factory.mktemp("index") / "x.duckdb"
    words = ["archive", CAPTURE, "-c", ROVER, "-q", "--index", path]
    local = {"protocol": "tcp", "host": HOST, "dashboard_address": None, "silence_logs": 60}
    with (
        LocalCluster(n_workers=1, processes=False, **local) as cluster,
        pytest.MonkeyPatch.context() as patch,
    ):
        patch.setattr(sys, "argv", ["edoras", *map(str, words), "--scheduler", cluster.scheduler_address])
        with pytest.raises(SystemExit) as ending:
            here.edoras()
    assert ending.value.code == 0
    return path


@pytest.fixture
def folder(tmp_path, monkeypatch, request):
    """A working folder with a file of every kind that must stay as it is."""
    monkeypatch.chdir(tmp_path)
    for name, _ in WRITERS.values():
        (tmp_path / name).write_bytes(b"precious")
    for place, name, _ in FOLDERS.values():
        (tmp_path / place / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / place / name).write_bytes(b"precious")
    (tmp_path / "cut.mcap").write_bytes(b"\x89MCAP0\r\n")
    if "archive" in request.node.name:
        (tmp_path / "x.duckdb").symlink_to(request.getfixturevalue("index"))
    return tmp_path


def contents(folder):
    """All files below a folder, hidden ones too, but not what a link names."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file() and not path.is_symlink()}


def option_of(writer):
    """The option of a writer, or none where the words end with it."""
    return next((word for word in writer.split() if word.startswith("-")), None)


@pytest.mark.each(3)
@pytest.mark.long("archive report -o")
@pytest.mark.parametrize("writer", WRITERS)
def test_what_exists_is_refused(call, folder, writer):
    name, words = WRITERS[writer]
    before = contents(folder)
    result = call(*words, option_of(writer), name)
    assert result.code == 2
    (line,) = result.err
    assert re.fullmatch(
        f"edoras: {name} exists; name another output( with -o)?, or replace it with --force", line
    )
    assert contents(folder) == before


@pytest.mark.each(3)
@pytest.mark.long("archive*")
@pytest.mark.parametrize("writer", FOLDERS)
def test_a_folder_with_something_in_it_is_refused(call, folder, writer):
    place, _, words = FOLDERS[writer]
    before = contents(folder)
    result = call(*words, *(() if words[-1].startswith("-") or words == ["samples"] else ("-o",)), place)
    assert result.code == (1 if writer in {"files -o", "record --rosbag2"} else 2)
    (line,) = result.err
    assert re.match(f"edoras: {place}", line)
    assert contents(folder) == before


@pytest.mark.each(3)
@pytest.mark.long("archive*")
@pytest.mark.parametrize("writer", [name for name in FOLDERS if name not in {"files -o", "record --rosbag2"}])
def test_a_second_run_changes_no_byte_of_a_first(call, folder, writer):
    """The same again is refused, or finds all as it is."""
    place, _, words = FOLDERS[writer]
    words = [*words, *(() if words[-1].startswith("-") or words == ["samples"] else ("-o",)), f"new_{place}"]
    assert call(*words).code == 0
    before = {path: (path.stat().st_mtime_ns, data) for path, data in contents(folder).items()}
    assert call(*words).code in {0, 2}
    assert {path: (path.stat().st_mtime_ns, data) for path, data in contents(folder).items()} == before


OPENED_FIRST = [name for name in WRITERS if name.split()[0] not in {"recover", "sweep", "bridge", "observe"}]
"""Bridges and observers take ports that another program may have; a sweep runs first."""


@pytest.mark.each(3)
@pytest.mark.long("archive*", "plot*", "check*", "mission*", "report*")
@pytest.mark.parametrize("writer", OPENED_FIRST)
def test_where_no_file_can_be_is_one_line(call, folder, writer):
    """A file is in the place of the folder: this is as if nobody might write there."""
    name, words = WRITERS[writer]
    (folder / "file").write_bytes(b"precious")
    before = contents(folder)
    result = call(*words, option_of(writer), f"file/{name}")
    assert result.code == 1
    told = [
        line for line in result.err if f"file/{name}: cannot be" in line or "file: the folder cannot" in line
    ]
    assert len(told) == 1
    assert contents(folder) == before


def test_what_is_no_archive_stays_as_it_is(call, folder):
    (folder / "notes").write_bytes(b"precious" * 1000)
    before = contents(folder)
    for words in (["archive", CAPTURE, "--jobs", "1"], ["archive", "list"]):
        result = call(*words, "--index", "notes")
        assert result.code in {1, 2}
        assert len(result.err) == 1
        assert contents(folder) == before


FULL = {name: WRITERS[name] for name in ("record -o", "record -o pcap", "export -o csv", "check --junit")}


@pytest.mark.quick("record -o")
@pytest.mark.parametrize("writer", FULL)
def test_a_disk_that_fills_leaves_the_older_file(edoras, folder, writer):
    """With --force, too: the system allows files of one byte here."""
    name, words = FULL[writer]
    before = contents(folder)

    def small():
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (1, 1))

    result = edoras(*words, option_of(writer), name, "--force", preexec_fn=small, text=True)
    assert result.returncode == 1, result.stderr
    assert "cannot be written: File too large" in result.stderr.splitlines()[-1]
    assert {path: data for path, data in contents(folder).items() if len(data) > 1} == before


def test_force_replaces(call, folder):
    assert call("record", "-q", "-r", CAPTURE, "-o", "old.mcap", "--force").code == 0
    assert call("info", "old.mcap").code == 0


@pytest.mark.each(3)
@pytest.mark.long("archive*")
@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("old.html", ("report", CAPTURE, "-o")),
        ("old.html", ("archive", "report", "--index", "x.duckdb", "-o")),
        ("old.svg", (*SWEEP, "--svg")),
        ("old.png", (*SWEEP, "--png")),
    ],
    ids=["report", "archive report", "svg", "png"],
)
def test_force_replaces_pages_and_charts(call, folder, name, words):
    assert call(*words, name, "--force", "-q").code in {0, 3}
    assert b"precious" not in (folder / name).read_bytes()


def test_a_report_without_a_name_is_not_replaced_either(call, folder):
    assert call("report", "-q", CAPTURE).code == 3
    page = (folder / "a_rover.pcap.html").read_bytes()
    result = call("report", "-q", CAPTURE, "-c", ROVER)
    assert (result.code, result.err) == (
        2,
        ["edoras: a_rover.pcap.html exists; name another output, or replace it with --force"],
    )
    assert (folder / "a_rover.pcap.html").read_bytes() == page


def test_an_input_that_is_cut_off_leaves_the_older_recording(call, folder):
    """What could be read of it is beside."""
    (folder / "cut.pcap").write_bytes(CAPTURE.read_bytes()[:-5])
    before = contents(folder)
    result = call("record", "-q", "cut.pcap", "-o", "old.mcap", "--force")
    assert result.code == 1
    assert result.err[0] == "edoras: old.mcap is as it was; the new recording is old_1.mcap"
    beside = {folder / "old_1.mcap"}
    found = contents(folder)
    assert ({path: found[path] for path in before}, found.keys() - before.keys()) == (before, beside)
    assert call("info", "old_1.mcap").code == 0


OUTSIDE = {
    **{f"record {suffix}": ["record", "-o", f"new{suffix}"] for suffix in (".mcap", ".pcap", ".pcapng")},
    "record rosbag2": ["record", "--rosbag2", "-o", "new"],
    "export file": ["export", "--topic", "/cmd_vel", "-o", "new.csv"],
    "export folder": ["export", "-o", "deep/new/"],
    "plot": ["plot", "/cmd_vel.linear.x", "-o", "new.svg"],
    "report": ["report", "-o", "new.html"],
    "check": ["check", "--junit", "new.xml"],
    "check --init": ["check", "--init", "-o", "new.yaml"],
    **{name: [name] for name in ("info", "sniff", "doctor", "live")},
}


BESIDE = [("500", ""), ("", "2001-01-01"), ("2030-01-01", "")]


@pytest.mark.each(3)
@pytest.mark.parametrize(
    ("name", "start", "end"),
    long_but(
        [(name, *times) for name, times in zip(OUTSIDE, cycle(BESIDE))],
        [(name, *times) for name, times in product(OUTSIDE, BESIDE)],
    ),
)
def test_a_time_outside_the_capture_leaves_nothing(call, tmp_path, monkeypatch, name, start, end):
    monkeypatch.chdir(tmp_path)
    words = [*OUTSIDE[name], CAPTURE, "-c", ROVER, *(("--start", start) if start else ("--end", end))]
    words += [EXPECTED] if name == "check" else []
    result = call(*words)
    assert result.code == (1 if start else 2)
    (line,) = result.err
    assert (
        "nothing between --start and --end; its times go from 0 to 65.270 s"
        if start
        else "before the capture"
    ) in line
    assert list(tmp_path.iterdir()) == []


def test_a_live_recording_replaces_at_its_end(command, folder):
    with Program(command, "record", "--listen", f"{HOST}:0", "-o", "old.mcap", "--force") as program:
        told = [program.line(program.err) for _ in range(2)]
        assert "edoras: old.mcap is replaced at the end; until then the recording is old_1.mcap\n" in told
        assert (folder / "old.mcap").read_bytes() == b"precious"
        program.end()
    assert (folder / "old.mcap").read_bytes().startswith(b"\x89MCAP0")
    assert not (folder / "old_1.mcap").exists()


def test_an_empty_file_is_no_recording(call, folder):
    (folder / "old.mcap").write_bytes(b"")
    assert call("record", "-q", "-r", CAPTURE, "-o", "old.mcap").code == 0


def test_a_split_run_does_not_write_among_the_parts_of_another(call, folder):
    split = ("record", "-q", "-r", CAPTURE, "--split-time", "20s")
    assert call(*split, "-o", "run.mcap").code == 0
    parts = {path: path.read_bytes() for path in folder.glob("run_*")}
    assert len(parts) == 4
    (folder / "run_0.mcap").unlink()
    result = call(*split, "-o", "run.mcap")
    assert (result.code, result.err) == (
        2,
        ["edoras: run_1.mcap exists; name another output, or replace it with --force"],
    )
    assert call("record", "-q", "-r", CAPTURE, "-o", "run.mcap").code == 0, "not split, it is another file"


def test_a_name_with_the_time_in_folders_that_are_made(call, folder):
    assert call("record", "-q", "-r", CAPTURE, "-o", "new/%Y/run_%Y%m%d_%H%M%S.mcap").code == 0
    (path,) = folder.glob("new/*/*")
    assert re.fullmatch(r"run_\d{8}_\d{6}\.mcap", path.name)


def test_a_demo_without_a_name_takes_a_free_one(call, folder):
    (folder / "rover.mcap").write_bytes(b"precious")
    assert call("demo", "rover", "--duration", "50ms").code == 0
    assert (folder / "rover.mcap").read_bytes() == b"precious"
    assert call("info", "rover_1.mcap").code == 0
