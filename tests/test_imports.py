"""Imports point one way, slow ones wait until they are needed, and scapy stays in its two rooms."""

from __future__ import annotations

import ast
import importlib.util
import re
import subprocess
import sys
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path

import pytest
from packaged import installed_packages
from places import ROOT

from edoras_tools import doors

PACKAGES = ("edoras_tools", "dissectors", "samples")
SCAPY_ROOMS = ("dissectors/", "edoras_tools/io/capture/scapy_backend.py")
"""scapy is GPL-2.0-only, the project MIT."""
COMMAND_LINES = ("cli/*", "addons/*/cli.py", "addons/*/cli/*")
PUT_OFF = {
    "__init__.py": ("importlib", "loads warnings: nothing comes before the programs heed Ctrl-C"),
    "addons/dds/endpoints.py": ("cyclonedds", "a part of its inside, which may not be there"),
    "doors.py": (
        "edoras_tools.addons importlib.metadata",
        "the table, when an add-on is asked for; 11 ms, and only where a package adds something",
    ),
    "io/capture/device.py": ("fcntl", "not there on Windows"),
    "io/formats/watched.py": ("concurrent.futures", "4 ms, and only to sync files"),
    "io/outputs.py": ("fcntl hashlib", "not there on Windows; 5 ms, and only for long names"),
    "pipelines/sending/inject.py": ("ruamel", "9 ms, and only where a message has values"),
    "pipelines/reading.py": ("termios tty", "not there on Windows"),
    "io/capture/scapy_backend.py": ("scapy", "0.35 s, and only where there is no packet ring"),
    "io/formats/open.py": (
        "edoras_tools.io.formats.rosbag2.reader",
        "only for directories, whose metadata needs YAML",
    ),
    "io/formats/capture_file.py": (
        "tempfile zstandard",
        "only for recordings from a pipe or packed, and for captures inside zstd data",
    ),
    "io/topics/edoras.py": ("edoras_tools.sessions.faults.rules", "2 ms, and only where faults are read"),
    "io/frames/linklayer.py": ("edoras_tools.io.frames", "10 ms, and only where there are TCP streams"),
    "decode/filters/rows.py": (
        "edoras_tools.decode.stack",
        "10 ms, and only where packets are read one by one",
    ),
    "addons/foxglove/server/server.py": (
        "edoras_tools.addons.foxglove.server.client",
        "websockets, an extra: when the first client comes",
    ),
    "addons/rtps/link.py": ("edoras_tools.addons.rtps.wire", "5 ms, and only where there are its datagrams"),
    "mission/model.py": ("edoras_tools.cfs.profile", "6 ms, and only where constants are asked for"),
    "mission/tree.py": ("yaml", "9 ms, and only where there is a mission file"),
    "pipelines/capture/record.py": (
        "edoras_tools.io.host",
        "4 ms, and only where a link is captured live",
    ),
    "addons/lab/demo/run.py": ("zenoh", "an extra"),
    "pipelines/capture/ledger.py": (
        "edoras_tools.mission edoras_tools.ros.store importlib",
        "20 ms, and only where no message is of its type",
    ),
    "pipelines/selection.py": (
        "edoras_tools.decode.filters.filter",
        "the filter language: only where there is a filter",
    ),
    "pipelines/workbench.py": (
        "edoras_tools",
        "decoders and files, which not every command needs; missions, layouts and single packets",
    ),
    "render/capture/watch.py": ("edoras_tools.render", "rich, and only where something is drawn"),
    "ros/store.py": ("edoras_tools.ros.cdr", "10 ms, and only where messages are checked or become columns"),
    "ros/library.py": (
        "rosbags",
        "15 ms, and only for .idl files and to make the table of standard messages anew",
    ),
    "sessions/faults/effects.py": ("hashlib", "20 ms, and only where there are faults"),
    "addons/debug_info/dwarf.py": ("elftools", "an extra"),
    "structs/files.py": ("ruamel", "14 ms, and only for layouts that are files"),
    "structs/table.py": ("edoras_tools", "20 ms, when the first packet holds a struct"),
    "wire/arrays.py": ("isal zlib", "1 ms, and only where a CRC-32 is made"),
}
"""Modules outside ``COMMAND_LINES`` that import inside functions: what, and why. ``cli`` has the rule."""
INDENTED = re.compile(r"^[ \t]+(import|from)\b", re.MULTILINE)
FOR_TYPES = re.compile(r"^if TYPE_CHECKING:\n(?:[ \t].*\n|\n)*", re.MULTILINE)
"""What may be an import inside a function, and what is none."""
HEAVY = {"numpy", "scapy", "mcap", "rosbags", "ruamel", "yaml", "zstandard", "lz4"}


