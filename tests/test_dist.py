"""What is published: its README works on a package index, its addresses stand, nothing is missing."""

from __future__ import annotations

import email
import os
import re
import runpy
import subprocess
import sys
import tarfile
import zipfile
from types import SimpleNamespace

import pytest
from markdown_it import MarkdownIt
from places import ROOT
from toml_files import TOML

from edoras_tools import __version__

SCRIPT = ROOT / ".ci/make_dist.py"
REPOSITORY = "https://example.org/owner/edoras-tools"


def run(repository, folder):
    return subprocess.run(
        [sys.executable, SCRIPT, repository, folder], capture_output=True, text=True, check=False
    )


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dist")
    done = run(REPOSITORY + ".git/", folder)
    assert done.returncode == 0, done.stderr
    sdist, wheel = map(str, sorted(folder.iterdir(), key=lambda path: path.suffix))
    assert done.stdout.split() == [sdist, wheel]
    with tarfile.open(sdist) as packed, zipfile.ZipFile(wheel) as built:
        (metadata,) = (name for name in built.namelist() if name.endswith(".dist-info/METADATA"))
        information = packed.extractfile(f"{packed.getnames()[0]}/PKG-INFO")
        return SimpleNamespace(
            files={name: built.read(name) for name in built.namelist()},
            packed={name.partition("/")[2] for name in packed.getnames()},
            wheel=email.message_from_bytes(built.read(metadata)),
            sdist=email.message_from_bytes(information.read()),
        )


def references(markdown):
    """The addresses that another Markdown reader finds in a text."""
    return re.findall(r'(?:href|src)="([^"]*)"', MarkdownIt().render(markdown))


@pytest.mark.long
@pytest.mark.parametrize("kind", ["wheel", "sdist"])
def test_every_link_and_picture_is_an_address(made, kind):
    text = getattr(made, kind).get_payload()
    found, before = references(text), references((ROOT / "README.md").read_text("utf-8"))
    assert [item for item in found if not item.startswith("https://")] == []
    relative = [item for item in before if not item.startswith("https://")]
    assert len(found) == len(before)
    assert len(relative) > 30
    assert {item.partition("/HEAD/")[2] for item in found if item.startswith(REPOSITORY)} == {*relative}
    pictures = [item for item in found if item.endswith(".svg")]
    assert len(pictures) >= 2
    assert all(item.startswith(f"{REPOSITORY}/raw/HEAD/docs/pictures/") for item in pictures)


@pytest.mark.long
@pytest.mark.parametrize("kind", ["wheel", "sdist"])
def test_the_project_s_addresses(made, kind):
    urls = dict(item.split(", ") for item in getattr(made, kind).get_all("Project-URL"))
    assert urls.keys() == {"Homepage", "Documentation", "Changelog", "Issues"}
    assert urls["Homepage"] == REPOSITORY
    for name in ("Documentation", "Changelog"):
        assert (ROOT / urls[name].removeprefix(f"{REPOSITORY}/blob/HEAD/")).is_file()


@pytest.mark.long
@pytest.mark.parametrize("kind", ["wheel", "sdist"])
def test_the_licences_and_the_authors(made, kind):
    metadata, project = getattr(made, kind), TOML.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert metadata["License-Expression"] == "MIT AND GPL-2.0-only"
    assert "License" not in metadata
    names = {f"LICENSES/{name}.txt" for name in metadata["License-Expression"].split(" AND ")}
    assert {*metadata.get_all("License-File")} == names
    texts = {name: (ROOT / name).read_text() for name in names}
    assert texts["LICENSES/MIT.txt"].startswith("MIT License")
    assert (
        "GNU GENERAL PUBLIC LICENSE\n                       Version 2" in texts["LICENSES/GPL-2.0-only.txt"]
    )
    assert f"(c) 2026 {metadata['Author']}\n" in texts["LICENSES/MIT.txt"]
    assert metadata["Version"] == project["version"] == __version__
    if kind == "sdist":
        assert {"LICENSE", *names} <= made.packed
        return
    (folder,) = {name.partition("/")[0] for name in made.files if ".dist-info/" in name}
    assert {name: made.files[f"{folder}/licenses/{name}"].decode() for name in names} == texts


