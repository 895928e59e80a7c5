"""What a run wrote is never lost to a second run: what exists is refused, by every command that writes."""

import re

import pytest
from places import ROOT

ROVER = ROOT / "samples/missions/rover_ground.yaml"
CAPTURE = ROOT / "samples/captures/a_rover.pcap"
HOST = "127.0.0.1"
SWEEP = ["sweep", "/cmd_vel", "-c", ROVER, "--sim", "rover", "--rate", "2", "--step-time", "2s"]
WRITERS = {
    "record mcap": ("old.mcap", ["record", "-q", "-r", CAPTURE]),
    "record pcap": ("old.pcap", ["record", "-q", "-r", CAPTURE]),
    "record pcapng": ("old.pcapng", ["record", "-q", "-r", CAPTURE]),
    "record live": ("old.mcap", ["record", "-q", "--listen", f"{HOST}:0"]),
    "replay": ("old.mcap", ["replay", CAPTURE, "--to", "ci", "--target", f"{HOST}:9", "--no-listen"]),
    "inject": ("old.mcap", ["inject", "/cmd_vel", "{}", "-c", ROVER, "--target", f"{HOST}:9", "--no-listen"]),
    "proxy": ("old.mcap", ["proxy", "ci", "--target", f"{HOST}:9", "--listen", f"{HOST}:0"]),
    "bridge": ("old.mcap", ["bridge", "-c", ROVER, "--ros", "local"]),
    "live": ("old.mcap", ["live", "--listen", f"{HOST}:0", "--ws-port", "0"]),
    "demo": ("old.mcap", ["demo", "rover", "--duration", "50ms"]),
    "recover": ("old.mcap", ["recover", "cut.mcap"]),
    **{
        f"export {name}": (f"old.{name}", ["export", CAPTURE, "-c", ROVER, "--topic", "/cmd_vel"])
        for name in ("csv", "jsonl", "parquet", "arrow")
    },
    **{
        f"plot {name}": (f"old.{name}", ["plot", CAPTURE, "-c", ROVER, "/cmd_vel.linear.x"])
        for name in ("svg", "png", "html")
    },
    "check --init": ("old.yaml", ["check", "--init", CAPTURE, "-c", ROVER]),
    "mission draft": ("old.yaml", ["mission", "draft", CAPTURE]),
    "report": ("old.html", ["report", CAPTURE, "-c", ROVER]),
    "sweep --svg": ("old.svg", [*SWEEP, "--svg"]),
    "sweep --png": ("old.png", [*SWEEP, "--png"]),
}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working folder with a file of every kind that must stay as it is."""
    monkeypatch.chdir(tmp_path)
    for name, _ in WRITERS.values():
        (tmp_path / name).write_bytes(b"precious")
    (tmp_path / "cut.mcap").write_bytes(b"\x89MCAP0\r\n")
    return tmp_path


@pytest.mark.parametrize(("name", "words"), WRITERS.values(), ids=WRITERS)
def test_what_exists_is_refused(call, folder, name, words):
    before = {path: path.read_bytes() for path in folder.iterdir()}
    result = call(*words, *(() if words[0] == "sweep" else ("-o",)), name)
    assert result.code == 2
    (line,) = result.err
    assert re.fullmatch(
        f"edoras: {name} exists; name another output( with -o)?, or replace it with --force", line
    )
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


def test_force_replaces(call, folder):
    assert call("record", "-q", "-r", CAPTURE, "-o", "old.mcap", "--force").code == 0
    assert call("info", "old.mcap").code == 0


@pytest.mark.parametrize(
    ("name", "words"),
    [("old.html", ("report", CAPTURE, "-o")), ("old.svg", (*SWEEP, "--svg")), ("old.png", (*SWEEP, "--png"))],
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
