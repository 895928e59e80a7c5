"""What is shown of a diagnosis. Loss is always judged from all traffic: counters count all of it."""

from __future__ import annotations

from collections.abc import Callable  # noqa: TC003  for readers of the signature
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Choice:
    """Which links and MsgIds are shown.

    Attributes:
        text: how people are told of it.
        takes: tells of a link's label and a MsgId, None where unknown, whether what concerns them is shown.
    """

    text: str
    takes: Callable[[str | None, int | None], bool]
