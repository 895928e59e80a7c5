"""The installed Wireshark and tshark: path, version, whether they have Lua, and their folders."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from contextlib import closing, contextmanager
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Final

from edoras_tools.addons.wireshark.lua import dissector
from edoras_tools.dissectors.lua import GUARD, TITLE, own_digest
from edoras_tools.errors import CaptureError
from edoras_tools.io.formats.open import open_file
from edoras_tools.io.formats.pcapng import PcapngSink
from edoras_tools.io.outputs import write_files
from edoras_tools.pipelines.reading import on_interrupt

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from edoras_tools.model import PacketBatch
    from edoras_tools.pipelines.workbench import Settings

SCRIPT: Final = "edoras.lua"
LAUNCHER: Final = "edoras-extcap"
PROFILE: Final = "EDORAS"
_BY_WIRESHARK: Final = "recent"
"""File of a profile that Wireshark rewrites each time it ends."""
_NAMES: Final = {
    "plugins": ("Personal Lua Plugins", "Personal Plugins"),
    "extcap programs": ("Personal Extcap path", "Extcap path"),
    "profiles": ("Personal configuration",),
}
"""Wireshark's names for its folders, by their content."""
_PROFILE_FILES: Final = files("edoras_tools.addons.wireshark") / "profile"
_MODULE: Final = "edoras_tools.addons.wireshark.cli.extcap"
OLDEST: Final = (3, 6)
"""The oldest Wireshark with all Lua functions that the dissector uses."""
_READS: Final = frozenset({"pcap", "pcapng"})
_COMPRESSED: Final = ".zst"
"""Suffix of compressed files, which not every Wireshark can read."""
_DISPLAYS: Final = ("DISPLAY", "WAYLAND_DISPLAY")
_THEN_REMOVE: Final = '"$@"; code=$?; rm -rf "$0"; exit $code'
"""Shell script that deletes the files after Wireshark has ended, which may be after this process."""


def find_program(*names: str) -> str:
    """Return the path of the first installed one of some programs; it must have Lua.

    Raises:
        CaptureError: none is installed, or it is too old or without Lua.
    """
    program = next((path for path in map(shutil.which, names) if path), None)
    if program is None:
        raise CaptureError(
            f"{' or '.join(names)} is not installed; on Debian and Ubuntu: apt install {names[0]}"
        )
    _check(program, Path(program).stat().st_mtime_ns)
    return program


@cache
def _check(program: str, _changed_ns: int) -> None:
    """Check a program once; it runs for half a second to print its version."""
    output = _ask(program, "--version")
    version = re.search(r"(\d+)\.(\d+)\.\d+", output)
    if version is None:
        raise CaptureError(f"{program}: does not print its version; is it from Wireshark?")
    described = f"{program}: version {version[0]}"
    if (int(version[1]), int(version[2])) < OLDEST:
        raise CaptureError(f"{described} is too old; {OLDEST[0]}.{OLDEST[1]} or newer is needed")
    if not re.search(r"with\s+Lua", output):
        raise CaptureError(f"{described} was built without Lua; install a build that has it")


def folders() -> dict[str, Path]:
    """Return Wireshark's folders by its own names, e.g. ``Personal Lua Plugins``.

    Raises:
        CaptureError: Wireshark is not installed, too old, or without Lua.
    """
    lines = _ask(find_program("tshark", "wireshark"), "-G", "folders").splitlines()
    pairs = (line.partition(":") for line in lines)
    return {name.strip(): Path(path.strip()) for name, colon, path in pairs if colon and path.strip()}


def _own(by_name: Mapping[str, Path], noun: str) -> Path:
    """Return the first of Wireshark's folders for a kind of content; see ``_NAMES``."""
    for name in _NAMES[noun]:
        if name in by_name:
            return by_name[name]
    raise CaptureError(f"this Wireshark has no folder for {noun}; name one with --to")


def install(text: str, folder: Path | None = None, *, force: bool = False) -> Path:
    """Write the dissector to the folder from which Wireshark and tshark load it; return its path.

    Args:
        folder: folder to write to instead of the personal plugin folder.
        force: replace another dissector that is there.

    Raises:
        CaptureError: Wireshark is not installed, or the file cannot be written.
        ConfigError: another one is there.
    """
    folder = folder or _own(folders(), "plugins")
    return _write(folder / SCRIPT, text, force=force)


def install_profile() -> tuple[Path, bool]:
    """Write the profile ``EDORAS``: columns, colours, filter buttons and graphs; an existing one stays.

    Returns:
        its folder, and whether its content is ours.

    Raises:
        CaptureError: Wireshark is not installed, or a file cannot be written.
    """
    folder = _own(folders(), "profiles") / "profiles" / PROFILE
    if not folder.exists():
        written = {folder / item.name: item.read_bytes() for item in _PROFILE_FILES.iterdir()}
        write_files(written, force=False)
    return folder, _is_ours(folder)


