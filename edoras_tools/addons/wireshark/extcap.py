"""The links as capture interfaces of Wireshark: the answers of its extcap protocol, and the capture itself.

Wireshark runs the launcher once for each question (``--extcap-interfaces``, ``--extcap-dlts``,
``--extcap-config``) and reads lines of ``key {name=value}``; with ``--capture`` it reads pcapng from a
fifo.
"""

from __future__ import annotations

import select
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Final

import numpy as np
from msgspec.structs import replace

from edoras_tools import __version__
from edoras_tools.errors import CaptureError, ConfigError, os_errors
from edoras_tools.io.capture.device import interfaces as live_interfaces
from edoras_tools.io.capture.live import open_live
from edoras_tools.io.formats.pcapng import PcapngSink
from edoras_tools.io.net.buffer import UdpSource
from edoras_tools.io.net.sockets import parse_endpoint
from edoras_tools.links import table
from edoras_tools.pipelines.reading import reading
from edoras_tools.pipelines.selection import Selection
from edoras_tools.pipelines.workbench import Settings

if TYPE_CHECKING:
    from argparse import Namespace

    from edoras_tools.io.capture.device import DeviceSource
    from edoras_tools.model import Link

_NO_PORT: Final = 0
"""A port that nothing is sent to: with no port at all, a live capture would take every port."""
_OPTIONS: Final = (
    ("interface", "Capture from", "selector", "Interface with the traffic; needs the privilege to capture"),
    ("listen", "Or bind [HOST:]PORT", "string", "Receive the datagrams here; needs no privilege"),
    ("ports", "More ports", "string", "Ports of this link besides the standard ones, e.g. 5010,5011"),
    ("config", "Mission", "fileselect", "EDORAS bridge YAML, which names ports and addresses"),
)


def interfaces_answer() -> list[str]:
    """Return the answer to ``--extcap-interfaces``."""
    lines = [f"extcap {{version={__version__}}}{{display=EDORAS: the links of a cFS}}"]
    return lines + [
        f"interface {{value=edoras-{link.label}}}{{display=EDORAS {link.name}}}"
        for link in table.links()
        if any(link.transport.ports)
    ]


def interface_link(interface: str) -> Link:
    """Return the link of an interface.

    Raises:
        ConfigError: there is no such interface.
    """
    by_name: dict[str, Link] = {f"edoras-{link.label}": link for link in table.links()}
    if interface not in by_name:
        raise ConfigError(f"{interface or 'no interface'}: there are {', '.join(by_name)}")
    return by_name[interface]


def link_types() -> list[str]:
    """Return the answer to ``--extcap-dlts``: the link type of a bound socket; a live capture has its own."""
    return ["dlt {number=101}{name=RAW}{display=Raw IP}"]


def options() -> list[str]:
    """Return the answer to ``--extcap-config``."""
    lines = [
        f"arg {{number={number}}}{{call=--{name}}}{{display={display}}}{{type={kind}}}{{tooltip={tooltip}}}"
        for number, (name, display, kind, tooltip) in enumerate(_OPTIONS)
    ]
    lines += [
        f"value {{arg=0}}{{value={name}}}{{display={name}}}{{default={'true' if name == 'any' else 'false'}}}"
        for name in dict.fromkeys(("any", *live_interfaces()))
    ]
    return lines


def capture(link: Link, choices: Namespace) -> None:
    """Write the link's datagrams as pcapng until the reader closes the fifo, SIGTERM or Ctrl-C.

    Args:
        link: the link to capture.
        choices: the user's choices in Wireshark's dialogue, as text: ``interface`` of a live capture, UDP
            endpoints to ``listen`` at instead, more ``ports`` of the link, the mission file ``config``; and
            the ``fifo`` to write to, whose opening waits for the reader.

    Raises:
        ConfigError: the mission or an endpoint has errors.
        CaptureError: the capture or the fifo cannot be opened.
    """
    ports = [_port(word) for word in _words(choices.ports)]
    bound = [parse_endpoint(item, "--listen") for item in _words(choices.listen)]
    ports += [item.port for item in bound]
    settings = Settings(configs=[Path(choices.config)] if choices.config else [])
    decoding = replace(settings.options, ports=tuple((link, port) for port in ports))
    bench = replace(settings, options=decoding).workbench()
    context = bench.columns.context
    ports = np.flatnonzero(context.ports[link]).tolist()
    streams = np.flatnonzero(context.stream_links == link).tolist()
    source: DeviceSource = (
        UdpSource(bound) if bound else open_live(choices.interface, ports or [_NO_PORT], streams=streams)
    )
    try:
        # Wireshark also needs the handshake, which belongs to no link.
        selection = Selection(links=(link,)) if link.transport.udp else Selection()
        with _opened(choices.fifo) as file, reading(source, bench, selection, patient=True) as loop:
            reader_left = _watch(file)
            sink = PcapngSink(file)
            sink.flush()
            for rows in loop:
                if reader_left():
                    return
                if len(rows):
                    sink.write(*rows.alone())
                    sink.flush()
    except (BrokenPipeError, CaptureError) as error:
        if isinstance(error.__cause__, BrokenPipeError) or isinstance(error, BrokenPipeError):
            return  # Wireshark has closed the fifo
        raise
    finally:
        source.close()


def _words(text: str) -> list[str]:
    return [word.strip() for word in text.split(",") if word.strip()]


def _port(text: str) -> int:
    if not text.isdigit() or not 0 < int(text) < 65536:
        raise ConfigError(f"--ports {text}: not a UDP port from 1 to 65535")
    return int(text)


def _opened(fifo: Path) -> BinaryIO:
    with os_errors(f"{fifo}: cannot be opened"):
        return fifo.open("wb")


def _watch(file: BinaryIO) -> Callable[[], bool]:
    """Return a function that returns whether a pipe's reader has gone, even while nothing is written."""
    poll = select.poll()
    poll.register(file.fileno(), 0)
    return lambda: any(event & select.POLLERR for _, event in poll.poll(0))
