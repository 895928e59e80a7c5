"""What apps take: the function codes of each command MsgId, and the lengths of their packets."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from edoras_tools.cfs import names


class CommandTable:
    """What apps take, as arrays: for many commands at once.

    Args:
        commands: function codes and their commands by MsgId.
    """

    def __init__(self, commands: Mapping[int, Mapping[int, names.Command]]) -> None:
        self._app = np.zeros(65536, np.uint8)
        self._taken = np.zeros((len(commands) + 1, 128), bool)
        self._lengths = np.zeros((2, len(commands) + 1, 128), np.int32)
        for app, (msg_id, codes) in enumerate(commands.items(), 1):
            self._app[msg_id] = app
            for code, command in codes.items():
                self._taken[app, code] = True
                for choice, length in enumerate(
                    command.lengths * 2 if len(command.lengths) == 1 else command.lengths
                ):
                    self._lengths[choice, app, code] = length

    def judge(
        self, msg_id: NDArray[np.int32], code: NDArray[np.int16], length: NDArray[np.int32]
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Tell which commands have a function code that their app refuses, and which have a wrong length."""
        app = self._app[msg_id]
        one, other = self._lengths[:, app, code]
        unknown: NDArray[np.bool_] = (app != 0) & ~self._taken[app, code]
        misfit: NDArray[np.bool_] = (one != 0) & (length != one) & (length != other)
        return unknown, misfit

    def fits(
        self, msg_id: NDArray[np.int32], code: NDArray[np.int16], length: NDArray[np.int32]
    ) -> NDArray[np.bool_]:
        """Tell which commands an app accepts with exactly this length."""
        app = self._app[msg_id]
        one, other = self._lengths[:, app, code]
        fits: NDArray[np.bool_] = self._taken[app, code] & (one != 0) & ((length == one) | (length == other))
        return fits
