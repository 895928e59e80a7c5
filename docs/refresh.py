"""Runs every command and program that the pages show, and writes what comes out under it.

    python docs/refresh.py [PAGE ...]

``tests/docs`` does the same in memory and compares, so that no page says what is not so. In a page,

* ``console`` blocks are run, their commands one after the other in one folder for the whole page, 100 columns
  wide; ``head=N`` and ``tail=N`` behind the word keep that many lines of each output;
* ``console live`` blocks need a network, or a clock: they were run by hand, only their options are checked;
* ``python run`` blocks are run, those of a page as one program, and what they print goes into the ``text``
  block that follows;
* regions between ``<!-- table: NAME -->`` and ``<!-- end -->`` are written from the code's own tables.
"""  # noqa: INP001  a script beside the pages, no package

from __future__ import annotations

import contextlib
import functools
import io
import json
import os
import re
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

ROOT: Final = Path(__file__).resolve().parents[1]
PAGES: Final = (
    ROOT / "README.md",
    ROOT / "samples/README.md",
    *(
        path
        for path in sorted((ROOT / "docs").glob("*.md"))
        if path.stem not in {"sim", "bench"}  # these have tests of their own
    ),
)
WIDTH: Final = 100
_CAPTURES: Final = (
    ("a_rover", "rover_ground"),
    ("b_arm_single", "single_arm_ground"),
    ("f_sbn_disconnect", "two_rovers_ground", "two_rovers_flight"),
)
"""Captures of links that work, with their missions."""
FENCED: Final = re.compile(r"^```(\w+)([^\n]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_REGION: Final = re.compile(r"(<!-- table: ([\w.]+) -->\n).*?(<!-- end -->)", re.DOTALL)


def shell(command: str) -> tuple[int, str]:
    """Run a command line; return its exit code, and both its outputs as one."""
    done = subprocess.run(  # noqa: S602  the pages' own commands
        command, shell=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
    )
    return done.returncode, done.stdout


def refreshed(page: Path, folder: Path, run: Callable[[str], tuple[int, str]] = shell) -> str:
    """Return a page with every output as it is today.

    Args:
        page: a Markdown file.
        folder: empty; commands run in it, and find the repository's ``samples`` and ``tests`` there.
        run: as ``shell``.
    """
    for name in ("samples", "tests"):
        (folder / name).symlink_to(ROOT / name, target_is_directory=True)
    with _inside(folder):
        runner = _Runner(run)
        text = FENCED.sub(runner.block, page.read_text(encoding="utf-8"))
    return _REGION.sub(lambda found: found[1] + TABLES[found[2]]() + found[3], text)


def commands(block: str) -> Iterator[str]:
    """Yield the commands of a console block, continued lines joined."""
    for found in re.finditer(r"^\$ ((?:.*\\\n)*.*)$", block, re.MULTILINE):
        yield found[1].replace("\\\n", " ")


class _Runner:
    """Runs the blocks of a page in order; knows the last exit code and what the last program printed."""

    def __init__(self, run: Callable[[str], tuple[int, str]]) -> None:
        self._call = run
        self._code = 0
        self._printed: str | None = None
        self._names: dict[str, object] = {"__name__": "page"}

    def block(self, found: re.Match[str]) -> str:
        language, words, body = found[1], found[2].split(), found[3]
        if language == "console" and "live" not in words:
            body = self._console(body, dict(word.split("=") for word in words))
        elif language == "python" and "run" in words:
            self._printed = self._program(body)
        elif language == "text" and self._printed is not None:
            body, self._printed = self._printed, None
        return f"```{language}{found[2]}\n{body}```"

    def _console(self, body: str, cut: dict[str, str]) -> str:
        out = []
        for part in re.findall(r"^\$ (?:.*\\\n)*.*\n", body, re.MULTILINE):
            command = next(commands(part))
            lines = [line.rstrip() for line in self._run(command).splitlines()]
            head, tail = int(cut.get("head", 0)), int(cut.get("tail", 0))
            if (head or tail) and len(lines) > head + tail + 1:
                lines = [*lines[:head], "...", *lines[len(lines) - tail :]]
            out += [part, *(f"{line}\n" for line in lines)]
        return "".join(out)

    def _run(self, command: str) -> str:
        if command == "echo $?":
            return f"{self._code}\n"
        self._code, told = self._call(command)
        return told

    def _program(self, code: str) -> str:
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(code, "page", "exec"), self._names)  # noqa: S102  the pages' own programs
        return printed.getvalue()


@contextlib.contextmanager
def _inside(folder: Path) -> Iterator[None]:
    """Be in a folder, in a terminal without colour, with the commands of this environment first."""
    here, environ = Path.cwd(), os.environ.copy()
    for name in ("FORCE_COLOR", "TERMINAL_WIDTH"):
        os.environ.pop(name, None)
    os.environ["COLUMNS"] = str(WIDTH)
    os.environ["PYTHONUNBUFFERED"] = "1"  # what is said on both outputs stays in order
    os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{environ.get('PATH', '')}"
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(here)
        os.environ.clear()
        os.environ.update(environ)


