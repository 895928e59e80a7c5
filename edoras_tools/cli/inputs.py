"""The source that ``-r``, ``-i`` and ``--listen`` name."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from edoras_tools.errors import ConfigError, EdorasError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from edoras_tools.pipelines.workbench import Settings, Workbench
    from edoras_tools.sources import Source


def open_input(
    read: Sequence[Path] | None,
    interface: str | None,
    listen: Sequence[str] | None,
    settings: Settings,
    *,
    every_port: bool = False,
) -> tuple[Source, Workbench]:
    """Open the one input that was named, and set up the decoders for it.

    A live capture says on stderr when it is ready: no packet sent after that is missed.

    Args:
        read: files.
        interface: an interface.
        listen: UDP endpoints to bind.
        settings: missions, types and options.
        every_port: capture all UDP, not only the ports of the links.

    Raises:
        ConfigError: none or more than one was named, or the mission has mistakes.
        CaptureError: it cannot be opened.
    """
    if sum(map(bool, (read, interface, listen))) != 1:
        raise ConfigError("name one input: -r FILE (repeatable), -i IFACE, or --listen PORT")
    if read:
        from edoras_tools.pipelines.workbench import open_files

        source = open_files(read)
        try:
            return source, settings.workbench(source.info)
        except EdorasError:
            source.close()
            raise
    bench = settings.workbench()
    if interface:
        from edoras_tools.sources.live import open_live

        ports = () if every_port else bench.columns.context.capture_ports()
        return open_live(interface, ports, ready=lambda: _ready(interface)), bench
    from edoras_tools.sources.udp import UdpSource, parse_endpoint

    sockets = UdpSource(
        [parse_endpoint(item) for item in listen or ()], ready=lambda: _ready(sockets.info.name)
    )
    return sockets, bench


def _ready(name: str) -> None:
    sys.stderr.write(f"capturing on {name}; Ctrl-C ends\n")
    sys.stderr.flush()
