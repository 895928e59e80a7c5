"""An add-on is a folder that can be deleted: in a copy of the package without it all else works.

The add-ons are those of the table, so that a new one is held to it too.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

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
    SAMPLES / "recordings/robot.mcap",
)
"""What add-ons may be about: messages through the bridges and the lab, DDS, topics without datagrams."""
RUN = "import sys; sys.argv[0] = 'edoras'; from edoras_tools.cli.programs import main; main()"
QUICK = ("wire", "cfs", "mission", "ros", "structs", "sessions", "io/formats", "io/frames")


def removed(folder: Path, *names: str) -> Path:
    """Copy the package without some add-ons; what lies beside it is linked."""
    package = folder / "edoras_tools"
    leave = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "edoras_tools", package, ignore=leave)
    for name, place in (("dissectors", "dissectors"), ("samples", "samples"), ("schemas", "docs/schemas")):
        (package / name).symlink_to(ROOT / place)
    for name in names:
        shutil.rmtree(package / "addons" / name)
    return folder


@pytest.fixture(scope="module", params=[*([item] for item in FOLDERS), FOLDERS], ids="-".join)
def without(request, tmp_path_factory):
    """The add-ons that are deleted, and a function that runs the copy without them."""
    home = removed(tmp_path_factory.mktemp("copy"), *request.param)

    def run(*words, code=RUN, cwd=home):
        return subprocess.run(
            # -S, and the libraries by path: the checkout itself is installed by a hook of site-packages
            [sys.executable, "-S", "-c" if code else "-m", *([code] if code else []), *map(str, words)],
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
            },
        )

    return request.param, run


SITE = next(path for path in sys.path if path.endswith("site-packages"))


def test_the_copy_is_what_runs_and_it_lacks_the_folder(without):
    names, run = without
    done = run(
        code="import edoras_tools.addons as a; print(a.__file__); from edoras_tools import doors, read"
    )
    assert done.returncode == 0, done.stderr
    home = Path(done.stdout.strip()).parent
    assert ROOT not in home.parents
    assert [name for name in names if (home / name).exists()] == []


def test_help_lists_all_commands_and_says_which_are_absent(without):
    names, run = without
    done = run("--help")
    assert done.returncode == 0, done.stderr
    assert [name for name in main.COMMANDS if not re.search(rf"\b{name} ", done.stdout)] == []
    absent = [command for name in names for command in COMMANDS[name]]
    assert " ".join(done.stdout.split()).count("(not in this installation)") == len(absent)


def test_its_commands_end_with_one_line(without):
    names, run = without
    for name in names:
        for command in COMMANDS[name]:
            for words in ((), ("anything", "--whatever", "-o", "x")):
                done = run(command, *words)
                (line,) = done.stderr.splitlines()
                assert done.returncode == 2
                assert (
                    f"command {command!r} of the add-on {name}: it is left out of this installation" in line
                )


def test_what_else_it_added_is_refused_in_one_line(without):
    names, run = without
    for folder, kind, name in PARTS:
        code = f"""
from edoras_tools import doors, errors
try:
    print(bool(doors.find({kind!r}, {name!r}).load()))
except errors.ConfigError as error:
    print(error)
"""
        done = run(code=code)
        assert done.returncode == 0, done.stderr
        refused = f"of the add-on {folder}: it is left out of this installation" in done.stdout
        assert refused == (folder in names), done.stdout


def test_recordings_with_its_traffic_open(without):
    _, run = without
    for path in RECORDED:
        done = run("info", path)
        assert done.returncode in {0, 3}, done.stderr
        assert "from  " in done.stdout
        assert "Traceback" not in done.stderr


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
    done = run("pytest", "-q", "-p", "no:cacheprovider", *places, code="", cwd=tmp_path)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-1000:]