def _findings() -> str:
    """Return every finding, the gravest first, with its bit as recorded."""
    from edoras_tools.render.severity import EXPLANATIONS

    rows = sorted(EXPLANATIONS.items(), key=lambda item: (-item[1].severity, item[0]))
    head = "| bit | value | finding | severity | in the list | what it is, and what the receiver does |"
    lines = [head, "|---|---|---|---|---|---|"]
    lines += [
        f"| {finding.bit_length() - 1} | {int(finding)} | `{finding.label}` | {told.severity.label} | "
        f"{told.severity.mark} {told.short} | {told.meaning} |"
        for finding, told in rows
    ]
    return "\n".join(lines) + "\n"


def _truth() -> str:
    """Return what was sent to a running cFS, what it did, and the findings that say so."""
    rows = json.loads((ROOT / "samples/expected/truth.json").read_text(encoding="utf-8"))
    lines = ["| capture | packet | what was sent | what the flight did | findings |", "|---|---|---|---|---|"]
    for row in rows:
        findings = ", ".join(f"`{label}`" for label in row["findings"]) or "none"
        lines.append(f"| {row['capture']} | {row['number']} | {row['sent']} | {row['flight']} | {findings} |")
    return "\n".join(lines) + "\n"


def _sizes() -> str:
    """Return the sizes of the messages in the sample captures."""
    from edoras_tools.pipelines.workbench import Settings, open_files
    from edoras_tools.render.severity import NOTABLE

    sizes = set()
    for capture, *missions in _CAPTURES:
        bench = Settings([ROOT / f"samples/missions/{name}.yaml" for name in missions]).workbench()
        for batch in open_files([ROOT / f"samples/captures/{capture}.pcap"]).batches():
            for row in range(len(batch)):
                found = bench.dissector.dissect(batch[row])
                if found.layer("edoras") and found.message and not found.findings & NOTABLE:
                    kind = "command" if found.layer("cfe_command") else "telemetry"
                    padding = found.layer("padding")
                    packet = len(found.datagram.payload) - found.layer("ccsds").start
                    spare = padding.end - padding.start if padding else 0
                    sizes.add((found.message.type, len(found.message.cdr), kind, packet, spare))
    rows = [f"| {' | '.join(str(cell) for cell in row)} |" for row in sorted(sizes)]
    head = ["| type | CDR | sent as | space packet | of it padding |", "|---|---|---|---|---|"]
    return "\n".join(head + rows) + "\n"


_OF_ADDONS: Final = {"cfdp", "fprime"}
"""Links whose headers are in their add-on; those of the others are in ``wire``."""


def _layout(path: str) -> Callable[[], str]:
    """Return a function that writes the fields of a ``Layout`` as a table."""

    def table() -> str:
        from importlib import import_module

        module, _, name = path.rpartition(".")
        place = f"addons.{module}.link" if module in _OF_ADDONS else f"wire.{module}"
        layout = getattr(import_module(f"edoras_tools.{place}"), name)
        if name == "DEFAULT":
            layout = layout.layout
        lines = ["| byte | bits | field | what |", "|---|---|---|---|"]
        for slot in layout.slots:
            last = slot.end - 1
            place = f"{slot.start}" if last == slot.start else f"{slot.start}-{last}"
            names = ", ".join(
                f"{slot.field.text(value).partition(' (')[2].rstrip(')')} {name}"
                for value, name in slot.field.names.items()
            )
            doc = f"{slot.field.doc}: {names}" if names else slot.field.doc
            clause = f" ({slot.field.clause})" if slot.field.clause else ""
            lines.append(f"| {place} | {slot.field.bits} | `{slot.field.name}` | {doc}{clause} |")
        return "\n".join(lines) + "\n"

    return table


def _keys() -> str:
    """Return the keys of the three-pane view."""
    from edoras_tools.addons.tui.panes import KEYS

    lines = ["| keys | what |", "|---|---|"]
    for head, *keys in KEYS:
        lines.append(f"| **{head}** | |")
        lines += [f"| {' '.join(f'`{name}`' for name in names.split())} | {what} |" for names, what in keys]
    return "\n".join(lines) + "\n"


def _sbn_states() -> str:
    """Return the states of an SBN connection as a diagram."""
    from edoras_tools.sessions.sbn import TRANSITIONS, ConnectionState

    lines = [f"[*] --> {next(iter(ConnectionState)).value}"]
    lines += [
        f"{before.value} --> {after.value}: {trigger.value}"
        for (before, trigger), after in TRANSITIONS.items()
    ]
    return "\n".join(["```mermaid", "stateDiagram-v2", *(f"    {line}" for line in lines), "```\n"])


_PORTS: Final = {"n10_uplink_loss": 5234}
"""Where CI is not at its usual port."""


