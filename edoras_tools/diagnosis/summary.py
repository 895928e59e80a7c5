"""The first lines of a report: how much was lost, why, what to do about it, and what is fine.

Rules:

1. Every figure is taken from the balance: nothing is counted here.
2. The losses of one cause at one place are one problem. Losses over a message limit are one problem for each
MsgId, if a verdict names the MsgId, because each MsgId has its own remedy.
3. A problem has the sentence and the remedy of the verdict that explains it, or of the queue where it is.
4. What was not examined comes first, then what was lost, then other errors, then warnings.
"""

from __future__ import annotations

from collections import Counter
from functools import partial
from itertools import chain
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
from msgspec.structs import replace

from edoras_tools.cfs import sbn
from edoras_tools.diagnosis.accounting.closed import PORT_CLOSED, UDP_PORT
from edoras_tools.diagnosis.accounting.losses import APP, BUS, SBN_SOCKET
from edoras_tools.diagnosis.balance import not_counted, sent
from edoras_tools.diagnosis.evidence.relays import RELAY_HOP
from edoras_tools.diagnosis.ledger import CAPTURE, CAUSES, PEER, Row, cause_text
from edoras_tools.diagnosis.verdict import CAPTURE_RULES, NOTHING_SENT, Severity, alike, group_verdicts
from edoras_tools.units import SECOND
from edoras_tools.wire.arrays import by_key
from edoras_tools.words import either, plural

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from edoras_tools.diagnosis.examination import Diagnosis
    from edoras_tools.diagnosis.verdict import Verdict

_AT_QUEUES: Final = frozenset({"limit", "overflow", "socket", "unknown"})
"""Causes whose text also says how much the queue takes, or what events name there."""
_HARM: Final = frozenset({"struct_overrun", "ci_cut", "ground_bridge_buffer", "flight_bridge_length"})
"""Rules about messages that arrive in part, or damaged."""
_NAMES: Final = 2
"""Topics that are named; if there are more, the text gives their number."""
_MOMENT_S: Final = 0.1
_SHARES: Final = ((0.5, "Over half of the"), (0.4, "Nearly half of the"))
_RARE: Final = 0.01
_NAMED: Final = 3
"""MsgIds that are named for a loss shared by several; if there are more, the text gives their number."""

_OF_ONE_HOP: Final = "SBN_", PEER, UDP_PORT, RELAY_HOP
"""Prefixes of hops that belong to one peer or one port: a verdict on another hop does not explain them."""


class Problem(msgspec.Struct, frozen=True):
    """One thing that is wrong.

    Attributes:
        lost: messages lost by it; None if it is no loss, or if nothing counts the loss.
        text: sentence that says what is wrong, where and why.
        remedy: what to do, including lines to paste; empty if nothing helps.
        severity: severity of the first verdict; ``ERROR`` for a loss.
        verdicts: verdicts that explain it, the worst first; may be empty.
        left: messages that the queue model still loses with the remedy; None if the model cannot say.
        of: number of messages that ``left`` refers to: all that its routes sent.
        of_lost: whether ``of`` are the losses of these problems instead, because their routes have others.
        spacecraft: number of its part of the diagnosis; 0 if the diagnosis has no parts.
    """

    lost: int | None
    text: str
    remedy: str
    severity: Severity
    verdicts: tuple[Verdict, ...]
    left: int | None = None
    of: int = 0
    of_lost: bool = False
    spacecraft: int = 0

    @property
    def promise(self) -> str:
        """Messages that would still be lost with the remedy, in words; empty if the model cannot say."""
        lost = " lost" * self.of_lost
        return "" if self.left is None else f"{self.left:,} of {self.of:,}{lost} (by the model)"

    def as_json(self) -> dict[str, Any]:
        """Return the problem in the shape of ``doctor --json``."""
        return {
            "lost": self.lost,
            "text": self.text,
            "remedy": self.remedy or None,
            "left": self.left,
            "severity": self.severity.label,
            "rules": list(dict.fromkeys(item.rule for item in self.verdicts)),
        }


