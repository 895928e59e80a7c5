"""What the pages show is what happens: `python docs/refresh.py` after a change that is meant."""

from __future__ import annotations

import json
import re
import shlex
from dataclasses import fields
from pathlib import Path

import pytest

from edoras_tools.model import Columns, Finding, PacketBatch
from edoras_tools.render.severity import EXPLANATIONS
from edoras_tools.sinks.recover import Recovery

ROOT = Path(__file__).parents[2]
PAGES = sorted(
    [ROOT / "README.md", ROOT / "CHANGELOG.md", ROOT / "samples/README.md", *(ROOT / "docs").glob("*.md")],
    key=str,
)
REFRESHED = [page for page in PAGES if page.stem not in {"missions", "sim", "bench", "CHANGELOG"}]
COMMANDS = (
    *("sniff", "record", "info", "decode", "recover", "sim", "demo", "doctor", "report"),
    *("replay", "inject", "sweep", "proxy", "wireshark", "live", "bridge", "codegen", "structs"),
)


def identity(page):
    return str(page.relative_to(ROOT))


def without_sizes(text):
    """Compressed sizes are the compressor's, not ours."""
    return re.sub(r"\d+\.\d [KM]iB", "SIZE", text)


@pytest.mark.parametrize("page", REFRESHED, ids=identity)
def test_the_output_shown_is_the_output(page, refresh, tmp_path):
    assert without_sizes(refresh.refreshed(page, tmp_path)) == without_sizes(page.read_text())


def test_every_page_that_runs_is_refreshed(refresh):
    assert sorted(refresh.PAGES, key=str) == REFRESHED


@pytest.mark.parametrize("page", PAGES, ids=identity)
def test_options_of_live_commands_exist(page, refresh):
    """They need a network or a clock, so only their command lines are read."""
    import typer

    from edoras_tools.cli.main import program as made

    program = typer.main.get_command(made())
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


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_a_page_and_the_readme_links_it(name):
    assert f"(docs/{name}.md)" in (ROOT / "README.md").read_text()
    assert f"$ edoras {name}" in (ROOT / f"docs/{name}.md").read_text()


def test_every_finding_is_in_the_table():
    page = (ROOT / "docs/findings.md").read_text()
    for finding in Finding:
        assert f"| `{finding.label}` | {EXPLANATIONS[finding].severity.label} |" in page
        assert f"| {int(finding)} | `{finding.label}` |" in page


def test_the_number_of_findings_is_right():
    assert f"- {len(Finding)} findings" in (ROOT / "CHANGELOG.md").read_text()


def test_every_layout_field_is_in_the_page_of_the_wire():
    from edoras_tools.wire import ccsds, cdr, cfe, envelope, sbn

    page = (ROOT / "docs/wire.md").read_text()
    layouts = [ccsds.PRIMARY, cfe.COMMAND, cfe.TELEMETRY, cfe.EXTENDED, cfe.EVENT, cdr.ENCAPSULATION]
    layouts += [cfe.SOFTWARE_BUS_HOUSEKEEPING, envelope.DEFAULT.layout]
    layouts += [sbn.HEADER, sbn.SUBSCRIPTIONS, sbn.SUBSCRIPTION, sbn.PROTO]
    for layout in layouts:
        for slot in layout.slots:
            assert f"| {slot.field.bits} | `{slot.field.name}` | {slot.field.doc}" in page


def test_the_keys_of_json_are_those_that_are_printed():
    page = (ROOT / "docs/architecture.md").read_text()

    def keys(start):
        row = next(line for line in page.splitlines() if line.startswith(f"| {start}"))
        return set(re.findall(r"`(\w+)`", row.split("|")[2])) - {"record", "output"}

    expected = json.loads((ROOT / "samples/expected/a_rover.json").read_text())
    assert keys("`info --json`") == expected["info"].keys()
    assert keys("each of `routes`") == expected["info"]["routes"][0].keys()
    assert keys("`sniff --json`") == expected["packets"][0].keys()
    assert keys("`recover --json`") == {item.name for item in fields(Recovery)}


def test_every_column_is_in_the_page_of_the_architecture():
    page = (ROOT / "docs/architecture.md").read_text()
    for item in (*fields(PacketBatch), *fields(Columns)):
        assert f"| `{item.name}` | " in page
