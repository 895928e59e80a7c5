"""Wireshark and tshark as they are installed: which, how old, with Lua or not, and their folders."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final

from edoras_tools.dissectors.lua import GUARD, own_digest
from edoras_tools.errors import CaptureError
from edoras_tools.pipelines.interrupt import on_interrupt

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

SCRIPT: Final = "edoras.lua"
LAUNCHER: Final = "edoras-extcap"
OLDEST: Final = (3, 6)
"""The oldest Wireshark whose Lua has all that the dissector uses."""
_READS: Final = frozenset({"pcap", "pcapng"})
_COMPRESSED: Final = ".zst"
"""What not every Wireshark reads."""


def program(*names: str) -> str:
    """Return the path of the first of some programs that is there and has Lua.

    Raises:
        CaptureError: none is there, or it is too old or without Lua.
    """
    found = next((path for path in map(shutil.which, names) if path), None)
    if found is None:
        raise CaptureError(
            f"{' or '.join(names)} is not installed; on Debian and Ubuntu: apt install {names[0]}"
        )
    told = _ask(found, "--version")
    version = re.search(r"(\d+)\.(\d+)\.\d+", told)
    if version is None:
        raise CaptureError(f"{found}: does not say its version; is it Wireshark's?")
    if (int(version[1]), int(version[2])) < OLDEST:
        raise CaptureError(
            f"{found}: version {version[0]} is too old; {OLDEST[0]}.{OLDEST[1]} or newer is needed"
        )
    if not re.search(r"with\s+Lua", told):
        raise CaptureError(
            f"{found}: version {version[0]} was built without Lua; install a build that has it"
        )
    return found


def folders() -> dict[str, Path]:
    """Return Wireshark's folders by what it calls them, as ``Personal Lua Plugins``.

    Raises:
        CaptureError: there is no Wireshark, or it is too old or without Lua.
    """
    lines = _ask(program("tshark", "wireshark"), "-G", "folders").splitlines()
    pairs = (line.partition(":") for line in lines)
    return {name.strip(): Path(path.strip()) for name, colon, path in pairs if colon and path.strip()}


def install(text: str, folder: Path | None = None) -> Path:
    """Put the dissector where Wireshark and tshark load it from; return its path.

    Args:
        text: the Lua.
        folder: another than the personal plugin folder.

    Raises:
        CaptureError: there is no Wireshark to ask, or the file cannot be written.
    """
    if folder is None:
        known = folders()
        folder = known.get("Personal Lua Plugins") or known.get("Personal Plugins")
    if folder is None:
        raise CaptureError("this Wireshark names no folder for plugins; name one with --to")
    return _write(folder / SCRIPT, text)


def install_extcap(folder: Path | None = None) -> Path:
    """Put the launcher of our capture interfaces where Wireshark looks for such; return its path.

    Args:
        folder: another than Wireshark's own.

    Raises:
        CaptureError: there is no Wireshark to ask, or the file cannot be written.
    """
    if folder is None:
        known = folders()
        folder = known.get("Personal Extcap path") or known.get("Extcap path")
    if folder is None:
        raise CaptureError("this Wireshark names no folder for extcap programs; name one with --to")
    text = f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m edoras_tools.cli.extcap "$@"\n'
    try:
        path = _write(folder / LAUNCHER, text)
        path.chmod(0o755)
    except CaptureError as error:
        raise CaptureError(f"{error}; as root, or with --to DIR and WIRESHARK_EXTCAP_DIR=DIR set") from error
    return path


def run(text: str, file: Path | None, arguments: Sequence[str], *, graphical: bool = False) -> int:
    """Run tshark or Wireshark with the dissector, whatever copy is installed; return its exit code.

    Args:
        text: the Lua.
        file: a capture or recording to read; None leaves the input to the arguments.
        arguments: for the program.
        graphical: Wireshark, not tshark.

    Raises:
        CaptureError: there is no such program, or the file cannot be read.
    """
    path = program("wireshark" if graphical else "tshark")
    with tempfile.TemporaryDirectory(prefix="edoras-") as name:
        folder = Path(name)
        script = _write(folder / SCRIPT, text)
        command = [path, "-X", f"lua_script:{script}"]
        with _readable(file, folder) as capture:
            command += ["-r", str(capture)] if capture else []
            environment = os.environ | {GUARD: own_digest(text)}
            # Ctrl-C reaches the program too, and it ends as it sees fit.
            with on_interrupt(lambda: None):
                return subprocess.run([*command, *arguments], env=environment, check=False).returncode  # noqa: S603  what was asked for


@contextmanager
def _readable(file: Path | None, folder: Path) -> Iterator[Path | None]:
    """Give a file as something that Wireshark reads: a recording is written out as pcapng."""
    if file is None or str(file) == "-":
        yield file
        return
    from edoras_tools.sinks.pcapng import PcapngSink
    from edoras_tools.sources import open_file

    with closing(open_file(file)) as source:
        if source.info.kind in _READS and file.suffix != _COMPRESSED:
            yield file
            return
        target = folder / f"{file.stem}.pcapng"
        with closing(PcapngSink(target)) as sink:
            for batch in source.batches():
                sink.write(batch)
    yield target


def _ask(path: str, *arguments: str) -> str:
    try:
        return subprocess.run(  # noqa: S603  a program of the user's own path
            [path, *arguments], capture_output=True, check=False, text=True, errors="replace", timeout=60
        ).stdout
    except (OSError, subprocess.TimeoutExpired) as error:
        raise CaptureError(f"{path}: cannot be run: {error}") from error


def _write(path: Path, text: str) -> Path:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, "utf-8")
    except OSError as error:
        raise CaptureError(f"{path}: cannot be written: {error.strerror or error}") from error
    return path
