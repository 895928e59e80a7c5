"""Sends frames of F Prime again: to its ground system like flight software, or the other way."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.addons.fprime import wire as fprime
from edoras_tools.addons.fprime.commands import command_frame, packet_of_command
from edoras_tools.errors import ConfigError
from edoras_tools.links.sending import LinkSending

if TYPE_CHECKING:
    from edoras_tools.links.framing import Framing
    from edoras_tools.model import Columns, Link, PacketBatch
    from edoras_tools.wire.arrays.order import Mask

_PORT: Final = 50000
"""Port of the ground system, and of flight software's TCP server."""


class GroundDataSending(LinkSending):
    """Frames as they were captured, over one TCP connection.

    Args:
        link: link.
        framing: framing of the answers.
        up: whether commands and files go to flight software; else channels, events and files to the ground
            system.
    """

    port = _PORT

    def __init__(self, link: Link, framing: Framing, *, up: bool) -> None:
        super().__init__(link)
        self.framing, self._up = framing, up
        self._bare = 0

    def outgoing_rows(self, batch: PacketBatch, columns: Columns) -> Mask:
        """Return which frames go this way: TC frames and commands up, all others down; bool (n,)."""
        rows = np.flatnonzero(super().outgoing_rows(batch, columns))
        frames = fprime.read_ground_frames(batch.data, batch.offset[rows], batch.length[rows], checked=False)
        up = frames.shape == fprime.TC_SHAPE
        up[frames.packets.row[frames.packets.kind == fprime.PacketType.COMMAND]] = True
        bare = frames.shape == fprime.SPACE_SHAPE
        self._bare += int(np.count_nonzero(bare & (up == self._up)))
        text = "are space packets without a frame: neither side takes these over TCP"
        self.refusals = [f"{self._bare:,} {text}"] if self._bare else []
        going = np.zeros(len(batch), bool)
        going[rows[(up == self._up) & ~bare]] = True
        return going

    def compose(self, name: str, values: Any, count: int, context: Any) -> list[bytes]:
        """Return the frames of a command from an F Prime dictionary."""
        if not self._up:
            raise ConfigError(f"commands go to flight software: --to {self.link.label}:up")
        entries = context.structs.dictionary
        if entries is None:
            raise ConfigError("commands have their names from a dictionary: --set structs=FILE.json")
        packet = packet_of_command(entries, name, values)
        return [command_frame(packet, number) for number in range(count)]
