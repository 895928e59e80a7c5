"""``pytest --workers``: the outcomes are those of one process, whatever happens to a worker."""

import os
import signal
import subprocess
import sys

import pytest
from places import ROOT

KEPT = """
import pathlib, pytest, time, workers
from multiprocessing.connection import Connection

class Crew(workers.Crew):
    def stop(self):
        super().stop()
        pathlib.Path("stopped").touch()

workers.Crew = Crew

POLL = Connection.poll

def late(self, *arguments):  # the first process is slow: much is said, and a worker ends, between its looks
    found = POLL(self, *arguments)
    if not found:
        time.sleep(0.05)
    return found

Connection.poll = late

@pytest.fixture(scope="session")
def kept(tmp_path_factory):
    log = pathlib.Path("kept").open("a", buffering=1)
    print("up", file=log)
    yield tmp_path_factory.getbasetemp()
    print("down", file=log)
"""
OUTCOMES = """
import os, signal, warnings
import pytest

def test_first(kept): pass

def test_wrong(kept):
    print("what it printed")
    assert 1 + 1 == 3

@pytest.mark.xfail(reason="known")
def test_known(): assert False

def test_left(): pytest.skip("no need")

def test_warns(): warnings.warn("old ways", stacklevel=1)

def test_broken(nothing_of_that_name): pass

def test_dies(): os.kill(os.getpid(), signal.SIGKILL)

def test_last(kept): assert "what it printed" not in os.listdir(kept)
"""
FINE = "def test_here(kept, tmp_path): assert tmp_path.parent.parent == kept.parent.parent / kept.parent.name"
SLOW = """
import os, signal, time, pathlib

def test_goes_on(kept):
    pathlib.Path("begun").touch()
    while not pathlib.Path("stopped").exists(): time.sleep(0.01)

def test_never(): pathlib.Path("never").touch()
"""
ENDS = """
import os, pathlib, signal, time

def test_ends():
    while not pathlib.Path("begun").exists(): time.sleep(0.01)
    {how}
"""


@pytest.fixture
def pytest_of(tmp_path):
    """A function: run pytest on files of tests by name; gives its exit code and output."""

    def run(*options, **files):
        (tmp_path / "conftest.py").write_text(KEPT)
        for name, text in files.items():
            (tmp_path / f"test_{name}.py").write_text(text)
        words = [sys.executable, "-m", "pytest", "-c/dev/null", "--rootdir=.", "-pworkers", "-rA", *options]
        path = os.pathsep.join(str(ROOT / folder) for folder in ("tests/support", ".ci"))
        ran = subprocess.run(
            words,
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": path, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"},
            capture_output=True,
            text=True,
            timeout=100,
            check=False,
        )
        return ran.returncode, ran.stdout + ran.stderr

    return run


def test_each_outcome_is_told_and_the_rest_runs_when_a_worker_dies(pytest_of, tmp_path):
    code, text = pytest_of("--workers=2", a=OUTCOMES, b=FINE, c=FINE)
    assert code == 1, text
    assert "2 failed, 5 passed, 1 skipped, 1 xfailed, 1 warning, 1 error" in text, text
    told = {tuple(line.split()[:2]) for line in text.splitlines() if " test_" in line and "::" in line}
    assert told == {
        *(("PASSED", f"test_a.py::test_{name}") for name in ("first", "warns", "last")),
        *(("PASSED", f"test_{name}.py::test_here") for name in "bc"),
        *(("FAILED", f"test_a.py::test_{name}") for name in ("wrong", "dies")),
        ("XFAIL", "test_a.py::test_known"),
        ("ERROR", "test_a.py::test_broken"),
    }
    assert "test_dies - its process ended with exit code -9" in text
    assert "what it printed" in text
    assert "UserWarning: old ways" in text
    log = (tmp_path / "kept").read_text().split()
    assert log.count("up") - log.count("down") == 1  # that of the worker that was killed


@pytest.mark.quick("assert*")
@pytest.mark.parametrize(
    ("how", "option", "code", "summary"),
    [
        ("assert False", "--exitfirst", 1, "1 failed, 1 passed"),
        (f"os.kill(os.getppid(), {signal.SIGINT:d})", "--quiet", 2, "2 passed"),
    ],
)
def test_the_others_end_their_test_and_take_down_what_they_set_up(
    pytest_of, tmp_path, how, option, code, summary
):
    found, text = pytest_of("--workers=2", option, a=SLOW, b=ENDS.format(how=how))
    assert found == code
    assert summary in text
    assert (tmp_path / "kept").read_text().split() == ["up", "down"]
    assert not (tmp_path / "never").exists()


@pytest.mark.long
def test_a_mistake_in_a_file_is_told_before_any_test_runs(pytest_of, tmp_path):
    code, text = pytest_of("--workers=2", a="import nothing_of_that_name", b=FINE)
    assert code == 2
    assert "1 error during collection" in text
    assert not (tmp_path / "kept").exists()


MARKED = """
import pytest

@pytest.mark.long
def test_left(): assert False

@pytest.mark.long("?-b")
@pytest.mark.parametrize("other", "ab")
@pytest.mark.parametrize("one", "xy")
def test_some_left(one, other): assert other == "a"

@pytest.mark.quick("x", "y*")
@pytest.mark.parametrize("one", ["x", "xx", "yy"])
def test_some_kept(one): assert one != "xx"

@pytest.mark.quick("?")
@pytest.mark.each(3)
@pytest.mark.parametrize("one", ["a", "xx", "b", "c", "d", "e"])
def test_each_third(one): assert one in "ad"
"""
HOOKS = """
import effort, pytest

def pytest_configure(config):
    for name in ("long", "quick", "each"):
        config.addinivalue_line("markers", name)

def pytest_collection_modifyitems(items):
    if wrong := effort.unmatched(items):
        raise pytest.UsageError(str(wrong))
    effort.LONG = False
    items[:] = effort.split(items)[0]
"""


@pytest.mark.quick("right")
@pytest.mark.parametrize(
    ("text", "code", "said"),
    [
        (MARKED, 0, "6 passed"),
        (MARKED.replace('"x", "y*"', '"x", "z*"'), 4, "('test_a.py::test_some_kept', 'z*')"),
    ],
    ids=["right", "misspelt"],
)
def test_what_is_marked_is_left_to_make_long(pytest_of, monkeypatch, text, code, said):
    monkeypatch.setattr(sys.modules[__name__], "KEPT", HOOKS)
    found, out = pytest_of(a=text)
    assert found == code, out
    assert said in out
