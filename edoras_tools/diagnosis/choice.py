"""What is shown of a diagnosis. Loss is always judged from all traffic: counters count all of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol


class Takes(Protocol):
    """Tells whether what concerns a link's label and a MsgId, None where unknown, is shown.

    Samples of DDS have a topic and no MsgId.
    """

    def __call__(self, link: str | None, msg_id: int | None, topic: str = "", /) -> bool:
        """See the class."""


@dataclass(frozen=True, slots=True)
class Choice:
    """Which links, MsgIds and topics of DDS are shown.

    Attributes:
        text: how people are told of it.
        takes: tells what is shown.
    """

    text: str
    takes: Takes
