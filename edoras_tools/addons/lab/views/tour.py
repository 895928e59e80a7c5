"""The output of ``edoras demo``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TextIO

from edoras_tools.decode.lines import line_of
from edoras_tools.render.capture import tree
from edoras_tools.render.capture.info import capture_summary
from edoras_tools.render.capture.packet_list import PacketList
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.terminal import Terminal, output_console

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from edoras_tools.model import Decoded


class Guide:
    """Prints the tour while it runs.

    Args:
        out: output stream.
    """

    def __init__(self, out: TextIO, terminal: Terminal) -> None:
        self._out = out
        self._terminal = terminal
        self._paint = palette.Paint(terminal.colour)
        self._list = PacketList(terminal.width, colour=terminal.colour)
        self._seen: set[tuple[object, ...]] = set()
        self._command: Decoded | None = None

    def begin(self, seconds: float, folder: Path) -> None:
        """Print the introduction: how long the link runs, and where its files will be."""
        self._title(
            1, f"A live link, {seconds:g} s of it: emulated cFS, two rovers, both bridges; one of each kind"
        )
        rovers = f"{folder}/missions/two_rovers"
        self._say(f"$ edoras sniff -i lo -c {rovers}_ground.yaml -c {rovers}_flight.yaml")
        self._line(self._list.header())

    def notice(self, text: str) -> None:
        """Print a note on this machine."""
        self._say(text)

    def packet(self, decoded: Decoded) -> None:
        """Print the first packet of each kind, and each event of cFS once."""
        self._command = self._command or (decoded if decoded.message and decoded.link.only_to_cfs else None)
        network, space = decoded.layer("sbn"), decoded.layer("ccsds")
        kind = (
            decoded.link,
            network.values()["msg_type"] if network else None,
            space.values()["msg_id"] if space else None,
            decoded.summary if decoded.layer("cfe_event") else "",
        )
        line = self._list.line(line_of(decoded))
        if kind not in self._seen:
            self._seen.add(kind)
            self._line(line)

    def end(self, live: Mapping[str, Any], real: Mapping[str, Any], folder: Path) -> None:
        """Print the contents of the recordings, one packet decoded, and the next commands to try."""
        if self._command is not None:
            self._title(2, "One command, every layer")
            self._say(f"$ edoras decode {folder}/two_rovers.mcap {self._command.datagram.number}")
            for line in tree.packet_lines(self._command, self._terminal.width, colour=self._terminal.colour):
                self._line(line)
        console = output_console()
        self._title(3, "What was recorded")
        self._say(f"$ edoras info {folder}/two_rovers.mcap")
        console.print(capture_summary(live, explain=False))
        self._title(4, "A capture of a real cFS")
        self._say(
            f"$ edoras record {folder}/a_rover.pcap -c {folder}/missions/rover_ground.yaml "
            f"-o {folder}/a_rover.mcap"
        )
        console.print(capture_summary(real))
        self._title(5, "What to do next")
        for line in (
            f"Foxglove         open {folder}/two_rovers.mcap, then its layout {folder}/foxglove_layout.json",
            "your own link    edoras sniff -i eth0 -c your_bridge.yaml",
            "                 edoras record -i eth0 -c your_bridge.yaml -o flight.mcap",
            f"back to a pcap   edoras record {folder}/a_rover.mcap -o back.pcap",
            f"what went wrong  edoras doctor {folder}/a_rover.mcap",
            "an emulated cFS  edoras sim two-rovers --rate 10   and in another terminal: edoras sniff -i lo",
        ):
            self._line(f"  {line}")

    def _title(self, number: int, text: str) -> None:
        self._line("")
        self._line(self._paint(f"{number}. {text}", palette.STRONG))

    def _say(self, text: str) -> None:
        self._line(self._paint(f"   {text}", palette.DIM))

    def _line(self, text: str) -> None:
        self._out.write(f"{text}\n")
        self._out.flush()
