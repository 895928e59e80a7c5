"""What the pages show is what happens: `python docs/refresh.py` after a change that is meant."""

from __future__ import annotations

import re
import shlex

import namespace
import pytest
import typer
from effort import long_but
from places import ROOT

from edoras_tools.cli import main
from edoras_tools.model import Columns, Finding, PacketBatch
from edoras_tools.render.severity import EXPLANATIONS

PAGES = sorted(
    [ROOT / "README.md", ROOT / "CHANGELOG.md", ROOT / "samples/README.md", *(ROOT / "docs").glob("*.md")],
    key=str,
)
REFRESHED = [page for page in PAGES if page.stem not in {"sim", "bench", "tutorial", "CHANGELOG"}]
LIBRARIES = ("pyarrow", "pandas", "duckdb", "polars")
"""Of the extra ``dev``: the page of each is run where all are installed."""
COMMANDS = (
    *("sniff", "record", "info", "decode", "recover", "export", "sim", "demo", "doctor", "report", "compare"),
    *("check", "plot"),
    *("replay", "inject", "sweep", "proxy", "wireshark", "live", "bridge", "codegen", "structs"),
)


def identity(page):
    return str(page.relative_to(ROOT))


def without_sizes(text):
    """Compressed sizes are the compressor's, not ours."""
    return re.sub(r"\d+\.\d [KM]iB", "SIZE", text)


# Three take long and are for `make long`: what they show is held by tests of sweep, diagnosis, archive too.
QUICK = [page for page in REFRESHED if page.stem not in {"sweep", "balance", "archive"}]


@pytest.mark.each(3)
@pytest.mark.long(
    "docs/doctor.md",
    "docs/recover.md",
    "docs/trace.md",
    "docs/questions.md",
    "docs/missions.md",
    "docs/inject.md",
    "docs/xtce.md",
    "docs/record.md",
    "docs/check.md",
    "docs/rtps.md",
    "docs/fprime.md",
    "docs/wire.md",
    "docs/compare.md",
    "docs/structs.md",
    "docs/analysis.md",
    "docs/settings.md",
    "docs/replay.md",
    "docs/plot.md",
    "docs/export.md",
    "docs/experiment.md",
)
@pytest.mark.parametrize("page", long_but(QUICK, REFRESHED), ids=identity)
def test_the_output_shown_is_the_output(page, refresh, typed, tmp_path):
    for library in LIBRARIES if page.stem == "analysis" else ():
        pytest.importorskip(library)
    assert without_sizes(refresh.refreshed(page, tmp_path, typed)) == without_sizes(page.read_text())


def outputs(page, refresh):
    """Return the commands of a page, each with the first line of its output, figures masked."""
    blocks = [found[2] for found in refresh.FENCED.findall(page)]
    parts = [part for block in blocks for part in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]]
    lines = [part.partition("\n") for part in parts]
    masked = [(line, re.sub(r"\d[\d.,]*", "N", output.partition("\n")[0])) for line, _, output in lines]
    return [(line, first.removesuffix(" Up to N more may be lost.")) for line, first in masked]


@pytest.mark.long
def test_the_tutorial_runs_from_capture_to_cure(refresh, tmp_path):
    """In the time that it takes, in a network of its own; how many are lost is another number each time."""
    page = ROOT / "docs/tutorial.md"
    ran = namespace.inside(lambda: refresh.refreshed(page, tmp_path))
    assert outputs(ran, refresh) == outputs(page.read_text(), refresh)


@pytest.fixture(scope="module")
def program():
    return typer.main.get_command(main.program())


def test_every_page_that_runs_is_refreshed(refresh):
    assert sorted(refresh.PAGES, key=str) == sorted([*REFRESHED, ROOT / "docs/tutorial.md"], key=str)
    assert refresh.chosen([]) == refresh.PAGES
    assert refresh.chosen([str(ROOT / "docs/info.md")]) == [ROOT / "docs/info.md"]
    with pytest.raises(SystemExit, match="not a page with output"):
        refresh.chosen(["none.md"])


