"""Which hop limits a route, and why, from the account of a step that lost something."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from edoras_tools.pipelines.sweep_evidence import Culprit
from edoras_tools.sessions import command_ingest, software_bus, telemetry_output
from edoras_tools.sessions.profile import MILLISECOND, SECOND, SimProfile
from edoras_tools.wire.limits import CI_BUFFER, SOFTWARE_BUS_MAXIMUM

if TYPE_CHECKING:
    from edoras_tools.pipelines.sweep_evidence import Account

_STOCK: Final = SimProfile()
_PEER_PIPE: Final = re.compile(r"SBN_\d+_\d+_Pipe")
_NETWORK: Final = "network"


def verdict(account: Account, rate_hz: float, msg_id: int, way_out: str = "") -> tuple[str, str]:
    """Return the limiting hop and the reason.

    How many messages a wake-up takes is measured, not assumed: what got through a second, times the period.

    Args:
        account: of a step that lost something.
        rate_hz: messages a second in that step.
        msg_id: of the route.
        way_out: the pipe that telemetry leaves cFS by; events about it go through it as well.
    """
    through_hz = rate_hz * account.delivered / account.sent if account.sent else 0.0
    if account.culprit is not None:
        return _named(account.culprit, through_hz)
    if account.not_ingested:
        return command_ingest.NAME, (
            f"{command_ingest.NAME} reads {_STOCK.ci_datagrams_per_wake} datagrams per "
            f"{_ms(_STOCK.ci_wake_ns)} wake-up, and its socket is full: {account.not_ingested:,} never read"
        )
    if account.altered and account.differs_at is not None:
        what = "cuts a datagram to" if account.differs_at == CI_BUFFER else "keeps the first"
        return command_ingest.NAME, (
            f"{command_ingest.NAME} {what} {account.differs_at} bytes, and accepts it silently: "
            "the echo differs from there on"
        )
    if account.altered:
        return _NETWORK, f"{account.altered:,} came with another length than they were published with"
    if way_out and account.gaps and account.overflows:
        hop, reason = _named(Culprit(software_bus.PIPE_OVERFLOW, msg_id, way_out, ""), through_hz)
        return hop, f"{reason}; the events about it were lost in it too"
    if account.bus:
        return software_bus.SOFTWARE_BUS, f"its loss counters rose by {account.bus:,}; no event named a pipe"
    if account.gaps:
        return _NETWORK, (
            f"{account.gaps:,} sequence counts are missing, and cFS counted no loss: lost on the way here"
        )
    return "unknown", f"{account.unseen:,} of 0x{msg_id:04x} never came, and nothing that cFS says tells why"


def _named(culprit: Culprit, through_hz: float) -> tuple[str, str]:
    name = f"0x{culprit.msg_id:04x}"
    if culprit.event_id == software_bus.NO_SUBSCRIBERS:
        return software_bus.SOFTWARE_BUS, f"nobody on cFS subscribes to {name}, says the software bus"
    if culprit.event_id == software_bus.MSG_TOO_BIG:
        return software_bus.SOFTWARE_BUS, (
            f"the software bus takes {SOFTWARE_BUS_MAXIMUM:,} bytes at most, says its event"
        )
    wake_ns, whose = _wake(culprit)
    limit = culprit.event_id == software_bus.MSG_LIMIT
    if not wake_ns:
        kind = f"message limit of {name}" if limit else "pipe overflow"
        return culprit.pipe, f"{culprit.pipe} {kind}, sent by {culprit.sender}"
    taken = _per(through_hz, wake_ns)
    if limit:
        return culprit.pipe, f"{culprit.pipe} limit {taken} per {_ms(wake_ns)} wake-up{whose}"
    return culprit.pipe, (
        f"{culprit.pipe} full: about {taken} of {name} per {_ms(wake_ns)} wake-up{whose}, "
        "beside what else goes through it"
    )


def _wake(culprit: Culprit) -> tuple[int, str]:
    """Return the period that empties or fills a pipe, 0 where it is not known, and whose it is."""
    if culprit.pipe == telemetry_output.PIPE:
        return _STOCK.to_wake_ns, ""
    if _PEER_PIPE.fullmatch(culprit.pipe):
        return _STOCK.sbn_wake_ns, ""
    if culprit.sender == command_ingest.NAME:
        return _STOCK.ci_wake_ns, f" of {command_ingest.NAME}"
    return 0, ""


def _per(rate_hz: float, period_ns: int) -> int:
    return max(1, round(rate_hz * period_ns / SECOND))


def _ms(period_ns: int) -> str:
    return f"{period_ns // MILLISECOND} ms"
