"""What may be lost, or only not captured: what no counter explains and the capture itself may have missed."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.diagnosis.accounting.claims import MISSING, shares
from edoras_tools.diagnosis.quality import CONFIDENCE

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.diagnosis.accounting.bus import Telemetry
    from edoras_tools.diagnosis.accounting.claims import Claim
    from edoras_tools.diagnosis.accounting.fates import Fate
    from edoras_tools.diagnosis.accounting.losses import Known, Loss
    from edoras_tools.diagnosis.quality import Quality

_UNEXPLAINED: Final = frozenset({"after", "unknown"})


def hold_back(known: Known, telemetry: Telemetry, quality: Quality) -> None:
    """Keep counts from what the capture may have missed, where no event names it and no pipe was full of it.

    Such a claim takes what nothing else explains; a capture that lacks frames lacks what explains it, too.
    """
    claims: dict[int, list[Claim]] = {}
    for claim in telemetry.claims:
        if claim.rank == MISSING:
            claims.setdefault(claim.flow, []).append(claim)
    missing = sum(claim.number for own in claims.values() for claim in own)
    if not missing or quality.excludes(missing / (sum(map(len, known.streams)) + missing)):
        return
    for stream in known.streams:
        own = claims.get(id(stream), [])
        most = [claim.number for claim in own]
        of = len(stream) + int(stream.missing.sum())
        number = min(sum(most), quality.may_have_missed(of, _sure(known)))
        for claim, share in zip(own, shares(number, most, most), strict=True):
            claim.number -= share


def may_be_missed(known: Known, claims: Sequence[Claim], quality: Quality) -> dict[int, int]:
    """Return id of a stream to how many the capture may have missed of those that no count explains yet."""
    open_ = Counter[int]()
    for claim in claims:
        open_[claim.flow] += claim.open
    sizes = {id(stream): len(stream) for stream in known.streams}
    return {
        flow: 0 if quality.excludes(open_[flow] / of) else quality.may_have_missed(of, _sure(known))
        for flow, of in sizes.items()
    }


def _sure(known: Known) -> float:
    """Return the confidence for one of many streams: that one lacks more than by itself is no wonder."""
    return 1 - (1 - CONFIDENCE) / len(known.streams)


def doubt(known: Known, telemetry: Telemetry, fates: Sequence[Fate], quality: Quality) -> None:
    """Take losses back that the capture may have missed: they become uncertain.

    None does where a capture that misses such a share would show it; nor what came over TCP, where the bytes
    themselves tell what the capture lacks.

    Args:
        telemetry: its losses become fewer, and are counted as uncertain there.
        fates: likewise what is unaccounted for.
    """
    _leave_quiet(known, telemetry)
    streamed = known.rows.streamed
    gaps: dict[int, list[tuple[Loss, int]]] = {}
    for loss in telemetry.losses:
        number = loss.lost if loss.kind in _UNEXPLAINED else loss.uncounted
        if number and loss.stream is not None and not streamed[loss.stream.rows[0]]:
            gaps.setdefault(id(loss.stream), []).append((loss, number))
    unseen = [fate for fate in fates if fate.seen and fate.unaccounted]
    missing = sum(number for own in gaps.values() for _, number in own)
    sent = sum(len(stream) for stream in known.streams) + missing
    missing += sum(fate.unaccounted for fate in unseen)
    if not missing or quality.excludes(missing / sent):
        return
    sure = _sure(known)
    for stream in known.streams:
        own = gaps.get(id(stream), [])
        most = [number for _, number in own]
        of = len(stream) + int(stream.missing.sum())
        number = min(sum(most), quality.may_have_missed(of, sure))
        for (loss, _), share in zip(own, shares(number, most, most), strict=True):
            _take_back(telemetry, loss, share)
    telemetry.losses[:] = [loss for loss in telemetry.losses if loss.lost]
    for fate in unseen:
        if not quality.excludes(fate.unaccounted / len(fate.stream)):
            fate.missed = min(fate.unaccounted, quality.may_have_missed(len(fate.stream), sure))
        fate.unaccounted -= fate.missed


def _leave_quiet(known: Known, telemetry: Telemetry) -> None:
    """Take back what is missing where nothing at all was captured, and nobody shows whether it was there."""
    for loss in telemetry.losses if known.quiet else ():
        among = loss.among
        if loss.kind in _UNEXPLAINED and among is not None and among.missing is not None:
            times = known.captured(among.stream)
            inside = np.zeros(len(among.rows), bool)
            for start_ns, end_ns in known.quiet:
                behind = np.minimum(among.rows + 1, len(times) - 1)
                inside |= (times[among.rows] <= start_ns) & (times[behind] >= end_ns)
            _take_back(telemetry, loss, min(loss.lost, int(among.missing[inside].sum())))
    telemetry.losses[:] = [loss for loss in telemetry.losses if loss.lost]


def _take_back(telemetry: Telemetry, loss: Loss, number: int) -> None:
    loss.lost -= number
    key = id(loss.stream)
    telemetry.uncertain[key] = telemetry.uncertain.get(key, 0) + number
