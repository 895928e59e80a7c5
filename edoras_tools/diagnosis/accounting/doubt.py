"""What may be lost, or only not captured: what no counter explains and the capture itself may have missed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from edoras_tools.diagnosis.accounting.claims import shares

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.diagnosis.accounting.bus import Telemetry
    from edoras_tools.diagnosis.accounting.fates import Fate
    from edoras_tools.diagnosis.accounting.losses import Known
    from edoras_tools.diagnosis.quality import Quality

_UNEXPLAINED: Final = frozenset({"after", "unknown", "fragments"})


def doubt(known: Known, telemetry: Telemetry, fates: Sequence[Fate], quality: Quality) -> None:
    """Take losses back that the capture may have missed: they become uncertain.

    None does where a capture that misses such a share, of all or of one traffic, would show it; nor what came
    over TCP, where the bytes themselves tell what the capture lacks.

    Args:
        telemetry: its losses become fewer, and are counted as uncertain there.
        fates: likewise what is unaccounted for.
    """
    streamed = known.rows.streamed
    gaps = [
        loss
        for loss in telemetry.losses
        if loss.kind in _UNEXPLAINED and loss.stream and not streamed[loss.stream.rows[0]]
    ]
    unseen = [fate for fate in fates if fate.seen and fate.unaccounted]
    missing = sum(loss.lost for loss in gaps)
    sent = sum(len(stream) for stream in known.streams) + missing
    missing += sum(fate.unaccounted for fate in unseen)
    if not missing or quality.excludes(missing / sent):
        return
    for stream in {id(loss.stream): loss.stream for loss in gaps}.values():
        own = [loss for loss in gaps if loss.stream is stream]
        most = [loss.lost for loss in own]
        number = _doubtful(sum(most), sum(loss.of or loss.lost for loss in own), quality)
        for loss, share in zip(own, shares(number, most, most), strict=True):
            loss.lost -= share
        telemetry.uncertain[id(stream)] = telemetry.uncertain.get(id(stream), 0) + number
    telemetry.losses[:] = [loss for loss in telemetry.losses if loss.lost]
    for fate in unseen:
        fate.missed = _doubtful(fate.unaccounted, len(fate.stream), quality)
        fate.unaccounted -= fate.missed


def _doubtful(missing: int, of: int, quality: Quality) -> int:
    """Return how many of the missing ones the capture may have missed."""
    return 0 if quality.excludes(missing / of) else min(missing, quality.may_have_missed(of))
