"""An add-on is a folder that can be deleted: in a copy of the package without it all else works.

The add-ons are those of the table, so that a new one is held to it too.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from places import CAPTURES, ROOT, SAMPLES

from edoras_tools.addons import ADDONS
from edoras_tools.cli import main

FOLDERS = [row.folder for row in ADDONS]
COMMANDS = {row.folder: sorted(row.commands) for row in ADDONS}
PARTS = [(row.folder, kind, name) for row in ADDONS for kind in row.adds for name in row.adds[kind]]
RECORDED = (
    CAPTURES / "a_rover.pcap",
    SAMPLES / "rtps/cyclone_sender.pcap.gz",
    SAMPLES / "fprime/rover.pcap",
    SAMPLES / "cfs_files/cf_transfer.pcap",
    SAMPLES / "recordings/robot.mcap",
)
"""What add-ons may be about: the bridges and the lab, DDS, F Prime, CFDP, topics without datagrams."""
CHECKS = """
import json, os, sys, tempfile
import edoras_tools.addons
from edoras_tools import doors, errors, read
from edoras_tools.cli import programs, main

def refusal(kind, name):
    try:
        return str(bool(doors.find(kind, name).load()))
    except errors.ConfigError as error:
        return str(error)

def ran(words):
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        if not (child := os.fork()):
            os.dup2(out.fileno(), 1)
            os.dup2(err.fileno(), 2)
            sys.argv = ["edoras", *words]
            programs.main()
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        return code, *(os.pread(file.fileno(), 1 << 20, 0).decode() for file in (out, err))

parts, lines = json.load(sys.stdin)
told = {"home": edoras_tools.addons.__file__}
told["parts"] = [refusal(*part) for part in parts]
told["lines"] = [ran(words) for words in lines]
json.dump(told, sys.stdout)
"""
"""Run in a copy: what its add-ons add, and command lines, each in a process that has the core's modules."""
QUICK = ("wire", "cfs", "mission", "ros", "structs", "sessions", "io/formats", "io/frames")


def removed(folder: Path, *names: str) -> Path:
    """Copy the package without some add-ons; what lies beside it is linked."""
    package = folder / "edoras_tools"
    shutil.copytree(ROOT / "edoras_tools", package)  # with what Python compiled: times are copied, too
    for name, place in (("dissectors", "dissectors"), ("samples", "samples"), ("schemas", "docs/schemas")):
        (package / name).symlink_to(ROOT / place)
    for name in names:
        shutil.rmtree(package / "addons" / name)
    return folder


@pytest.fixture(scope="module", params=[*([item] for item in FOLDERS), FOLDERS], ids="-".join)
def without(request, tmp_path_factory):
    """The add-ons that are deleted, and a function that runs the copy without them."""
    home = removed(tmp_path_factory.mktemp("copy"), *request.param)

    def run(*words, cwd=home, data=None):
        return subprocess.run(
            # -S, and the libraries by path: the checkout itself is installed by a hook of site-packages
            [sys.executable, "-S", *words],
            input=data,
            stdin=None if data else subprocess.DEVNULL,
            capture_output=True,
            text=True,
            check=False,
            timeout=1500,
            cwd=cwd,
            env={
                "PYTHONPATH": f"{home}:{SITE}",
                "PATH": "/usr/bin:/bin",
                "COLUMNS": "100",
                "HOME": str(home),
                "OPENBLAS_NUM_THREADS": "1",  # as edoras does: threads do not survive a fork
            },
        )

    return request.param, run


SITE = next(path for path in sys.path if path.endswith("site-packages"))


@pytest.fixture(scope="module")
def told(without):
    """The add-ons that are deleted, where the copy lies, what each part and each command line gave."""
    names, run = without
    commands = [(name, command) for name in names for command in COMMANDS[name]]
    lines = [("--help",), *(("info", str(path)) for path in RECORDED)]
    lines += [
        (command, *words) for _, command in commands for words in ((), ("anything", "--whatever", "-o", "x"))
    ]
    done = run("-c", CHECKS, data=json.dumps([[part[1:] for part in PARTS], lines]))
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    ends = [SimpleNamespace(code=code, out=out, err=err) for code, out, err in found["lines"]]
    parts = dict(zip(PARTS, found["parts"], strict=True))
    return SimpleNamespace(
        names=names, home=Path(found["home"]).parent, parts=parts, lines=dict(zip(lines, ends, strict=True))
    )


@pytest.mark.quick("*-*")
def test_the_copy_is_what_runs_and_it_lacks_the_folder(told):
    assert ROOT not in told.home.parents
    assert [name for name in told.names if (told.home / name).exists()] == []


@pytest.mark.quick("*-*")
def test_help_lists_all_commands_and_says_which_are_absent(told):
    done = told.lines["--help",]
    assert done.code == 0, done.err
    assert [name for name in main.COMMANDS if not re.search(rf"\b{name} ", done.out)] == []
    absent = [command for name in told.names for command in COMMANDS[name]]
    assert " ".join(done.out.split()).count("(not in this installation)") == len(absent)


@pytest.mark.quick("*-*")
def test_its_commands_end_with_one_line(told):
    for name in told.names:
        for command in COMMANDS[name]:
            ends = [done for words, done in told.lines.items() if words[0] == command]
            assert len(ends) == 2
            for done in ends:
                (line,) = done.err.splitlines()
                assert done.code == 2
                assert (
                    f"command {command!r} of the add-on {name}: it is left out of this installation" in line
                )


@pytest.mark.quick("*-*")
def test_what_else_it_added_is_refused_in_one_line(told):
    for (folder, kind, name), text in told.parts.items():
        refused = f"of the add-on {folder}: it is left out of this installation" in text
        assert refused == (folder in told.names), (kind, name, text)


@pytest.mark.quick("*-*")
def test_recordings_with_its_traffic_open(told):
    for path in RECORDED:
        done = told.lines["info", str(path)]
        assert done.code in {0, 3}, done.err
        assert "from  " in done.out
        assert "Traceback" not in done.err


def core_tests(*names: str) -> tuple[list[str], list[str]]:
    """The quick tests of the core, and those of them that use an add-on as a judge, which are left out."""
    files = [path for name in QUICK for path in sorted((ROOT / "tests" / name).rglob("test_*.py"))]
    uses = re.compile(rf"edoras_tools\.addons\.({'|'.join(names)})\b")
    judges = {path.stem for path in (ROOT / "tests/support").glob("*.py") if uses.search(path.read_text())}
    through = re.compile(rf"^(?:from|import) ({'|'.join(judges) or '-'})\b", re.MULTILINE)
    left = [path for path in files if uses.search(path.read_text()) or through.search(path.read_text())]
    return tuple([path.relative_to(ROOT).as_posix() for path in some] for some in (files, left))


@pytest.mark.long
@pytest.mark.limit(1800)
def test_the_quick_tests_of_the_core_pass(without, tmp_path):
    names, run = without
    for name in (".ci", "tests", "docs", "samples", "dissectors", "pyproject.toml", "setup.py"):
        (tmp_path / name).symlink_to(ROOT / name)
    files, left = core_tests(*names)
    assert len(left) < len(files) / 10, left
    places = [name for name in files if name not in left]
    done = run("-m", "pytest", "-q", "-p", "no:cacheprovider", *places, cwd=tmp_path)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-1000:]