@cache
def modules():
    """The text of every Python file of the project, by its path."""
    return {
        path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8")
        for package in PACKAGES
        for path in sorted((ROOT / package).rglob("*.py"))
    }


@cache
def tree_of(name):
    """The syntax tree of one of ``modules``."""
    return ast.parse(modules()[name])


def imported(nodes):
    """The top-level packages that are imported anywhere in some syntax trees."""
    found = [item for node in nodes for item in ast.walk(node)]
    names = [alias.name for item in found if isinstance(item, ast.Import) for alias in item.names]
    names += [item.module for item in found if isinstance(item, ast.ImportFrom) and not item.level]
    return {name.partition(".")[0] for name in names}


@cache
def of_scapy():
    """The modules that import scapy anywhere."""
    return {
        name for name, text in modules().items() if "scapy" in text and "scapy" in imported([tree_of(name)])
    }


def loaded_by(program):
    """The modules that a program leaves behind."""
    code = f"{program}\nprint('\\n'.join(sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", f"import sys\n{code}"],
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return {name.partition(".")[0] for name in done.stdout.splitlines()}


@pytest.mark.long
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
    assert of_scapy()
    assert {name for name in of_scapy() if not name.startswith(SCAPY_ROOMS)} == set()


def test_scapy_is_imported_only_when_it_is_needed():
    """Never while a module is being imported, but for the layers that are scapy layers."""
    for name in of_scapy():
        if not name.startswith("dissectors/"):
            at_once = [
                node for node in tree_of(name).body if not isinstance(node, (ast.FunctionDef, ast.ClassDef))
            ]
            assert "scapy" not in imported(at_once), name


def test_files_with_scapy_say_their_licence():
    for name in of_scapy():
        head = (ROOT / name).read_text(encoding="utf-8").splitlines()[:3]
        assert "# SPDX-License-Identifier: GPL-2.0-only" in head, name


@pytest.mark.quick("record --help", "nonsense")
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


@pytest.mark.quick("model*", "pipelines.workbench*")
@pytest.mark.parametrize(
    ("module", "absent"),
    [
        ("wire", {"scapy", "mcap", "rosbags", "ruamel", "yaml", "typer", "rich", "zstandard"}),
        ("model", {"scapy", "mcap", "rosbags", "ruamel", "yaml", "typer", "rich", "zstandard"}),
        ("io.capture.live", {"scapy", "mcap", "rosbags", "ruamel", "yaml", "typer", "rich"}),
        ("pipelines.workbench", {"scapy", "mcap", "typer", "rich"}),
        ("pipelines.capture.record", {"scapy", "mcap", "typer", "rich", "hashlib", "tempfile"}),
    ],
)
def test_what_libraries_a_room_brings_along(module, absent):
    assert loaded_by(f"import edoras_tools.{module}") & absent == set()


def inside_functions(tree):
    """The modules that functions of a syntax tree import."""
    functions = [item for item in ast.walk(tree) if isinstance(item, (ast.FunctionDef, ast.AsyncFunctionDef))]
    inner = [item for function in functions for item in ast.walk(function)]
    names = {alias.name for item in inner if isinstance(item, ast.Import) for alias in item.names}
    return names | {item.module for item in inner if isinstance(item, ast.ImportFrom)}


