"""The program that Wireshark runs for ``EDORAS CI``, ``TO`` and ``SBN``; not meant for users."""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from edoras_tools.errors import ConfigError, EdorasError
from edoras_tools.io.outputs import ENDING

if TYPE_CHECKING:
    from types import FrameType


def main(arguments: Sequence[str] | None = None) -> int:
    """Answer a request of Wireshark, or capture; return the exit code."""
    parser = argparse.ArgumentParser(prog="edoras-extcap", description=__doc__, allow_abbrev=False)
    for name in ("interfaces", "dlts", "config"):
        parser.add_argument(f"--extcap-{name}", action="store_true")
    parser.add_argument("--capture", action="store_true")
    parser.add_argument("--fifo", type=Path)
    parser.add_argument("--interface", default="any")
    for name in ("extcap-interface", "listen", "ports", "config"):
        parser.add_argument(f"--{name}", default="")
    request, _ = parser.parse_known_args(arguments)  # newer versions of Wireshark pass more options
    if request.capture:  # until datagrams are read, the process can end at once without losing anything
        for number in ENDING:
            signal.signal(number, _end)
    try:
        for line in _answer(request):
            sys.stdout.write(f"{line}\n")
    except EdorasError as error:
        sys.stderr.write(f"edoras: {error}\n")
        return error.exit_code
    return 0


def _answer(request: argparse.Namespace) -> list[str]:
    from edoras_tools.addons.wireshark import extcap

    if request.extcap_interfaces:
        return extcap.interfaces_answer()
    link = extcap.interface_link(request.extcap_interface)
    if request.extcap_dlts:
        return extcap.link_types()
    if request.extcap_config:
        return extcap.options()
    if not request.capture or request.fifo is None:
        raise ConfigError(
            "this program is for Wireshark; to capture on the command line: edoras sniff -i IFACE"
        )
    extcap.capture(link, request)
    return []


def _end(_signal: int, _frame: FrameType | None) -> None:
    os._exit(0)


if __name__ == "__main__":
    sys.exit(main())
