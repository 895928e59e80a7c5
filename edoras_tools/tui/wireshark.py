"""The packets of the list in Wireshark, at the same one."""

from __future__ import annotations

import os
import subprocess
import tempfile
from contextlib import closing
from pathlib import Path
from shutil import rmtree
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.dissectors.lua import GUARD, own_digest
from edoras_tools.errors import CaptureError
from edoras_tools.pipelines.wireshark import dissector
from edoras_tools.pipelines.wireshark_program import SCRIPT, program
from edoras_tools.sinks.pcapng import PcapngSink

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.pipelines.workbench import Settings
    from edoras_tools.tui.store import Part

_THEN_TIDY: Final = '"$@"; rm -rf "$0"'
"""Wireshark may outlive us, and needs its files until it ends."""


def open_in_wireshark(parts: Sequence[Part], row: int, settings: Settings) -> subprocess.Popen[bytes]:
    """Write packets to a file and open Wireshark with our dissector on it.

    Args:
        parts: what ``Store.parts`` returned.
        row: the packet to go to.
        settings: missions and options, for the dissector.

    Returns:
        The process, which removes the file when Wireshark ends.

    Raises:
        EdorasError: there is no Wireshark, or the file cannot be written.
    """
    path = program("wireshark")
    text, _ = dissector(settings)
    folder = Path(tempfile.mkdtemp(prefix="edoras-"))
    try:
        script, capture = folder / SCRIPT, folder / "packets.pcapng"
        script.write_text(text, "utf-8")
        with closing(PcapngSink(capture)) as sink:
            for block, _, shown in parts:
                sink.write(block.batch if isinstance(shown, range) else block.batch.take(np.asarray(shown)))
        arguments = ["-X", f"lua_script:{script}", "-r", str(capture), "-g", str(row + 1)]
        return subprocess.Popen(  # noqa: S603  what was asked for
            ["/bin/sh", "-c", _THEN_TIDY, str(folder), path, *arguments],
            env=os.environ | {GUARD: own_digest(text)},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
    except (OSError, CaptureError) as error:
        rmtree(folder, ignore_errors=True)
        raise CaptureError(f"Wireshark cannot be opened: {error}") from error