@pytest.mark.long
def test_the_files_under_the_gpl_are_those_that_import_scapy(made):
    gpl = {name for name, text in made.files.items() if b"\n# SPDX-License-Identifier: GPL" in b"\n" + text}
    scapy = {
        name
        for name, text in made.files.items()
        if re.search(rb"^\s*(import|from) scapy\b", text, re.MULTILINE)
    }
    assert gpl == scapy
    assert len(gpl) == 3


@pytest.mark.long
def test_the_sdist_has_the_changelog_and_no_part_of_the_tests(made):
    assert "CHANGELOG.md" in made.packed
    assert [name for name in made.packed if name.startswith("tests/")] == []


@pytest.mark.long
def test_the_wheel_that_is_built_from_the_sdist_has_all_files(made):
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True)
    homes = {"dissectors/": "edoras_tools/dissectors/", "samples/": "edoras_tools/samples/"}
    homes |= {"edoras_tools/": "edoras_tools/", "docs/schemas/": "edoras_tools/schemas/"}
    wanted = {
        there + name.removeprefix(here)
        for name in listed.stdout.splitlines()
        for here, there in homes.items()
        if name.startswith(here)
    }
    assert len(wanted) > 600
    assert wanted - made.files.keys() == set()


@pytest.mark.parametrize("repository", ["", "edoras-tools", "http://example.org/a/b", "https://example.org/"])
def test_nothing_is_built_without_an_address(repository, tmp_path):
    done = run(repository, tmp_path / "dist")
    assert done.returncode == 1
    assert done.stderr == "name the repository: make dist REPOSITORY=https://host/owner/name\n"
    assert not (tmp_path / "dist").exists()


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("[a](x.md)", f"[a]({REPOSITORY}/blob/HEAD/x.md)"),
        ("[a](x.md#b)", f"[a]({REPOSITORY}/blob/HEAD/x.md#b)"),
        ("[a](d/)", f"[a]({REPOSITORY}/tree/HEAD/d/)"),
        ("![a [b]](x.md)", f"![a [b]]({REPOSITORY}/raw/HEAD/x.md)"),
        ("[a](#b)", "[a](#b)"),
        ("[a](https://b/c.md)", "[a](https://b/c.md)"),
        ("[a](mailto:b@c)", "[a](mailto:b@c)"),
        ("```sh\n[a](x.md)\n```\n[a](x.md)", f"```sh\n[a](x.md)\n```\n[a]({REPOSITORY}/blob/HEAD/x.md)"),
    ],
)
def test_links(text, wanted, tmp_path):
    (tmp_path / "d").mkdir()
    (tmp_path / "x.md").touch()
    absolute = runpy.run_path(str(SCRIPT))["absolute_links"]
    assert absolute(text, REPOSITORY, tmp_path) == wanted
    with pytest.raises(SystemExit, match=r"README\.md: y\.md is not there"):
        absolute(f"{text} [a](y.md)", REPOSITORY, tmp_path)


@pytest.mark.parametrize(
    ("target", "folder", "package"), [("demo", ".venv-demo", "."), ("venv", ".venv", ".[dev]")]
)
def test_the_demo_installs_no_more_than_a_user(target, folder, package, tmp_path):
    """Each has an environment of its own, and the one of the demo has no extras."""
    for name in ("Makefile", "pyproject.toml"):
        (tmp_path / name).write_bytes((ROOT / name).read_bytes())
    # What the make that runs the tests was given, as LOCKED=1, is not given to this one.
    env = {name: value for name, value in os.environ.items() if not name.startswith(("MAKE", "LOCKED"))}
    done = subprocess.run(
        ["make", "-n", target], cwd=tmp_path, capture_output=True, text=True, check=True, env=env
    )
    (install,) = (line for line in done.stdout.splitlines() if "pip install" in line)
    assert install.split()[0] == f"{folder}/bin/pip"
    assert install.endswith(f"-e '{package}'")