class DoctorSummary(NamedTuple):
    """The first lines of a report.

    Attributes:
        headline: sentence with the total of the losses.
        problems: problems in the order of the report.
        fine: sentences on messages that arrived, and on losses that nothing counts; empty if the headline has
            them, or if nothing counts anything.
        notes: number of verdicts less severe than a warning.
    """

    headline: str
    problems: tuple[Problem, ...]
    fine: str
    notes: int

    def as_json(self) -> dict[str, Any]:
        """Return the summary in the shape of ``doctor --json``."""
        problems = [item.as_json() for item in self.problems]
        return {**self._asdict(), "problems": problems, "fine": self.fine or None}

    def rest(self, first: int) -> str:
        """Return one line about all problems but the ``first`` ones; empty if there are no others."""
        others = self.problems[first:]
        losses = [item.lost for item in others if item.lost]
        parts = [f"{sum(losses):,} lost in {plural(len(losses), 'other way')}"] if losses else []
        parts += _counts([item for item in others if not item.lost], "other ")
        return f"Also {', '.join(parts)}." if parts else ""


def summarize(result: Diagnosis) -> DoctorSummary:
    """Return the first lines of the report on a diagnosis."""
    problems = list(chain.from_iterable(_problems(result)))
    if result.parts:
        own = {number: _problems(part) for number, part in result.parts.items()}
        first, losses, rest = (
            [
                replace(item, text=f"{result.mission.called(number)}: {item.text}", spacecraft=number)
                for number, kinds in own.items()
                for item in kinds[kind]
            ]
            for kind in range(3)
        )
        problems = [*first, *sorted(losses, key=lambda item: -(item.lost or 0)), *rest]
    notes = sum(item.severity < Severity.WARNING for item in result.verdicts)
    headline, fine = _headline(result, problems), "" if result.without_evidence else _fine(result)
    if fine and not (problems or result.uncertain):
        headline, fine = f"{headline.removesuffix('.')}: {fine[0].lower()}{fine[1:]}", ""
    return DoctorSummary(headline, tuple(problems), fine, notes)


def _problems(result: Diagnosis) -> tuple[list[Problem], list[Problem], list[Problem]]:
    """Return three lists: problems of the capture itself, losses, and all others."""
    losses, used = _losses(result)
    others = [item for item in result.verdicts if id(item) not in used and item.severity >= Severity.WARNING]
    apart = [_apart(members) for members in alike(group_verdicts(others))]
    first = [one for one in apart if one.severity is Severity.ERROR and one.verdicts[0].rule in CAPTURE_RULES]
    return first, losses, [item for item in apart if item not in first]


def _apart(groups: Sequence[Sequence[Verdict]]) -> Problem:
    """Return the problem that verdicts of one rule, which are about no loss, describe."""
    every = [item for members in groups for item in members]
    worst = every[0]
    more = f" (and {len(every) - 1:,} more of this kind)" if every[1:] else ""
    return Problem(None, f"{worst.reason}{more}", _useful(worst.remedy), worst.severity, tuple(every))


def _useful(remedy: str) -> str:
    return "" if remedy.startswith("none") else remedy


def _losses(whole: Diagnosis) -> tuple[list[Problem], set[int]]:
    """Return the losses, the worst first, and the ``id()`` of each verdict that explains one."""
    groups: dict[tuple[Any, ...], list[tuple[Row, int]]] = {}
    verdicts: dict[tuple[Any, ...], dict[int, Verdict]] = {}
    explained: dict[tuple[Any, ...], list[Verdict]] = {}
    for row in whole.balance:
        for cause, number in {**row.lost, "unaccounted": row.unaccounted}.items():
            if not number:
                continue
            place = cause, row.msg_id, row.hop
            if place not in explained:
                explained[place] = _explaining(whole.verdicts, cause, row)
            own = explained[place]
            by_msg_id = cause == "limit" and any(item.msg_id is not None for item in own)
            instance = "" if row.hop.startswith(PEER) else row.instance  # what is sent to one peer
            key = cause, row.hop, instance, whole.topics.get(row.route, row.msg_id) if by_msg_id else None
            groups.setdefault(key, []).append((row, number))
            verdicts.setdefault(key, {}).update((id(item), item) for item in own)
    alone = len({(row.route, row.link, row.msg_id) for members in groups.values() for row, _ in members}) == 1
    problems = []
    for key, members in groups.items():
        own = sorted(verdicts[key].values(), key=lambda item: (item.msg_id is None, -(item.lost or 0)))
        problems.append((_problem(whole, key[0], members, own, alone=alone), [row for row, _ in members]))
    problems.sort(key=lambda item: -(item[0].lost or 0))
    return list(_promising(whole, problems)), {id(item) for own in explained.values() for item in own}


