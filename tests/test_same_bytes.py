"""What the commands print and write is what it was: the quick part of ``tests/same_bytes.py``."""

from __future__ import annotations

import subprocess
import sys

import pytest
from places import ROOT

SCRIPT = ROOT / "tests/same_bytes.py"


def run(*words, script=SCRIPT):
    return subprocess.run([sys.executable, script, *words], capture_output=True, text=True, check=False)


def test_the_quick_outputs_are_the_committed_ones():
    ran = run("--quick")
    assert ran.returncode == 0, ran.stdout + ran.stderr


@pytest.mark.long
def test_all_outputs_are_the_committed_ones():
    ran = run()
    assert ran.returncode == 0, ran.stdout + ran.stderr


@pytest.mark.long
def test_another_output_is_noticed(tmp_path):
    """A copy of the committed hashes, one of them changed and one of a line that nobody runs."""
    line = "inject --dry-run --json noop ci"
    (tmp_path / "inject.txt").write_text(f"{'0' * 16}  {line}\n", encoding="utf-8")
    (tmp_path / "gone.txt").write_text(f"{'0' * 16}  gone\n", encoding="utf-8")
    ran = run("--hashes", str(tmp_path), line)
    assert ran.returncode == 1
    changed, obsolete, count = ran.stdout.splitlines()
    assert changed.startswith(f"{'0' * 16} -> ")
    assert changed.endswith(f"  edoras {line}")
    assert obsolete == "no longer run: edoras gone"
    assert count == "1 outputs, 1 differ"
    assert run("--hashes", str(tmp_path), "--update", line).returncode == 0
    assert run("--hashes", str(tmp_path), line).stdout == "1 outputs, 0 differ\n"
    assert not (tmp_path / "gone.txt").exists()
