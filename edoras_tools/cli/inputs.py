"""The source that ``-r``, ``-i`` and ``--listen`` name."""

from __future__ import annotations

import os
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, NamedTuple

from typer import Argument, Option

from edoras_tools.cli.options import headed
from edoras_tools.cli.output import tell
from edoras_tools.errors import ConfigError, NoDatagramsError, OnFailure
from edoras_tools.io.formats.table import READ_PACKED

if TYPE_CHECKING:
    from edoras_tools.io import Source
    from edoras_tools.model import InterfaceOutage
    from edoras_tools.pipelines.workbench import Settings, Workbench
    from edoras_tools.render.terminal.text import Progress


_WAIT: Final = "wait:"


@headed("Live traffic")
class LiveOptions(NamedTuple):
    """Live traffic: packets on an interface, or datagrams sent to a port."""

    interface: Annotated[
        str | None,
        Option("--interface", "-i", metavar="IFACE", help="Capture here; wait:IFACE waits until it is up."),
    ] = None
    listen: Annotated[
        list[str] | None,
        Option(metavar="[HOST:]PORT", help="Receive on a UDP port; of loopback unless HOST is given."),
    ] = None
    wait_interface: Annotated[bool, Option("--wait-interface", hidden=True)] = False
    user: Annotated[str | None, Option(help="Run as this user once the capture is open.")] = None


class FileOptions(NamedTuple):
    """Files to read, with or without ``-r``; several are merged in time order."""

    files: Annotated[
        list[Path] | None,
        Argument(metavar="[FILE]...", readable=False, help=f"{READ_PACKED}; - is stdin; several are merged."),
    ] = None
    read: Annotated[list[Path] | None, Option("--read", "-r", hidden=True)] = None

    @property
    def paths(self) -> list[Path]:
        """All paths."""
        return [*(self.read or ()), *(self.files or ())]

    def required(self) -> list[Path]:
        """Return all paths, at least one.

        Raises:
            ConfigError: there is no path.
        """
        if not self.paths:
            raise ConfigError("name the input to read: FILE...")
        return self.paths


class InputOptions(NamedTuple):
    """Files, or live traffic."""

    files: FileOptions = FileOptions()
    live: LiveOptions = LiveOptions()

    @property
    def paths(self) -> list[Path]:
        """The files."""
        return self.files.paths


def open_input(
    inputs: InputOptions,
    settings: Settings,
    *,
    every_port: bool = False,
    aligned: bool = False,
    messages: bool = False,
    output: Path | None = None,
    progress: Progress | None = None,
) -> tuple[Source, Workbench]:
    """Open the one input that was named, and set up the decoders for it.

    A live capture prints a line on stderr when it is ready: packets sent after that are not missed.

    Args:
        every_port: capture all UDP, not only the ports of the links.
        aligned: align the clocks of several files by their content, and keep datagrams that several files
            captured only once.
        messages: whether recordings without datagrams are accepted; the workbench's mission then has their
            topics.
        output: file that will be written, perhaps as another user.
        progress: shows the progress while clocks are aligned.

    Raises:
        ConfigError: none or more than one was named, or the mission has mistakes.
        CaptureError: it cannot be opened.
    """
    read, (interface, listen, waits, user) = inputs.paths, inputs.live
    if sum(map(bool, (read, interface, listen))) != 1:
        raise ConfigError("name one input: FILE..., -i IFACE, or --listen PORT")
    if waits and not interface:
        raise ConfigError("--wait-interface can only be used with -i IFACE")
    if read and user:
        raise ConfigError("--user can only be used with live traffic; files are read as the current user")
    if read:
        return _open_files(read, settings, aligned=aligned, messages=messages, progress=progress)
    bench = settings.workbench()
    if user:
        return _as_user(user, inputs.live._replace(user=None), bench, every_port=every_port, output=output)
    return _opened(inputs.live, bench, every_port=every_port), bench


def _open_files(
    read: list[Path], settings: Settings, *, aligned: bool, messages: bool, progress: Progress | None
) -> tuple[Source, Workbench]:
    """Open files as one source; see ``open_input``."""
    from edoras_tools.io.formats.open import is_cfe_file
    from edoras_tools.pipelines.workbench import open_files

    notes: list[str] = []
    cfe_files = [path for path in read if is_cfe_file(path)]
    read = [path for path in read if path not in cfe_files]
    if not aligned:
        read += cfe_files  # clocks are aligned to that of the first
    elif cfe_files:
        why = "no link carried its packets, so nothing is judged by them; sniff shows them"
        if not read:
            raise ConfigError(f"{cfe_files[0]}: {why}")
        notes = [f"{path}: {why}" for path in cfe_files]
    try:
        if (aligned or cfe_files) and len(read) > 1 and "-" not in map(str, read):
            from edoras_tools.pipelines.clocks import open_aligned

            source, clock_notes = open_aligned(read, settings, progress)
            notes += clock_notes
        else:
            source = open_files(read)
    except NoDatagramsError as error:
        if not messages:
            raise
        from edoras_tools.pipelines.messages import open_messages

        return open_messages(read, settings, error)
    with OnFailure(source.close):
        bench = settings.workbench(source.info, read)
    bench.columns.context.notes += notes
    return source, bench


def _as_user(
    name: str, live: LiveOptions, bench: Workbench, *, every_port: bool, output: Path | None
) -> tuple[Source, Workbench]:
    """Open live traffic, then change the user; first check that this user can write the output."""
    from edoras_tools.io import privileges

    user = privileges.find_user(name)
    privileges.check_readable(user, Path(os.__file__), Path(__file__))
    if output is not None:
        privileges.check_writable(user, output.absolute().parent)
    privileges.forbid_new_privileges()  # before the capture's threads are started
    source = _opened(live, bench, every_port=every_port)
    with OnFailure(source.close):
        privileges.become(user)
    return source, bench


def _opened(live: LiveOptions, bench: Workbench, *, every_port: bool) -> Source:
    """Open live traffic."""
    interface, listen, waits, _ = live
    if interface:
        waits, interface = waits or interface.startswith(_WAIT), interface.removeprefix(_WAIT)
        from edoras_tools.io.capture.live import open_live

        context = bench.columns.context
        ports = () if every_port else context.capture_ports()
        ready = partial(_ready, interface)
        begins = () if every_port else context.capture_begins()
        streams = context.framings
        return open_live(
            interface, ports, streams=streams, begins=begins, ready=ready, on_outage=_tell, wait=waits
        )
    from edoras_tools.cli.output import tell_reach
    from edoras_tools.io.net.buffer import UdpSource
    from edoras_tools.io.net.sockets import parse_endpoint

    sockets = UdpSource(
        [parse_endpoint(item, "--listen") for item in listen or ()], ready=lambda: _ready(sockets.info.name)
    )
    bench.columns.context.described["listened"] = " ".join(str(item.port) for item in sockets.endpoints)
    for endpoint in sockets.endpoints:
        tell_reach(endpoint, "send datagrams that count as captured")
    return sockets


def _tell(outage: InterfaceOutage) -> None:
    from edoras_tools.render.capture.host import outage_news

    tell(outage_news(outage))


def _ready(name: str) -> None:
    sys.stderr.write(f"capturing on {name}; Ctrl-C ends\n")
    sys.stderr.flush()