def _explaining(verdicts: Iterable[Verdict], cause: str, row: Row) -> list[Verdict]:
    """Return the verdicts that explain a cause at a row; only those of its MsgId, link and hop, if any."""
    entry = CAUSES.get(cause)
    rules = (entry and entry.rules) or (cause,)
    own = [
        item
        for item in verdicts
        if (item.cause == cause if item.cause else item.rule in rules)
        and item.msg_id in {None, row.msg_id}
        and (item.lost is None) == (cause == "unaccounted")
        and (item.hop in {row.hop, sbn.NAME} or not row.hop.startswith(_OF_ONE_HOP))
    ]
    own = [item for item in own if item.msg_id is not None] or own
    own = [item for item in own if item.link == row.link] or own
    return [item for item in own if item.hop == row.hop] or own


def _problem(
    result: Diagnosis, cause: str, members: Sequence[tuple[Row, int]], own: Sequence[Verdict], *, alone: bool
) -> Problem:
    """Return the problem of one cause at one place.

    Args:
        members: rows of the balance, each with the number of its lost messages.
        own: verdicts that explain it, the worst first.
        alone: whether no other route lost anything, so that the headline already names it.
    """
    rows, lost = [row for row, _ in members], sum(number for _, number in members)
    remedy, advice = (_useful(own[0].remedy), own[0].advice) if own else ("", None)
    of = sent_of(result, rows)
    unseen = of < lost or not rows[0].link or rows[0].msg_id is None
    whole = "of " * (rows[0].msg_id is None) if unseen else f"of {of:,} "
    about = f"{whole}{_names(result, rows)}"
    if cause not in CAUSES:
        text = _each(cause, own, lost, about) if own else f"{about}: {cause.replace('_', ' ')}"
    else:
        alone |= cause == PORT_CLOSED and not rows[0].link  # else the port would be named twice
        place, whose = _place(cause, rows, own), rows[0].instance
        if len({row.instance for row in result.balance if row.instance}) > 1:
            place += f" of {whose}" * (cause in {"limit", "overflow"})
            place = place.replace("while cFS was", f"while {whose} was")
        text = f"{'' if alone else f'{about} '}{place}{_when(result, own)}"
        why = advice.why if advice else own[0].reason.partition(": ")[2] if own else ""
        whys = dict.fromkeys(item.advice.why if item.advice else "" for item in own)
        if cause not in _AT_QUEUES:
            text += f", after {' and '.join(whys)}" if all(whys) and whys else ""
        elif why:
            text += f": {why}"
    return Problem(lost, text, remedy, Severity.ERROR, tuple(own), advice.left if advice else None)


def _promising(result: Diagnosis, problems: Sequence[tuple[Problem, Sequence[Row]]]) -> Iterator[Problem]:
    """Yield problems with ``left`` and ``of`` set; several problems may share one remedy."""
    for item, rows in problems:
        alike = [other for other, _ in problems if other.remedy == item.remedy]
        cured = sum(other.lost or 0 for other in alike)
        keys = {row.key for row in rows}
        lost = sum(row.proven for row in result.balance if row.key in keys)
        rest = item.left if (item.left or 0) < (item.lost or 0) else None  # no gain: nothing is promised
        of_lost = lost > cured
        yield replace(item, left=rest, of=cured if of_lost else sent_of(result, rows), of_lost=of_lost)


