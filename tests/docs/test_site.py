"""The pages as a site: no link is dead, and a browser that reads it asks no other machine."""

import json
import os
import re
import subprocess
import sys

import pytest
from places import ROOT

pytest.importorskip("mkdocs")


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", folder],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.long
def test_every_page_is_there_and_in_the_menu(site):
    pages = {path.stem for path in (ROOT / "docs").glob("*.md")} - {"README"}
    assert pages <= {path.stem for path in site.glob("*.html")}
    index = (site / "index.html").read_text(encoding="utf-8")
    assert {name for name in pages if f'href="{name}.html"' not in index} == set()


@pytest.mark.long
def test_pages_outside_of_the_folder_are_part_of_it(site):
    assert 'href="architecture.html"' in (site / "contributing.html").read_text(encoding="utf-8")
    assert 'href="contributing.html"' in (site / "index.html").read_text(encoding="utf-8")
    assert 'href="../balance.html"' in (site / "rules/index.html").read_text(encoding="utf-8")


@pytest.mark.long
def test_nothing_is_fetched_from_elsewhere(site):
    for path in site.rglob("*.html"):
        text = path.read_text(encoding="utf-8")
        assert re.findall(r'<(?:script|img|iframe|source)[^>]* src="?https?:[^>]*', text) == []
        assert re.findall(r'<link[^>]* href="?https?:[^>]*', text) == []
    for path in site.rglob("*.css"):
        assert re.findall(r"url\(.?https?:|@import", path.read_text(encoding="utf-8")) == []


@pytest.mark.long
def test_it_can_be_searched(site):
    text = (site / "search/search_index.json").read_text(encoding="utf-8")
    assert "superseded" in text
    assert "tcpreplay" in text


@pytest.mark.long
def test_a_page_is_found_before_the_changelog_that_names_it(site):
    found = json.loads((site / "search/search_index.json").read_text(encoding="utf-8"))["docs"]
    boosts = {item["location"].partition("#")[0]: item.get("boost", 1) for item in found}
    assert boosts.pop("changelog.html") < 0.5
    assert set(boosts.values()) == {1}
