"""What verdicts are about: messages of one MsgId, or a loss, and where and when they were."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from edoras_tools.diagnosis.accounting.losses import COUNTERS, Loss
from edoras_tools.diagnosis.advice import stood_still
from edoras_tools.diagnosis.verdict import About, Advice, Severity, Verdict, error, verdict
from edoras_tools.links import table
from edoras_tools.model import NO_MSG_ID, NO_ROUTE
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from typing_extensions import Unpack

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.wire.arrays import Places

_FEW: Final = 20
"""So many of one kind are told one by one; more are told together."""
_SINGLE: Final = 2
"""Of more commands within a second none is what an operator did."""
_OF_ONE: Final = {"are": "is", "have": "has", "do": "does", "carry": "carries"}


def subject(case: Case, members: Sequence[int] | Places) -> dict[str, Any]:
    """Return ``msg_id`` and ``link`` of the first of some rows, and the ``span`` of all; in order of time."""
    msg_id, link = int(case.rows.msg_id[members[0]]), table.link(case.rows.link[members[0]])
    number = msg_id if msg_id != NO_MSG_ID else None
    return {"msg_id": number, "link": link.label, "span": case.span(members)}


def one_by_one(members: list[int]) -> list[list[int]]:
    """Return the rows that are told of together: each by itself while they are few."""
    return [members] if len(members) > _FEW else [[row] for row in members]


def packet(case: Case, row: int) -> str:
    """Return ``packet 12 at 3.4 s``."""
    return f"packet {case.rows.number[row]} at {case.at(int(case.rows.time_ns[row]))}"


def sent_before(case: Case, time_ns: int, after_ns: int = 1) -> Iterator[str]:
    """Yield the commands just before a time that are no topic: one of them may be its cause.

    Args:
        after_ns: so much later it may have been sent as well.
    """
    for stream in case.streams:
        operators = stream.link.only_to_cfs and stream.route == NO_ROUTE
        if operators and not case.rows.cdr_length[stream.rows].any():
            near = stream.rows[(stream.time_ns > time_ns - SECOND) & (stream.time_ns < time_ns + after_ns)]
            near = near[case.rows.function_code[near] >= 0]
            if len(near) and len(near) <= _SINGLE:
                code = int(case.rows.function_code[near[-1]])
                when = case.at(int(case.rows.time_ns[near[-1]]))
                yield f"a command on {case.name(stream.msg_id)}, function code {code}, was sent at {when}"


def of_messages(
    severity: Severity,
    case: Case,
    members: Places,
    text: str,
    *evidence: str,
    noun: str = "messages",
    **about: Unpack[About],
) -> Verdict:
    """Return what is so of some messages of one MsgId on one link; of an error all of them are lost.

    Args:
        members: their rows, in order of time.
        text: the end of the sentence that begins ``3 of 40 messages on 0x0827 (/pose)``.
    """
    rows, first, where = case.rows, members[0], subject(case, members)
    msg_id = int(rows.msg_id[first])
    of = about.pop("of", None) or int(((rows.link == rows.link[first]) & (rows.msg_id == msg_id)).sum())
    lost: dict[str, Any] = {"lost": len(members), "of": of} if severity is Severity.ERROR else {}
    verb, _, rest = text.partition(" ")
    if len(members) == 1:
        verb, rest = _OF_ONE.get(verb, verb), rest.replace("their ", "its ")
    reason = f"{len(members):,} of {of:,} {noun} on {case.name(msg_id)} {verb} {rest}"
    return verdict(severity, reason, *evidence, **{**about, **where, **lost})


def lost_at(case: Case, loss: Loss, noun: str = "messages") -> str:
    """Return the start of the sentence: ``12 of 60 messages on 0x0827 (/pose) lost at TO_LAB_TLM_PIPE``."""
    # Of what waited in CI, more may be lost in a time than was sent in it.
    of = f" of {loss.of:,}" if (loss.of or 0) >= loss.lost else ""
    word = noun.removesuffix("s") if loss.lost == 1 and not of else noun
    return f"{loss.lost:,}{of} {word} on {case.name(loss.msg_id)} lost at {loss.hop}"


def loss_verdict(
    case: Case, loss: Loss, reason: str, remedy: str | Advice, *more: str, link: str | None = None
) -> Verdict:
    """Return the verdict of severity error on a loss.

    Args:
        case: the case.
        loss: the loss.
        reason: sentence on the loss.
        remedy: change that helps.
        more: facts beside the loss' own.
        link: label of the link that it concerns; None for that of its stream.
    """
    still = stood_still(case, loss) if loss.kind in COUNTERS else ""
    advice = remedy if isinstance(remedy, Advice) else None
    return error(
        f"{reason}. {still}" if still else reason,
        *(*loss.evidence, *more, *case.drops_text()),
        msg_id=loss.msg_id,
        place=(link or (loss.stream.link.label if loss.stream else None), loss.hop),
        lost=loss.lost,
        of=loss.of,
        span=(loss.start_ns, loss.end_ns),
        remedy=advice.remedy if advice else str(remedy),
        advice=advice,
        confidence=loss.confidence,
        cause=loss.kind,
    )