def _each(cause: str, own: Sequence[Verdict], lost: int, about: str) -> str:
    """Return one text for the verdicts of one cause, which lost ``lost`` messages: ``about``."""
    which, _, text = own[0].reason.partition(": ")
    if not cause.startswith("bad_"):
        return f"{about}: e.g. {own[0].reason}" if own[1:] else own[0].reason.removeprefix(f"{lost:,} ")
    if (faults := len({item.reason.partition(": ")[2] for item in own})) > 1:
        return f"{about}, {faults} faults; the first, {which}: {text}"
    return f"{about}: {text}" + f" (first: {which})" * (len(own) > 1)


def _place(cause: str, rows: Sequence[Row], own: Sequence[Verdict]) -> str:
    """Return the place of a loss in words, with the name of the pipe, application or peer."""
    hops = {item.hop for item in own if item.hop}
    hop = (" or ".join(sorted(hops - {APP} or hops)) or rows[0].hop).replace(APP, "the application's pipe")
    if (cause in {"limit", "overflow"} and own) or hop.startswith(RELAY_HOP):
        return f"at {hop}".replace(f"at {BUS}", f"on the {BUS}")
    if cause in {"limit", "overflow"}:
        return f"{cause_text(cause)}, {hop}"
    text = cause_text(cause).replace("the application", hop).replace("a port where", f"{hop}, where")
    doubt = ", or what an application sends on for them"
    text += doubt * any(doubt in item.reason for item in own)
    text = text.replace("before CI", f"before {sbn.NAME}") if hop == SBN_SOCKET else text
    return text.replace("a silent SBN peer", f"{hop} while it was silent")


def _when(result: Diagnosis, own: Sequence[Verdict]) -> str:
    """Return the time of the losses in words; empty if it covers more than half of the capture."""
    if not own:
        return ""
    start_ns, end_ns = min(item.start_ns for item in own), max(item.end_ns for item in own)
    if (end_ns - start_ns) * 2 > result.end_ns - result.start_ns:
        return ""
    start, end = ((time_ns - result.zero_ns) / SECOND for time_ns in (start_ns, end_ns))
    return f", at {start:.1f} s" if end - start < _MOMENT_S else f", {start:.1f} to {end:.1f} s"


def sent_of(result: Diagnosis, rows: Iterable[Row]) -> int:
    """Return the number of messages that the routes of some rows sent."""
    keys = {row.key for row in rows}
    return sent(row for row in result.balance if row.key in keys)


def _name(result: Diagnosis, row: Row) -> str:
    unnamed = "unknown MsgIds" if row.msg_id is None else f"0x{row.msg_id:04x}"
    if among := {f"0x{msg_id:04x}" for _, msg_id, _ in row.among}:
        unnamed = either(sorted(among)) if len(among) <= _NAMED else f"one of {len(among)} MsgIds"
    elif row.msg_id is None and row.hop.startswith(UDP_PORT):
        unnamed = f"sent to {row.hop}"
    return result.topics.get(row.route) or row.topic or row.name or unnamed


def _names(result: Diagnosis, rows: Iterable[Row]) -> str:
    rows = list(rows)
    if len(rows) > 1 and all(row.among for row in rows):  # of all that share them
        rows = [replace(rows[0], among=tuple(chain.from_iterable(row.among for row in rows)))]
    names = list(dict.fromkeys(_name(result, row) for row in rows))
    return " and ".join(names) if len(names) <= _NAMES else f"messages of {len(names)} MsgIds"


def _headline(result: Diagnosis, problems: Sequence[Problem]) -> str:
    if result.unnamed:
        number = sum(item.datagrams for item in result.unnamed)
        rest = _total(result, problems) if result.datagrams else "nothing else of CI, TO or SBN is here."
        return f"{plural(number, 'datagram')} were not examined. In the rest: {rest[0].lower()}{rest[1:]}"
    if not result.datagrams:
        where = "in the chosen time" if result.capture.cut else "here"
        return f"No cFS {where}: nothing of CI, TO or SBN was examined."
    return _total(result, problems)