def uninstall() -> Iterator[tuple[Path, bool]]:
    """Remove the dissector, the profile and the capture interfaces from Wireshark's personal folders.

    Yields:
        each path that exists, and whether it was removed: files and profiles that were changed are kept.

    Raises:
        CaptureError: Wireshark is not installed, or a file cannot be removed.
    """
    by_name = folders()
    script, launcher = _own(by_name, "plugins") / SCRIPT, _own(by_name, "extcap programs") / LAUNCHER
    folder = _own(by_name, "profiles") / "profiles" / PROFILE
    try:
        for path, mark in ((script, TITLE), (launcher, _MODULE)):
            if path.exists():
                if own := mark in path.read_text(encoding="utf-8", errors="replace"):
                    path.unlink()
                yield path, own
        if folder.exists():
            if own := _is_ours(folder):
                shutil.rmtree(folder)
            yield folder, own
    except OSError as error:
        raise CaptureError(f"{error.filename}: cannot be removed: {error.strerror}") from error


def _is_ours(folder: Path) -> bool:
    """Return whether a profile is unchanged, apart from the file that Wireshark itself rewrites."""
    ours, theirs = (
        {item.name: item.read_bytes() for item in place.iterdir() if item.is_file()}
        for place in (_PROFILE_FILES, folder)
    )
    return ours | {_BY_WIRESHARK: b""} == theirs | {_BY_WIRESHARK: b""}


def install_extcap(folder: Path | None = None, *, force: bool = False) -> Path:
    """Write the launcher of the capture interfaces to Wireshark's extcap folder; return its path.

    Args:
        folder: folder to write to instead of Wireshark's own.
        force: replace another launcher that is there.

    Raises:
        CaptureError: Wireshark is not installed, or the file cannot be written.
        ConfigError: another one is there.
    """
    folder = folder or _own(folders(), "extcap programs")
    text = f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m {_MODULE} "$@"\n'
    try:
        path = _write(folder / LAUNCHER, text, force=force)
        path.chmod(0o755)
    except CaptureError as error:
        raise CaptureError(f"{error}; be root, or use --to DIR and WIRESHARK_EXTCAP_DIR=DIR") from error
    return path


def run_program(text: str, file: Path | None, arguments: Sequence[str], *, graphical: bool = False) -> int:
    """Run tshark or Wireshark with this dissector, even if another one is installed; return its exit code.

    Args:
        file: a capture or recording to read; None: the arguments name the input.
        graphical: run Wireshark, not tshark.

    Raises:
        CaptureError: the program is not installed, or the file cannot be read.
    """
    path = find_program("wireshark" if graphical else "tshark")
    with tempfile.TemporaryDirectory(prefix="edoras-") as name:
        folder = Path(name)
        script = _write(folder / SCRIPT, text, force=False)
        command = [path, "-X", f"lua_script:{script}"]
        with _readable(file, folder) as capture:
            command += ["-r", str(capture)] if capture else []
            environment = os.environ | {GUARD: own_digest(text)}
            # Ctrl-C also reaches the program, which handles it itself.
            with on_interrupt(lambda: None):
                return subprocess.run([*command, *arguments], env=environment, check=False).returncode  # noqa: S603


def open_packets(batches: Iterable[PacketBatch], row: int, settings: Settings) -> subprocess.Popen[bytes]:
    """Write packets to a file and open Wireshark with the dissector on it.

    Args:
        row: the packet to go to, from 0.

    Returns:
        The process, which removes the file when Wireshark ends.

    Raises:
        EdorasError: Wireshark is not installed, there is no display, or the file cannot be written.
    """
    path = find_program("wireshark")
    if sys.platform not in {"darwin", "win32"} and not any(map(os.environ.get, _DISPLAYS)):
        raise CaptureError("Wireshark needs a display: set DISPLAY or WAYLAND_DISPLAY")
    text, _ = dissector(settings)
    folder = Path(tempfile.mkdtemp(prefix="edoras-"))
    try:
        script, capture = _write(folder / SCRIPT, text, force=False), folder / "packets.pcapng"
        _write_packets(batches, capture)
        arguments = ["-X", f"lua_script:{script}", "-r", str(capture), "-g", str(row + 1)]
        return subprocess.Popen(  # noqa: S603  the user asked for it
            ["/bin/sh", "-c", _THEN_REMOVE, str(folder), path, *arguments],
            env=os.environ | {GUARD: own_digest(text)},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
    except (OSError, CaptureError) as error:
        shutil.rmtree(folder, ignore_errors=True)
        raise CaptureError(f"Wireshark cannot be opened: {error}") from error


@contextmanager
def _readable(file: Path | None, folder: Path) -> Iterator[Path | None]:
    """Yield a file that Wireshark can read: a recording is first written as pcapng."""
    if file is None or str(file) == "-":
        yield file
        return

    with closing(open_file(file)) as source:
        if source.info.kind in _READS and file.suffix != _COMPRESSED:
            yield file
            return
        target = folder / f"{file.stem}.pcapng"
        _write_packets(source.batches(), target)
    yield target


def _write_packets(batches: Iterable[PacketBatch], path: Path) -> None:
    with closing(PcapngSink(path)) as sink:
        for batch in batches:
            sink.write(batch)


def _ask(path: str, *arguments: str) -> str:
    try:
        return subprocess.run(  # noqa: S603  a program of the user's own path
            [path, *arguments], capture_output=True, check=False, text=True, errors="replace", timeout=60
        ).stdout
    except (OSError, subprocess.TimeoutExpired) as error:
        raise CaptureError(f"{path}: cannot be run: {error}") from error


def _write(path: Path, text: str, *, force: bool) -> Path:
    write_files({path: text.encode()}, force=force)
    return path
