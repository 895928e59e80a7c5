"""Imports point one way, optional libraries wait until they are needed, and scapy stays in its two rooms."""

from __future__ import annotations

import ast
import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("edoras_tools", "dissectors", "samples")
SCAPY_ROOMS = ("dissectors/", "edoras_tools/sources/scapy_backend.py")
"""scapy is GPL-2.0-only, the project MIT."""
HEAVY = {"numpy", "scapy", "mcap", "rosbags", "ruamel", "zstandard", "lz4"}


@cache
def modules():
    """Every Python file of the project, by its path."""
    return {
        path.relative_to(ROOT).as_posix(): ast.parse(path.read_text(encoding="utf-8"))
        for package in PACKAGES
        for path in sorted((ROOT / package).rglob("*.py"))
    }


def imported(nodes):
    """The top-level packages that are imported anywhere in some syntax trees."""
    found = [item for node in nodes for item in ast.walk(node)]
    names = [alias.name for item in found if isinstance(item, ast.Import) for alias in item.names]
    names += [item.module for item in found if isinstance(item, ast.ImportFrom) and not item.level]
    return {name.partition(".")[0] for name in names}


def loaded_by(program):
    """The modules that a program leaves behind."""
    code = f"{program}\nprint('\\n'.join(sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", f"import sys\n{code}"], capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == 0, done.stderr
    return {name.partition(".")[0] for name in done.stdout.splitlines()}


def test_contracts():
    """What pyproject.toml says of the folders: import-linter's own verdict."""
    done = subprocess.run(
        [Path(sys.executable).with_name("lint-imports"), "--no-cache"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert done.returncode == 0, done.stdout
    assert "0 broken" in done.stdout


def test_scapy_is_imported_in_two_rooms_only():
    found = {name for name, tree in modules().items() if "scapy" in imported([tree])}
    assert found
    assert {name for name in found if not name.startswith(SCAPY_ROOMS)} == set()


def test_scapy_is_imported_only_when_it_is_needed():
    """Never while a module is being imported, but for the layers that are scapy layers."""
    for name, tree in modules().items():
        if not name.startswith("dissectors/"):
            at_once = [node for node in tree.body if not isinstance(node, (ast.FunctionDef, ast.ClassDef))]
            assert "scapy" not in imported(at_once), name


def test_files_with_scapy_say_their_licence():
    for name, tree in modules().items():
        if "scapy" in imported([tree]):
            head = (ROOT / name).read_text(encoding="utf-8").splitlines()[:3]
            assert "# SPDX-License-Identifier: GPL-2.0-only" in head, name


@pytest.mark.parametrize("arguments", ["--help", "--version", "sniff --help", "record --help", "nonsense"])
def test_help_loads_nothing_heavy(arguments):
    program = f"""
sys.argv = ["edoras", *{arguments.split()!r}]
from edoras_tools.cli import main
try:
    main.run(main.program())
except SystemExit:
    pass
"""
    assert loaded_by(program) & HEAVY == set()


@pytest.mark.parametrize(
    ("module", "absent"),
    [
        ("wire", {"scapy", "mcap", "rosbags", "ruamel", "typer", "rich", "zstandard"}),
        ("model", {"scapy", "mcap", "rosbags", "ruamel", "typer", "rich", "zstandard"}),
        ("sources.live", {"scapy", "mcap", "rosbags", "ruamel", "typer", "rich"}),
        ("pipelines.workbench", {"scapy", "mcap", "typer", "rich"}),
    ],
)
def test_what_libraries_a_room_brings_along(module, absent):
    assert loaded_by(f"import edoras_tools.{module}") & absent == set()


def test_every_package_is_installed():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]
    there = {file.parent.relative_to(ROOT) for file in (ROOT / "edoras_tools").rglob("*.py")}
    assert {".".join(folder.parts) for folder in there} <= {*settings["packages"]}
