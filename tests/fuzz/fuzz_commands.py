"""Whole commands are fuzzed: a capture of any kind through what a user types, to its lines and exit code."""

from __future__ import annotations

import io
import json
import os
import sys
import tempfile
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING
from unittest.mock import patch

from edoras_tools.cli import main

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable, Iterator

ROOT = Path(__file__).parents[2]
_C = [f"-c{ROOT}/samples/missions/two_rovers_{side}.yaml" for side in ("ground", "flight")]
_BEST = [f"-c{ROOT}/samples/missions/rover_ground.yaml"]
COMMANDS: list[list[str]] = [
    ["info", "FILE"],
    ["info", "--json", "FILE", *_C],
    ["info", "--verify", "FILE"],
    ["sniff", "-a", "-v", "FILE", *_BEST],
    ["sniff", "-V", "FILE", *_C],
    ["sniff", "-x", "FILE", *_BEST],
    ["sniff", "--json", "-a", "FILE", *_C],
    ["sniff", "--diagram", "mermaid", "FILE", *_BEST],
    ["sniff", "--where", "msg_size > 20 and not msg_id == 0x1827", "-t", "delta", "FILE"],
    ["decode", "FILE", "2", *_C],
    ["decode", "--json", "--frame", "FILE", "1", *_BEST],
    ["doctor", "-v", "FILE", *_C],
    ["doctor", "--json", "FILE", *_BEST],
    ["doctor", "--list-lost", "csv", "FILE", *_C],
    ["report", "FILE", "-o", "out.html", *_BEST],
    ["record", "FILE", "-o", "out.mcap", *_C],
    ["record", "FILE", "-o", "out.pcapng", "--start", "0.001"],
    ["record", "FILE", "-o", "out.pcap", "--json"],
    ["recover", "FILE", "-o", "out.bin", "--json", *_BEST],
    ["recover", "FILE", "-o", "out.bin", "--unproved"],
    ["export", "FILE", "-o", "out/", "--format", "csv", *_C],
    ["export", "FILE", "-o", "out.jsonl", "--topic", "/edoras/datagrams"],
    ["plot", "FILE", "-o", "out.svg", *_BEST],
    ["plot", "FILE", "/telemetry_pose.*", *_BEST],
    ["trace", "FILE", "1", *_BEST],
    ["trace", "FILE", "--topic", "/cmd_vel", "-o", "out.svg", *_BEST],
    ["hz", "FILE", "/telemetry_pose", *_BEST],
    ["compare", "FILE", str(ROOT / "samples/captures/f_sbn_disconnect.pcap"), *_BEST],
    ["check", "--init", "FILE", *_C],
    ["files", "FILE", "-o", "out", *_BEST],
    ["mission", "draft", "FILE"],
]
"""The first byte of an input chooses; ``FILE`` is the rest."""
CODES = {0, 1, 2, 3}
"""Exit codes that a command may have without a Ctrl-C."""


def commands(data: bytes) -> Hashable:
    """A command line: it ends with a code that is documented, says why in lines, and its JSON is JSON."""
    number = (data[0] if data else 0) % len(COMMANDS)
    words = COMMANDS[number]
    with tempfile.TemporaryDirectory() as folder, _standing_in(folder):
        path = Path("input.bin")
        path.write_bytes(data[1:])
        code, out, err = run([str(path) if word == "FILE" else word for word in words])
        assert path.read_bytes() == data[1:], "the input was changed"
        made = sorted(item.name for item in Path().iterdir() if item != path)
    assert code in CODES, f"exit code {code}"
    assert not any(name.startswith(".") or name.endswith((".part", ".tmp")) for name in made), made
    assert "out of memory" not in err, err
    assert "Traceback" not in err, err
    if code:
        assert code == 3 or err.strip(), f"exit code {code}, and no word why"
    if "--json" in words and code in {0, 3}:
        for line in out.splitlines() if words[0] == "sniff" else [out]:
            json.loads(line, parse_constant=_no_constant)
    for letter in err + ("" if "-x" in words else out.replace("\r\n", "\n")):
        assert letter.isprintable() or letter in "\n\t", f"{letter!r} is printed as it is"
    told = "".join(letter for letter in err.replace("input.bin", "")[:60] if not letter.isdigit())
    return number, code, told, tuple(made)


@contextmanager
def _standing_in(folder: str) -> Iterator[None]:
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def _no_constant(word: str) -> None:
    raise AssertionError(f"{word} is no JSON")


def run(words: list[str]) -> tuple[int, str, str]:
    """Run a command as ``edoras`` does; return its exit code, output and errors."""
    out, err = (io.TextIOWrapper(io.BytesIO(), "utf-8", newline="\n") for _ in range(2))
    before, sys.argv = sys.argv, ["edoras", *words]
    try:
        with patch.dict(os.environ, NO_COLOR="1", COLUMNS="100"), redirect_stdout(out), redirect_stderr(err):
            main.run(main.program(words[0]))
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 0 if end.code is None else 1
    finally:
        sys.argv = before
    for stream in (out, err):
        stream.flush()
    return code, *(stream.buffer.getvalue().decode() for stream in (out, err))


TARGETS: dict[str, Callable[[bytes], Hashable]] = {"commands": commands}


def seeds(folder: Path) -> list[bytes]:
    """Return the inputs that the targets of files begin with, each behind some of the commands."""
    kinds = ("capture", "doctor", "recover")
    files = [path.read_bytes() for kind in kinds for path in sorted((folder / kind).iterdir())]
    samples = [
        ROOT / f"samples/captures/{name}.pcap" for name in ("a_rover", "e_ci_errors", "f_sbn_disconnect")
    ]
    files += [path.read_bytes()[:size] for path in samples for size in (3_000, 30_000)]
    turns = 2 * max(len(COMMANDS), len(files))
    return [bytes([turn % len(COMMANDS)]) + files[turn % len(files)] for turn in range(turns)]