def _total(result: Diagnosis, problems: Sequence[Problem]) -> str:
    proven = result.lost + result.unaccounted
    more = result.uncertain
    if proven:
        doubt = f" Up to {more:,} more may be lost." if more else ""
        return f"{_nothing_sent(result)}{_lost(result, proven)}{_copies(result, proven)}{doubt}"
    text = "No loss found with what is shown" if result.choice else "No loss found"
    if any(item.rule == "cut_frames" for item in result.verdicts):
        text += " in what was not cut off"
    if result.without_evidence:
        noun = f"{sent(result.balance):,} {_names(result, result.balance)}"
        text = f"No evidence: nothing here counts what arrived of {noun}"
    counts = _counts(x for x in problems if not result.unnamed or x.verdicts[0].rule != "not_examined")
    others = f" {' and '.join(counts)}:" if counts else ""
    text = _nothing_sent(result) + text
    if more:
        return f"{text}. Up to {plural(more, 'message')} may be lost.{others}"
    return f"{text}{', but' if others and not result.without_evidence else '.'}{others}"


def _nothing_sent(result: Diagnosis) -> str:
    """Return the sentence that nothing of what was sent on a way arrives; empty if there is no such way."""
    texts = (item.reason.partition(":")[0] for item in result.verdicts)
    wrong = next((text for text in texts if text.startswith(NOTHING_SENT[0]) and NOTHING_SENT[1] in text), "")
    return f"{wrong[:1].upper()}{wrong[1:]}. " if wrong else ""


def _copies(result: Diagnosis, proven: int) -> str:
    """Return the sentence on copies, for losses among datagrams that the network doubled; empty if none."""
    least, most = result.messages_lost, result.messages_lost + result.messages_uncertain - result.uncertain
    number = f"{least:,} to {most:,}" if least < most else f"{most:,}"
    if not most and proven:
        return " They are copies: every message arrived."
    some = "Some are" if most < proven else "Some may be"
    return f" {some} copies: {number} of their messages never arrived." if least < proven else ""


def _counts(problems: Iterable[Problem], kind: str = "") -> list[str]:
    """Return the numbers of errors and warnings, as ``2 errors``."""
    graves = [item.severity for item in problems]
    return [
        plural(graves.count(severity), f"{kind}{severity.label}")
        for severity in (Severity.ERROR, Severity.WARNING)
        if severity in graves
    ]


def _lost(result: Diagnosis, proven: int) -> str:
    """Return the sentence on the losses: of one route, or of all together."""
    rows = [row for row in result.balance if row.proven]
    noun, were = "commands" if all(row.link == "ci" for row in rows) else "messages", "were"
    if result.messages_lost < proven:
        noun = "datagrams"
    if proven == 1:
        noun, were = noun.removesuffix("s"), "was"
    shared = sum(row.proven for row in rows if row.among)
    routes, of = {row.key for row in rows if not row.among}, sent_of(result, rows)
    has_name = (rows[0].topic, rows[0].msg_id) != ("", None)
    if len(routes) == 1 and not shared and rows[0].link and of > 1 and has_name:
        whole = "" if _HARM.isdisjoint(chain.from_iterable(row.lost for row in rows)) else " whole"
        name = _name(result, rows[0])
        if proven == of:
            return f"None of the {of:,} {name} {noun} arrived{whole}."
        return f"{_share(proven, of, noun)} never arrived{whole}: {proven:,} of {of:,} {name} {were} lost."
    return f"{proven:,} {noun} {were} lost: {', '.join(_parts(result, rows)) or _names(result, rows)}."


