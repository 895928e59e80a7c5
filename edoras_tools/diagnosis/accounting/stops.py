"""What was sent to an application that did not run, and what nobody can follow after it was started again.

Rules:

1. Where it can be seen what comes out: from what arrived last before the stop to what arrives first after it,
   nothing arrived.
2. Elsewhere what was sent after its end, and before the command that starts it again, is lost, if this
   application surely takes it: events name its pipe for the MsgId, or there is one application that stopped
   and one such MsgId. What was sent just before either may have been taken, and so may all that is sent while
   one restarts: no event tells when it ended.
3. Elsewhere it is unaccounted for what was sent since the first stop and is not lost by rule 2: whether an
   application that was started again took it, or whether it was for the one that stopped, nothing shows.
   So it is after a command that stops one, where no event that answers it can be read.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.cfs import command_ingest, executive_services, names, telemetry_output
from edoras_tools.diagnosis.accounting.fates import WAITS_NS, Fate, loss_of
from edoras_tools.diagnosis.accounting.losses import TAIL_NS, Known, Loss
from edoras_tools.model import NO_ROUTE
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Sequence


_LINKS: Final = frozenset({*command_ingest.NAMES, *telemetry_output.NAMES})
"""Applications whose stops other accounts follow: CI's by its counter, Telemetry Output's by its port."""


class Stops:
    """What was sent while applications did not run, and what nobody can follow.

    Attributes:
        losses: of what surely was lost so.
    """

    def __init__(self, known: Known, fates: Sequence[Fate]) -> None:
        self._known = known
        self._gone = [item for item in outages(known) if item.app not in _LINKS]
        self._texts: list[tuple[Outage, list[str]]] = []
        self.losses: list[Loss] = []
        self._fates = [
            fate
            for fate in fates
            if fate.stream.known_id not in names.MSG_ID_NAMES or fate.stream.route != NO_ROUTE
        ]
        for fate in self._fates:
            for item in self._gone if fate.seen else ():
                self._mark(fate, item)
            own = [item for item in self._gone if known.goes_to(fate.stream, item.instance)]
            if not own and not fate.seen:
                _asked(known, fate)
            if own and not fate.seen:
                alone = sum(not other.seen and other.stream.link is fate.stream.link for other in self._fates)
                self.losses += _unfollowed(known, fate, own, alone=alone == 1)

    def _mark(self, fate: Fate, item: Outage) -> None:
        """Mark the messages that an application that was stopped did not take (rule 1)."""
        times = self._known.captured(fate.stream)
        back = times[fate.arrived & (times > item.start_ns + WAITS_NS)]
        until_ns = int(back[0]) if len(back) else None
        inside = fate.open & (times > item.start_ns - WAITS_NS) & (fate.stop < 0)
        if until_ns is not None:
            inside &= times < until_ns
        # What arrived last was taken before it stopped.
        last = times[fate.arrived & (times <= item.start_ns + WAITS_NS)]
        inside &= times > (int(last[-1]) if len(last) else 0)
        if not inside.any():
            return
        evidence = [f"event {item.said}"]
        if item.end_ns is not None and (until_ns is None or until_ns > item.end_ns + TAIL_NS):
            evidence.append("it was started again, and nothing came out of it after that")
        fate.stop[inside] = len(self._texts)
        self._texts.append((item, evidence))

    def tell(self) -> None:
        """Make losses of what was marked and no counter counted."""
        for fate in self._fates:
            for place in np.unique(fate.stop[fate.open & (fate.stop >= 0)]).tolist():
                chosen = np.flatnonzero(fate.open & (fate.stop == place))
                fate.claim(chosen)
                item, evidence = self._texts[place]
                self.losses.append(loss_of(self._known, fate, "stopped", chosen, evidence, hop=item.app))


def _asked(known: Known, fate: Fate) -> None:
    """Mark what was sent after a command that stops an application, where no event says what came of it."""
    rows = known.rows
    said = [record.time_ns for record in known.payloads.events if record.app == executive_services.NAME]
    for item in known.payloads.executive:
        when, code = int(rows.time_ns[item.row]), item.function_code
        answered = any(0 <= told - when <= _COMMAND_NS for told in said)
        ends = code in executive_services.ENDS_APP and item.app not in _LINKS
        if ends and not answered and fate.stream.receiver == rows.destination[item.row]:
            fate.unfollowed = rows.time_ns[fate.stream.rows] > when
            fate.unfollowed_since = (
                f"packet {rows.number[item.row]}: {rows.msg_id[item.row]:#06x}, function code "
                f"{code}, for {item.app}; no event that answers it can be read here"
            )
            return


def _unfollowed(known: Known, fate: Fate, own: Sequence[Outage], *, alone: bool) -> list[Loss]:
    """Rules 2 and 3."""
    times = known.captured(fate.stream)
    pipes = {
        reported.pipe
        for reported in known.reported_losses
        if reported.at_pipe and reported.msg_id == fate.stream.msg_id and not reported.at_output
    }
    named = [item for item in own if any(pipe.startswith(item.app) for pipe in pipes)]
    surely = named or (own if alone and len({item.app for item in own}) == 1 else [])
    found = []
    for item in surely:
        inside = fate.open & (times > item.ended_ns)
        if item.end_ns is not None:
            inside &= times < item.asked_ns
        if (chosen := np.flatnonzero(inside)).size:
            fate.claim(chosen)
            found.append(loss_of(known, fate, "stopped", chosen, [f"event {item.said}"], hop=item.app))
    first = min(surely or own, key=lambda item: item.start_ns)
    fate.unfollowed = times > first.start_ns
    fate.unfollowed_since = f"event {first.said}"
    return found


_COMMAND_NS: Final = 10 * SECOND
"""An application that is told to stop may take so long."""
_NAMES: Final = {
    executive_services.STOPPED: re.compile(r"Stop Application (\S+) Completed"),
    executive_services.RESTARTED: re.compile(r"Restart Application (\S+) Completed"),
    executive_services.STARTED: re.compile(r"Started (\S+) from"),
}


@dataclass(frozen=True, slots=True)
class Outage:
    """A time in which an application did not run.

    Attributes:
        app: its name.
        start_ns: told to stop, or said to have.
        end_ns: said to have started again; None where it was not.
        ended_ns: it surely took nothing from then on,
        asked_ns: until then, where it started again: it was told to, or could take what CI had not read.
        said: the event that tells.
        instance: the cFS that it is of.
    """

    app: str
    start_ns: int
    end_ns: int | None
    ended_ns: int
    asked_ns: int
    said: str
    instance: int


def outages(known: Known) -> list[Outage]:
    """Return every stop and restart that events tell of."""
    found: list[Outage] = []
    for record in known.payloads.events:
        pattern = _NAMES.get(record.event_id) if record.app == executive_services.NAME else None
        told = pattern.search(record.message) if pattern else None
        if told is None:
            continue
        app, now = told.group(1), int(known.instances.made_ns[record.row])
        instance = known.instances.saying(record)
        asked = [
            item
            for item in known.payloads.executive
            if item.app == app and 0 <= record.time_ns - int(known.rows.time_ns[item.row]) <= _COMMAND_NS
        ]
        if record.event_id == executive_services.STARTED:
            started = [
                int(known.rows.time_ns[item.row])
                for item in asked
                if item.function_code == executive_services.START_APP
            ]
            if started and not any((item.app, item.instance) == (app, instance) for item in found):
                # It was stopped before the capture began, or never ran.
                began_ns = int(known.rows.time_ns[0]) - 1
                found.append(Outage(app, began_ns, None, began_ns, now, str(record), instance))
            asked_ns = min(started, default=now - WAITS_NS)
            found = [
                replace(item, end_ns=now, asked_ns=asked_ns)
                if (item.app, item.instance) == (app, instance) and item.end_ns is None
                else item
                for item in found
            ]
            continue
        end_ns = now if record.event_id == executive_services.RESTARTED else None
        told_ns = [int(known.rows.time_ns[item.row]) for item in asked]
        found.append(Outage(app, max(told_ns, default=now), end_ns, now, now, str(record), instance))
    return found