def test_imports_inside_functions_are_those_that_are_named():
    ours = {
        name.removeprefix("edoras_tools/"): name
        for name, text in modules().items()
        if name.startswith("edoras_tools/") and INDENTED.search(FOR_TYPES.sub("", text))
    }
    found = {
        name: inside_functions(tree_of(path))
        for name, path in ours.items()
        if not any(fnmatchcase(name, pattern) for pattern in COMMAND_LINES)
    }
    assert {name for name, names in found.items() if names} == set(PUT_OFF)
    for name, (libraries, _) in PUT_OFF.items():
        named = tuple(f"{library}." for library in libraries.split())
        assert {item for item in found[name] if not f"{item}.".startswith(named)} == set(), name


def test_every_package_is_installed():
    there = {file.parent.relative_to(ROOT) for file in (ROOT / "edoras_tools").rglob("*.py")}
    assert {".".join(folder.parts) for folder in there} <= {*installed_packages().names}


def test_every_name_that_a_package_offers_is_there():
    """Many are imported at their first use, so that a move would break them unseen. None needs an extra."""
    packages = {
        name.removesuffix("/__init__.py").replace("/", ".")
        for name, text in modules().items()
        if name.startswith("edoras_tools/") and name.endswith("/__init__.py") and "__all__" in text
    }
    assert {"edoras_tools", "edoras_tools.ros", "edoras_tools.io"} <= packages
    missing = []
    for package in map(importlib.import_module, sorted(packages)):
        for name in package.__all__:
            try:
                getattr(package, name)
            except (AttributeError, ImportError) as error:
                missing.append(f"{package.__name__}.{name}: {error}")
    assert missing == []


def names_in(tree):
    """What a syntax tree imports, and its texts, among which may be names of modules."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


def test_nothing_but_the_door_imports_an_add_on():
    outside = {name: text for name, text in modules().items() if not name.startswith("edoras_tools/addons/")}
    assert len(outside) > len(modules()) / 2
    through = {
        name
        for name, text in outside.items()
        if "addons" in text
        and any(f"{item}.".startswith("edoras_tools.addons.") for item in names_in(tree_of(name)))
    }
    assert through == {"edoras_tools/doors.py"}


def test_the_core_compares_with_no_link_of_an_add_on():
    """A key of a mission file may be called as a link is."""
    labels = {*doors.shipped("links")}
    quoted = re.compile(rf"""["']({"|".join(labels)})["']""")
    compared = {
        (name, item.value)
        for name, text in modules().items()
        if name.startswith("edoras_tools/") and not name.startswith("edoras_tools/addons/")
        if quoted.search(text)
        for node in ast.walk(tree_of(name))
        if isinstance(node, ast.Compare)
        for side in (node.left, *node.comparators)
        for item in ast.walk(side)
        if isinstance(item, ast.Constant) and item.value in labels
    }
    assert compared == {("edoras_tools/mission/bridges.py", "cfdp")}


def test_the_table_of_add_ons_imports_none():
    table = names_in(tree_of("edoras_tools/addons/__init__.py"))
    assert not [item for item in table if f"{item}.".startswith("edoras_tools.")]


def test_what_benchmarks_import_is_there():
    """Nothing else runs the benchmarks between two measurements, and a move would break them unseen."""
    missing = [
        f"{path.name}: {item.module}.{alias.name}"
        for path in sorted((ROOT / "benchmarks").glob("*.py"))
        for item in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(item, ast.ImportFrom) and str(item.module).startswith("edoras_tools")
        for alias in item.names
        if not hasattr(importlib.import_module(str(item.module)), alias.name)
        and importlib.util.find_spec(f"{item.module}.{alias.name}") is None
    ]
    assert not missing