def _parts(result: Diagnosis, rows: Sequence[Row]) -> list[str]:
    """Return the losses of the routes that lost most, by name, and of the rest together; empty for one name.

    Args:
        result: the diagnosis.
        rows: rows of the balance that lost something.
    """
    own, shared = [row for row in rows if not row.among], [row for row in rows if row.among]
    routes = len({row.key for row in own})
    lines = sorted((item for item in result.headlines if item.missing), key=lambda item: -item.missing)
    if len(lines) < routes or len(lines) > _NAMES + 1:
        del lines[_NAMES:]
    parts = [f"{item.missing:,} of {item.sent:,} {item.name}" for item in lines]
    if other := routes - len(lines):
        lost = _by_name(result, own) - sum((Counter({x.topic: x.missing}) for x in lines), Counter[str]())
        number = sum(row.proven for row in own) - sum(item.missing for item in lines)
        if lost.total() != number or len(lost) > (1 if lines else _NAMES):
            lost = Counter()
            parts.append(f"{number:,} with {plural(other, 'other MsgId')}")
        parts += [f"{count:,} of {name}" for name, count in lost.most_common()]
    if shared:
        parts.append(f"{sum(row.proven for row in shared):,} of {_names(result, shared)}")
    return parts if parts[1:] or lines else []


def _by_name(result: Diagnosis, rows: Iterable[Row]) -> Counter[str]:
    """Return the proven losses of each name."""
    groups = by_key(rows, partial(_name, result)).items()
    return Counter({name: sum(row.proven for row in own) for name, own in groups})


def _share(part: int, of: int, noun: str) -> str:
    """Return a share in words, as ``Over half of the commands``."""
    share = part / of
    if part == 1:
        return f"One {noun}"
    for least, words in _SHARES:
        if share >= least:
            return f"{words} {noun}"
    return f"About 1 in {round(1 / share)} {noun}" if share >= _RARE else f"A few {noun}"


def _fine(result: Diagnosis) -> str:
    """Return one line about the messages that belong to no problem."""
    followed = (row for row in result.balance if row.came and (row.topic or row.msg_id is not None))
    fates = by_key(by_key(followed, lambda row: row.key).values(), _fate)
    arrived, unseen = fates.get("arrived", ()), fates.get("unseen", ())
    whole = plural(sum(rows[-1].out for rows in arrived), "message")
    others = sum(rows[-1].out for rows in (*arrived, *fates.get("open", ())))
    rows = (row for row in result.balance if row.hop != CAPTURE)  # its lost frames have a verdict
    open_ended = sum(row.waiting + row.not_captured + row.shared for row in rows)
    # If the network doubles messages, it may also lose copies, and no counter shows that.
    hides = any(row.copies > row.sure_copies for row in result.balance)
    arrival = "arrived, as far as this capture shows." if _leaves_host(result) else "arrived."
    parts, proven = [], result.lost + result.unaccounted
    if arrived and not (open_ended or hides) and fates.keys() <= {"arrived", "lost"}:
        rest = "but these" if result.uncertain else "else"
        parts.append(f"All {rest if proven else whole} {arrival}")
    elif others:
        parts.append(f"{plural(others, 'other message' if proven else 'message')} {arrival}")
    if result.superseded:
        parts.append(f"{result.superseded:,} gave way to newer ones, as the application does.")
    if unseen:
        parts.append(f"Nothing here counts losses of {_names(result, [rows[0] for rows in unseen])}.")
    if open_ended:
        parts.append(f"{plural(open_ended, 'message')} could not be followed.")
    return " ".join(parts)


def _leaves_host(result: Diagnosis) -> bool:
    """Return whether telemetry goes to another host: the capture may only show it on the host of cFS."""
    ends = ([item[end].rpartition(":")[0] for end in ("sender", "receiver")] for item in result.routes)
    return any(sender != receiver and not receiver.startswith("127.") for sender, receiver in ends)


def _fate(rows: Sequence[Row]) -> str:
    """Return one word for the messages of a route: ``lost``, ``open``, ``unseen`` or ``arrived``."""
    if any(row.proven for row in rows):
        return "lost"
    if any(row.out != row.came + row.duplicated for row in rows):
        return "open"
    return "unseen" if not_counted(rows) else "arrived"
