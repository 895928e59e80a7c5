"""Our links as capture interfaces of Wireshark: what its extcap protocol asks for, and the capture itself.

Wireshark runs the launcher once for each question (``--extcap-interfaces``, ``--extcap-dlts``,
``--extcap-config``) and reads sentences of ``key {name=value}``; with ``--capture`` it reads pcapng from a
fifo.
"""

from __future__ import annotations

import select
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, BinaryIO, Final

import numpy as np

from edoras_tools import __version__
from edoras_tools.errors import CaptureError, ConfigError
from edoras_tools.model import Link
from edoras_tools.pipelines.interrupt import on_interrupt
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.sinks.pcapng import PcapngSink

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from edoras_tools.sources.device import DeviceSource

INTERFACES: Final = {"edoras-ci": Link.CI, "edoras-to": Link.TO, "edoras-sbn": Link.SBN}


_OPTIONS: Final = (
    ("interface", "Capture from", "selector", "Where the datagrams pass; needs the privilege to capture"),
    ("listen", "Or bind [HOST:]PORT", "string", "Be the receiver yourself; needs no privilege"),
    ("ports", "Further ports", "string", "UDP ports of this link besides the standard ones, as 5010,5011"),
    ("config", "Mission", "fileselect", "EDORAS bridge YAML, which names ports and addresses"),
)


@dataclass(frozen=True, slots=True)
class Wish:
    """What the user chose in Wireshark's dialogue.

    Attributes:
        link: whose datagrams.
        interface: where to capture them live.
        listen: UDP endpoints to bind instead, ``[HOST:]PORT``; Wireshark is then the receiver.
        configs: mission files, which name ports and addresses.
        ports: further UDP ports of the link.
    """

    link: Link
    interface: str = "any"
    listen: Sequence[str] = ()
    configs: Sequence[Path] = ()
    ports: Sequence[int] = ()


def interfaces() -> list[str]:
    """Return the answer to ``--extcap-interfaces``."""
    lines = [f"extcap {{version={__version__}}}{{display=EDORAS: CI, TO and SBN of a cFS}}"]
    return lines + [
        f"interface {{value={name}}}{{display=EDORAS {link.name}}}" for name, link in INTERFACES.items()
    ]


def link_of(interface: str) -> Link:
    """Return the link of an interface.

    Raises:
        ConfigError: there is no such interface.
    """
    if interface not in INTERFACES:
        raise ConfigError(f"{interface or 'no interface'}: there are {', '.join(INTERFACES)}")
    return INTERFACES[interface]


def link_types() -> list[str]:
    """Return the answer to ``--extcap-dlts``: what a bound socket gives; a live capture names its own."""
    return ["dlt {number=101}{name=RAW}{display=Raw IP}"]


def options() -> list[str]:
    """Return the answer to ``--extcap-config``."""
    from edoras_tools.sources.live import interfaces as live_interfaces

    lines = [
        f"arg {{number={number}}}{{call=--{name}}}{{display={display}}}{{type={kind}}}{{tooltip={tooltip}}}"
        for number, (name, display, kind, tooltip) in enumerate(_OPTIONS)
    ]
    lines += [
        f"value {{arg=0}}{{value={name}}}{{display={name}}}{{default={'true' if name == 'any' else 'false'}}}"
        for name in dict.fromkeys(("any", *live_interfaces()))
    ]
    return lines


def capture(wish: Wish, fifo: Path) -> None:
    """Write the link's datagrams as pcapng until the reader goes, SIGTERM or Ctrl-C.

    Args:
        wish: what to capture.
        fifo: where to write; opening it waits for the reader.

    Raises:
        ConfigError: the mission or an endpoint has mistakes.
        CaptureError: it cannot be captured, or the fifo cannot be opened.
    """
    settings = Settings(configs=wish.configs)
    decoding = replace(settings.options, ports=tuple((wish.link, port) for port in _ports(wish)))
    bench = replace(settings, options=decoding).workbench()
    context = bench.columns.context
    source = _source(wish, np.flatnonzero(context.port_links & (1 << wish.link)).tolist())
    try:
        with _opened(fifo) as file, on_interrupt(source.stop, patient=True):
            gone = _watch(file)
            sink = PcapngSink(file)
            sink.flush()
            for batch in source.batches():
                rows = np.flatnonzero(bench.columns.decode(batch).link == wish.link)
                if gone():
                    return
                if len(rows):
                    sink.write(batch.take(rows))
                    sink.flush()
    except (BrokenPipeError, CaptureError) as error:
        if isinstance(error.__cause__, BrokenPipeError) or isinstance(error, BrokenPipeError):
            return  # Wireshark has seen enough
        raise
    finally:
        source.close()


def _ports(wish: Wish) -> list[int]:
    """Return the ports that are named, those that are bound among them."""
    from edoras_tools.sources.udp import parse_endpoint

    return [*wish.ports, *(parse_endpoint(item).port for item in wish.listen)]


def _source(wish: Wish, ports: Sequence[int]) -> DeviceSource:
    if wish.listen:
        from edoras_tools.sources.udp import UdpSource, parse_endpoint

        return UdpSource([parse_endpoint(item) for item in wish.listen])
    from edoras_tools.sources.live import open_live

    return open_live(wish.interface, ports)


def _opened(fifo: Path) -> BinaryIO:
    try:
        return fifo.open("wb")
    except OSError as error:
        raise CaptureError(f"{fifo}: cannot be opened: {error.strerror}") from error


def _watch(file: BinaryIO) -> Callable[[], bool]:
    """Return what tells whether the reader of a pipe is gone, even while there is nothing to write."""
    poll = select.poll()
    poll.register(file.fileno(), 0)
    return lambda: any(event & select.POLLERR for _, event in poll.poll(0))