@pytest.mark.parametrize("page", PAGES, ids=identity)
def test_options_of_live_commands_exist(page, refresh, program):
    """They need a network or a clock, so only their command lines are read."""
    for found in refresh.FENCED.finditer(page.read_text()):
        if found[1] != "console" or "live" not in found[2]:
            continue
        for command in refresh.commands(found[3]):
            name, *arguments = shlex.split(command)[1:]
            assert program.commands[name].make_context(name, arguments).args == []


@pytest.mark.parametrize("page", PAGES, ids=identity)
def test_links_lead_somewhere(page):
    text = page.read_text()
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if target.startswith("https://"):
            continue
        name, _, heading = target.partition("#")
        path = (page.parent / name).resolve() if name else page
        assert path.is_file(), target
        if heading:
            headings = re.findall(r"^#+ (.*)$", path.read_text(), re.MULTILINE)
            assert heading in [re.sub(r"[^\w -]", "", item.lower()).replace(" ", "-") for item in headings]


@pytest.mark.parametrize("page", sorted((ROOT / "docs").rglob("*.md")), ids=identity)
def test_every_page_is_on_the_entry_page_and_leads_back(page):
    entry = ROOT / "docs/README.md"
    if page != entry:
        assert f"({page.relative_to(ROOT / 'docs')})" in entry.read_text()
        back = re.findall(r"\[All pages\]\((.*)\)\n$", page.read_text())
        assert [(page.parent / item).resolve() for item in back] == [entry]


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_a_page(name):
    assert f"$ edoras {name}" in (ROOT / f"docs/{name}.md").read_text()


def test_every_finding_is_in_the_table():
    page = (ROOT / "docs/findings.md").read_text()
    for finding in Finding:
        assert f"| `{finding.label}` | {EXPLANATIONS[finding].severity.label} |" in page
        assert f"| {int(finding)} | `{finding.label}` |" in page


def test_the_number_of_findings_is_right():
    assert f"- {len(Finding)} findings" in (ROOT / "CHANGELOG.md").read_text()


def test_every_layout_field_is_in_the_page_of_the_wire():
    from edoras_tools.wire import ccsds, cfe, envelope, sbn

    page = (ROOT / "docs/wire.md").read_text()
    layouts = [ccsds.PRIMARY, cfe.COMMAND, cfe.TELEMETRY, cfe.EXTENDED, cfe.EVENT, envelope.ENCAPSULATION]
    layouts += [cfe.SOFTWARE_BUS_HOUSEKEEPING, envelope.DEFAULT.layout]
    layouts += [sbn.HEADER, sbn.SUBSCRIPTIONS, sbn.SUBSCRIPTION, sbn.PROTO]
    for layout in layouts:
        for slot in layout.slots:
            assert f"| {slot.field.bits} | `{slot.field.name}` | {slot.field.doc}" in page


def test_the_table_of_json_has_every_schema():
    page = (ROOT / "docs/architecture.md").read_text()
    schemas = {path.name for path in (ROOT / "docs/schemas").iterdir()}
    assert set(re.findall(r"\(schemas/([\w.]+)\)", page)) == schemas


def test_every_folder_and_file_that_the_architecture_names_is_there():
    text = (ROOT / "docs/architecture.md").read_text()
    package = ROOT / "edoras_tools"
    folder = package
    for line in text.splitlines():
        if row := re.match(r"\| `([\w/]+)/` \|", line):
            folder = package / row[1]
            assert folder.is_dir(), line
        for name in re.findall(r"`((?:\w+/)*(?:\w+/|\w+\.py))`", line):
            assert any((place / name).exists() for place in (folder, package, ROOT)), name


def test_every_path_that_contributing_names_is_there():
    paths = re.findall(
        r"`((?:edoras_tools|tests|docs|samples)/[\w./]*)`", (ROOT / "CONTRIBUTING.md").read_text()
    )
    plain = [item for item in paths if not re.search(r"NAME|FOLDER|/[xy]", item)]
    assert len(plain) > 8
    assert [item for item in plain if not (ROOT / item).exists()] == []


@pytest.mark.long
def test_the_picture_of_the_folders_is_as_they_are(make_house):
    assert make_house.PICTURE.read_text() == make_house.picture()


@pytest.mark.parametrize("table", [PacketBatch, Columns])
def test_every_column_says_what_it_is(table):
    """The page of the architecture sends its readers there."""
    for name in table.__struct_fields__:
        assert f"        {name}: " in table.__doc__