@functools.cache
def _balances() -> dict[str, Any]:
    """Return the diagnosis of every capture of the tests, as JSON, by the capture's name."""
    from edoras_tools.decode import Options
    from edoras_tools.diagnosis.examination import Examination
    from edoras_tools.io.formats.open import open_file
    from edoras_tools.links.bare import CI
    from edoras_tools.pipelines.workbench import Settings

    found = {}
    for path in sorted((ROOT / "tests/captures").glob("*.pcap.zst")):
        name = path.name.partition(".")[0]
        ports = ((CI, _PORTS[name]),) if name in _PORTS else ()
        bench = Settings(configs=[], options=Options(ports=ports)).workbench()
        examination = Examination(bench.columns.context)
        for batch in open_file(path).batches():
            examination.add(batch, bench.columns.decode(batch))
        found[name] = examination.diagnose().as_json()
    return found


def _marks() -> str:
    """Return what was noted of every capture when it was made, beside the sums of its balance."""
    from edoras_tools.render.doctor import causes

    text = (ROOT / "tests/captures/README.md").read_text(encoding="utf-8")
    noted = {cells[1]: cells[-2] for line in text.splitlines() if len(cells := re.split(r" *\| *", line)) > 4}
    both = next((told for name, told in noted.items() if name.startswith("n12")), "")
    lines = ["| capture | what happened | lost | by | superseded | unaccounted |", "|---" * 6 + "|"]
    for name, told in _balances().items():
        by: Counter[str] = Counter()
        for row in told["balance"]:
            by.update(row["lost_by"])
        figures = (
            f"{told['lost']:,} | {causes({'lost_by': by})} | {told['superseded']:,} | {told['unaccounted']:,}"
        )
        lines.append(f"| {name} | {noted.get(name, both)} | {figures} |")
    return "\n".join(lines) + "\n"


def _balance() -> str:
    """Return the balance of every capture of the tests, MsgIds together: hops where something is missing."""
    figures = ("in", "duplicated", "out", "lost", "superseded", "waiting", "not_captured", "unaccounted")
    heads = ("capture", "hop", "MsgIds", *(figure.replace("_", " ") for figure in figures))
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for name, found in _balances().items():
        hops: dict[str, list[dict[str, Any]]] = {}
        for row in found["balance"]:
            if row["in"] != row["out"]:
                hops.setdefault(row["hop"], []).append(row)
        for hop, rows in hops.items():
            sums = [sum(row[figure] for row in rows) for figure in figures]
            told = " | ".join(f"{number:,}" if number else "" for number in sums)
            lines.append(f"| {name} | {hop} | {len(rows)} | {told} |")
    return "\n".join(lines) + "\n"


def _index() -> str:
    """Return the tables of an archive's index, a line each."""
    from edoras_tools.addons.archive import index

    lines = []
    for table in index.TABLES.values():
        columns = [f"`{item.name}` ({item.kind}) {item.description}" for item in table.columns[1:]]
        lines.append(f"- **`{table.name}`**, {table.description}: {'; '.join(columns)}")
    return "\n".join([*lines, ""])


TABLES: Final[dict[str, Callable[[], str]]] = {
    "index": _index,
    "balance": _balance,
    "marks": _marks,
    "findings": _findings,
    "truth": _truth,
    "sizes": _sizes,
    "tui.KEYS": _keys,
    "sbn.states": _sbn_states,
    **{
        name: _layout(name)
        for name in (
            "ccsds.PRIMARY",
            "cfe.COMMAND",
            "cfe.TELEMETRY",
            "cfe.EXTENDED",
            "cfe.EVENT",
            "cfe.SOFTWARE_BUS_HOUSEKEEPING",
            "sbn.HEADER",
            "sbn.SUBSCRIPTIONS",
            "sbn.SUBSCRIPTION",
            "sbn.PROTO",
            "envelope.DEFAULT",
            "envelope.ENCAPSULATION",
            "fprime.FRAME",
            "fprime.PACKET",
        )
    },
}
"""The regions that are written from the code, by name."""


def chosen(names: Sequence[str]) -> Sequence[Path]:
    """Return the pages of these names, relative to here; all of them if there is no name.

    Raises:
        SystemExit: one is no page with output.
    """
    named = [Path(name).resolve() for name in names]
    for name, page in zip(names, named, strict=True):
        if page not in PAGES:
            raise SystemExit(f"{name}: not a page with output; name e.g. docs/info.md, or nothing for all")
    return named or PAGES


def main() -> None:
    """Rewrite the pages that the command line names, or all."""
    for page in chosen(sys.argv[1:]):
        with tempfile.TemporaryDirectory() as folder:
            text = refreshed(page, Path(folder))
        if text != page.read_text(encoding="utf-8"):
            page.write_text(text, encoding="utf-8")
            sys.stdout.write(f"{page.relative_to(ROOT)} rewritten\n")


if __name__ == "__main__":
    main()
