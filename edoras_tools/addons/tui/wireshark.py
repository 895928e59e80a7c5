"""Opens the packets of the list in Wireshark, at the selected packet."""

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
from edoras_tools.io.formats.pcapng.writer import PcapngSink
from edoras_tools.io.outputs import write_bytes
from edoras_tools.pipelines.wireshark.lua import dissector
from edoras_tools.pipelines.wireshark.program import SCRIPT, find_program

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.addons.tui.data.store import Part
    from edoras_tools.pipelines.workbench import Settings

_THEN_REMOVE: Final = '"$@"; rm -rf "$0"'
"""A shell script: Wireshark may run longer than this process, and needs its files until it ends."""


def open_in_wireshark(parts: Sequence[Part], row: int, settings: Settings) -> subprocess.Popen[bytes]:
    """Write packets to a file and open Wireshark with our dissector on it.

    Args:
        parts: what ``Store.parts`` returned.
        row: the packet to go to.

    Returns:
        The process, which removes the file when Wireshark ends.

    Raises:
        EdorasError: Wireshark is not installed, or the file cannot be written.
    """
    path = find_program("wireshark")
    text, _ = dissector(settings)
    folder = Path(tempfile.mkdtemp(prefix="edoras-"))
    try:
        script, capture = folder / SCRIPT, folder / "packets.pcapng"
        write_bytes(script, text.encode())
        with closing(PcapngSink(capture)) as sink:
            for block, _, shown in parts:
                sink.write(block.batch if isinstance(shown, range) else block.batch.take(np.asarray(shown)))
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
        rmtree(folder, ignore_errors=True)
        raise CaptureError(f"Wireshark cannot be opened: {error}") from error
