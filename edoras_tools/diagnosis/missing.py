"""Every message that did not arrive, one by one, as far as the capture can tell which.

A command is told by itself where the capture shows what came out of cFS. Telemetry is told by the sequence
counts that never came, and by the packets between which they are missing. Of other losses the number is
known alone.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.cfs.names import message_name
from edoras_tools.diagnosis.accounting.losses import Loss
from edoras_tools.model import NO_MSG_ID
from edoras_tools.sessions.sequence import MODULUS

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.accounting.commands import Refused
    from edoras_tools.diagnosis.accounting.fates import Fate
    from edoras_tools.diagnosis.accounting.losses import LossKind
    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.matching.streams import Stream

_CAUSES: Final[dict[LossKind, str]] = {
    "limit": "over the message limit of {hop}",
    "overflow": "{hop} was full",
    "after": "lost between cFS and the capture",
    "unknown": "lost on the software bus",
    "network": "lost before CI",
    "socket": "CI's socket was full",
    "down": "cFS was down",
    "restart": "{hop} was restarted",
    "stopped": "{hop} was stopped",
    "away": "the SBN peer was away",
    "sbn_socket": "SBN's socket was full",
}


@dataclass(frozen=True, slots=True)
class Missing:
    """One message, or a run of sequence counts, that did not arrive.

    Attributes:
        link: label of the link.
        msg_id: cFE MsgId.
        topic: configured topic, else the packet's name, or None.
        count: how many messages.
        time_ns: when it was sent; of counts, when the packet before them was seen.
        until_ns: of counts, when the packet behind them was seen; of a message as ``time_ns``.
        number: place of the packet in the capture, from 1; None where it is not there.
        first: the first sequence count that is missing; None for a message.
        what: what became of it, as far as that is known of each.
        message: fields of the ROS message, or None.
    """

    link: str
    msg_id: int
    topic: str | None
    count: int
    time_ns: int
    until_ns: int
    number: int | None
    first: int | None
    what: str
    message: dict[str, Any] | None = None

    def as_json(self) -> dict[str, Any]:
        """Return it in the shape of ``doctor --list-lost json``."""
        return {**asdict(self), "msg_id": None if self.msg_id == NO_MSG_ID else f"0x{self.msg_id:04x}"}


def missing(case: Case) -> list[Missing]:
    """Return all of them, in order of time."""
    found = [item for fate in case.commands.fates.values() if fate.seen for item in _commands(case, fate)]
    found += [item for stream in case.streams if stream.counted for item in _counts(case, stream)]
    listed: Counter[tuple[str, int]] = Counter()
    for item in found:
        listed[item.link, item.msg_id] += item.count
    found += _without_packets(case, listed)
    return sorted(found, key=lambda item: item.time_ns)


def _without_packets(case: Case, listed: Counter[tuple[str, int]]) -> Iterator[Missing]:
    """Yield losses of which no packet and no count is known: how many, and between when and when.

    Args:
        case: the capture.
        listed: how many are told one by one already, by link and MsgId; it is used up.
    """
    known = {
        (fate.stream.link.label, fate.stream.msg_id) for fate in case.commands.fates.values() if fate.seen
    }
    for item in case.refused:
        if left := case.commands.unplaced[id(item)] if (item.link, item.msg_id) in known else item.lost:
            yield _some(case, left, item, f"{item.rule} at {item.hop or 'cFS'}")
    for loss in case.losses:
        key = ("", -1) if loss.stream is None else (loss.stream.link.label, loss.stream.msg_id)
        told = min(listed[key], loss.lost)
        listed[key] -= told
        if told < loss.lost:
            yield _some(case, loss.lost - told, loss, _CAUSES[loss.kind].format(hop=loss.hop))
    for stream in case.streams:
        if (silent := case.unheard.get(id(stream))) is not None:
            times = case.rows.time_ns[stream.rows]
            yield Missing(
                link=stream.link.label,
                msg_id=stream.msg_id,
                topic=_name(case, stream.msg_id),
                count=silent.lost + silent.unaccounted,
                time_ns=int(times[0]),
                until_ns=int(times[-1]),
                number=None,
                first=None,
                what=f"sent to the SBN peer {silent.peer} while it was silent",
            )


def _some(case: Case, count: int, item: Refused | Loss, what: str) -> Missing:
    msg_id = NO_MSG_ID if item.msg_id is None else item.msg_id
    return Missing(
        link=(item.stream.link.label if item.stream else "") if isinstance(item, Loss) else item.link or "",
        msg_id=msg_id,
        topic=_name(case, msg_id),
        count=count,
        time_ns=item.start_ns,
        until_ns=item.end_ns,
        number=None,
        first=None,
        what=what,
    )


def _name(case: Case, msg_id: int) -> str | None:
    return case.topic(msg_id) or message_name(msg_id) or None


def _commands(case: Case, fate: Fate) -> Iterator[Missing]:
    stream, rows = fate.stream, case.rows
    spans = [
        (loss.start_ns, loss.end_ns, _CAUSES[loss.kind].format(hop=loss.hop))
        for loss in case.losses
        if loss.stream is stream
    ]
    for index in np.flatnonzero(~fate.arrived).tolist():
        row = int(stream.rows[index])
        time_ns = int(rows.time_ns[row])
        causes = list(dict.fromkeys(text for start, end, text in spans if start <= time_ns <= end))
        if fate.newer[index]:
            causes.append("a newer one of its round went on")
        yield Missing(
            link=stream.link.label,
            msg_id=stream.msg_id,
            topic=_name(case, stream.msg_id),
            count=1,
            time_ns=time_ns,
            until_ns=time_ns,
            number=int(rows.number[row]),
            first=None,
            what=" or ".join(causes) or "not known",
        )


def _counts(case: Case, stream: Stream) -> Iterator[Missing]:
    rows, last = case.rows, len(stream) - 1
    for index in np.flatnonzero(stream.missing > 0).tolist():
        before, behind = int(stream.rows[index]), int(stream.rows[min(index + 1, last)])
        yield Missing(
            link=stream.link.label,
            msg_id=stream.msg_id,
            topic=_name(case, stream.msg_id),
            count=int(stream.missing[index]),
            time_ns=int(rows.time_ns[before]),
            until_ns=int(rows.time_ns[behind]),
            number=None,
            first=(int(rows.sequence_count[before]) + 1) % MODULUS,
            what="never came after a pause" if stream.pauses[index] else "never came",
        )
