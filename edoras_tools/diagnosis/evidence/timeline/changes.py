"""Derives state changes from commands, events, boots and traffic: of a cFS, its applications and peers.

Rules:

1. A command takes effect within ``_SLACK_NS``. A command that ends an application takes effect within
   ``_ENDS_NS``, because cFS kills an application that does not end by itself. Without an answer it is not
   sure.
2. The state that an event reports had begun when the event was made. The event confirms the command in front
   of it.
3. A boot ends every state: cFS runs, Telemetry Output sends nothing, and its table is that of the start.
4. A Telemetry Output that is restarted has lost its destination and all changes of its table.
5. A peer is connected, silent, timed out or disconnected as in :class:`Network`. It is also silent from its
   last datagram to its restart, if nobody timed it out.
6. A peer is subscribed to the MsgIds in its SUB messages of the present connection, and to what it is sent.
   A connection begins without subscriptions; so does a cFS that restarted.
"""

from __future__ import annotations

import re
from bisect import bisect_left
from functools import cached_property
from operator import attrgetter
from typing import TYPE_CHECKING, Final

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.cfs import executive_services, sbn, software_bus, telemetry_output, time_services
from edoras_tools.cfs.arguments import SB_MSG_ID, TIME_MSG_ID
from edoras_tools.cfs.names import housekeeping_of
from edoras_tools.diagnosis.evidence.peers import ALREADY, SAID_GOODBYE, Connection, Network
from edoras_tools.diagnosis.evidence.timeline.table import EVERY, NEVER, Change, StateOwner
from edoras_tools.model import Finding
from edoras_tools.units import SECOND
from edoras_tools.wire.arrays import Mask, distinct, numbered
from edoras_tools.wire.sbn import MsgType

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from edoras_tools.diagnosis.evidence.clocks.steady import Jump
    from edoras_tools.diagnosis.evidence.instances import Instances
    from edoras_tools.diagnosis.evidence.payloads import CommandRecord, EventRecord, Payloads
    from edoras_tools.diagnosis.evidence.table import Rows


_SLACK_NS: Final = 2 * SECOND
_ENDS_NS: Final = 10 * SECOND
_ROUND_NS: Final = SECOND
_TIME: Final = attrgetter("time_ns")
_CLOCK: Final = StateOwner("clock")
_OUTPUT: Final = StateOwner("output")
_ALL_ENTRIES: Final = StateOwner("entry")
_APP_EVENTS: Final = (
    ("running", re.compile(r"Started (\S+) from")),
    # An application may end by itself; and cFS may be unable to clean up all its resources.
    ("stopped", re.compile(r"(?:Stop|Exit) Application (\S+) (?:Completed|Failed: CleanUpApp)")),
    ("restarting", re.compile(r"(?:Restart|Reload) Application (\S+) Completed")),
)
_APP_STATES: Final = {
    executive_services.START_APP: "running",
    executive_services.STOP_APP: "stopped",
    executive_services.RESTART_APP: "restarting",
    executive_services.RELOAD_APP: "restarting",
}


class SoftwareChanges(msgspec.Struct, dict=True):
    """Derives the changes of each cFS from its commands, events and boots.

    Attributes:
        jumps: measured steps of clocks that were set.
        resets: restarts of a cFS whose clock went on: instance, earliest and latest time in ns.
    """

    _rows: Rows
    _payloads: Payloads
    _instances: Instances
    jumps: Sequence[Jump]
    resets: Sequence[tuple[int, int, int]]

    def changes(self) -> Iterator[Change]:
        """Yield all changes: of commands, then of events, then of boots."""
        for command in self._payloads.commands:
            yield from self._command(command)
        for event in self._payloads.events:
            yield from self._event(event)
        yield from self._boots()

    def _command(self, command: CommandRecord) -> Iterator[Change]:
        system = self._instances.system_at(int(self._rows.destination[command.row]), command.time_ns)
        values, code = command.values, command.function_code

        def change(subject: StateOwner, state: str, value: int | str | None = None) -> Change:
            span = command.time_ns, command.time_ns + _SLACK_NS
            return Change(system, subject, state, *span, str(command), (command.row,), value, sure=False)

        if command.msg_id == executive_services.COMMAND_MSG_ID:
            yield from self._executive(command, change(_CLOCK, ""))
        elif not command.is_whole and command.entry < 0:
            return  # its arguments are cut off
        elif command.msg_id == telemetry_output.COMMAND_MSG_ID:
            entry = StateOwner("entry", "", command.entry)
            if code == telemetry_output.ENABLE:
                yield change(_OUTPUT, "enabled", values["address"])
            elif code == telemetry_output.ADD_PACKET:
                # What is subscribed already keeps its limit.
                text = f"Duplicate Subscription,MsgId 0x{command.entry:x} on {telemetry_output.PIPE} "
                before = {item.entry for item in self._removals if item.time_ns < command.time_ns}
                if before & {-1, command.entry} or not self._answered(command, text):
                    yield change(entry, "subscribed", self._limit(command))
            elif code == telemetry_output.REMOVE_PACKET:
                yield change(entry, "unsubscribed")
            elif code == telemetry_output.REMOVE_ALL:
                yield change(_ALL_ENTRIES, "unsubscribed")
        elif command.msg_id == SB_MSG_ID and code in {software_bus.ENABLE_ROUTE, software_bus.DISABLE_ROUTE}:
            route = StateOwner("route", "", values["msg_id"] & 0xFFFF)
            yield change(route, "cut" if code == software_bus.DISABLE_ROUTE else "subscribed")
        elif command.msg_id == TIME_MSG_ID and code in time_services.SETS:
            yield self._clock(command, change(_CLOCK, "set"))

    @cached_property
    def _removals(self) -> Sequence[CommandRecord]:
        return self._payloads.outputs(telemetry_output.REMOVE_PACKET, telemetry_output.REMOVE_ALL)

    def _answers(self, command: CommandRecord) -> Sequence[EventRecord]:
        """Return the events soon after a command."""
        events, until_ns = self._payloads.events, command.time_ns + _SLACK_NS
        first, end = (bisect_left(events, when, key=_TIME) for when in (command.time_ns, until_ns))
        return events[first:end]

    def _answered(self, command: CommandRecord, words: str) -> bool:
        """Return whether an event soon after a command contains some words."""
        return any(words in item.message for item in self._answers(command))

    def _limit(self, command: CommandRecord) -> int | None:
        """Return the limit of an added entry: by an event, as builds lay the command out differently."""
        texts = (telemetry_output.ADDED.pattern.fullmatch(item.message) for item in self._answers(command))
        limits = (int(it["limit"]) for it in texts if it and int(it["msg_id"], 16) == command.entry)
        return next(limits, command.values.get("limit"))

    def _executive(self, command: CommandRecord, pattern: Change) -> Iterator[Change]:
        state = _APP_STATES.get(command.function_code)
        app = command.app
        words = f"0x{command.msg_id:04X},  CC = {command.function_code}, Len"
        if state is None or not app or self._answered(command, words):  # wrong length
            return
        if state == "running" and self._answered(command, f"Failed to start {app} from"):
            mine = (item.time_ns for item in self._payloads.about_apps() if item.app == app)
            if not any(0 < when - command.time_ns < _SLACK_NS for when in mine):
                return  # it had not ended yet
        change = replace(pattern, subject=StateOwner("app", app), state=state)
        is_output = app in telemetry_output.NAMES
        if state != "running":
            change = replace(change, not_after_ns=change.not_before_ns + _ENDS_NS)
            change = self._silenced(change) if is_output else change
        yield change
        if state == "restarting":
            low = change.not_before_ns if change.sure else change.not_after_ns
            high = change.not_before_ns + _ENDS_NS
            yield replace(change, state="running", not_before_ns=low, not_after_ns=high, sure=False)
        if is_output:
            yield replace(change, subject=_OUTPUT, state="disabled")
            yield replace(change, subject=_ALL_ENTRIES, state="as at the start")

    def _asked_ns(self, app: str, ended_ns: int, system: int) -> int:
        """Return the earliest time, ns, at which an application that ended by ``ended_ns`` may have ended.

        That is 10 s before, or directly behind its last earlier command or housekeeping packet.
        """
        own = np.isin(self._rows.known_id, housekeeping_of(app)) & (self._instances.system_of_row == system)
        made_ns = self._instances.made_ns[own]
        times = [item.time_ns for item in self._payloads.about_apps() if item.app == app]
        times += made_ns[made_ns < ended_ns - _ROUND_NS].tolist()
        return max([ended_ns - _ENDS_NS, *(when + 1 for when in times if when < ended_ns)])

    def _silenced(self, change: Change) -> Change:
        """Return the change of an ended Telemetry Output, from its last packet on if it fell silent."""
        rows, told_ns = self._rows, change.not_before_ns
        own = rows.on(lambda link: link.only_from_cfs) & (rows.time_ns > told_ns - _ROUND_NS)
        times = np.append(rows.time_ns[own & (self._instances.system_of_row == change.system)], NEVER)
        quiet = times[:-1][np.diff(times) > _SLACK_NS]
        if not len(quiet) or quiet[0] >= told_ns + _ENDS_NS:
            return change
        low, witness = max(int(quiet[0]), told_ns), f"{change.witness}; it sent nothing more"
        return replace(change, not_before_ns=low, not_after_ns=low + _ROUND_NS, witness=witness, sure=True)

    def _clock(self, command: CommandRecord, change: Change) -> Change:
        """Return the change of a set clock, with the step in ns if the command or a measurement shows it."""
        low, high = change.not_before_ns - _ROUND_NS, change.not_after_ns + _ROUND_NS
        setting = time_services.SETTING.get(command.function_code)
        if setting and setting.sign and not setting.each_second:
            micros = command.values["seconds"] * 10**6 + command.values["microseconds"]
            return replace(change, value=setting.sign * micros * 1000)
        own = [item for item in self.jumps if item.clock != "capture"]
        measured = [item for item in own if low <= int(self._rows.time_ns[item.row]) <= high]
        return replace(change, value=measured[0].by_ns) if len(measured) == 1 else change

    def _event(self, event: EventRecord) -> Iterator[Change]:
        if event.app != executive_services.NAME and event.app not in telemetry_output.NAMES:
            return
        made_ns = int(self._instances.made_ns[event.row])
        system = self._instances.system(self._instances.saying(event))
        witness = f"event {event}"

        def change(subject: StateOwner, state: str, value: int | str | None = None) -> Change:
            return Change(system, subject, state, made_ns - _ROUND_NS, made_ns, witness, (event.row,), value)

        if event.app == executive_services.NAME:
            for state, pattern in _APP_EVENTS:
                if match := pattern.search(event.message):
                    result = change(StateOwner("app", match[1]), state)
                    # An application reads no more for some time before it is said to have ended.
                    asked_ns = self._asked_ns(match[1], made_ns, system)
                    yield result if state == "running" else replace(result, not_before_ns=asked_ns)
                    if state == "restarting":
                        low_ns = max(result.not_before_ns, asked_ns)
                        yield replace(result, state="running", not_before_ns=low_ns)
        elif enabled := telemetry_output.ENABLED.pattern.fullmatch(event.message):
            yield change(_OUTPUT, "enabled", enabled["address"])
        elif telemetry_output.SUPPRESSED.phrase in event.message:
            yield change(_OUTPUT, "suppressed")

    def _boots(self) -> Iterator[Change]:
        items, systems = self._instances.items, self._instances.systems
        last: dict[int, int] = {}
        for at in sorted(range(len(items)), key=lambda item: items[item].first_ns):
            system, item = systems[at], items[at]
            if system in last and last[system] < item.first_ns:
                yield from _boot(system, last[system], item.first_ns, "its clock and counts began anew")
            last[system] = max(last.get(system, 0), item.last_ns)
        for instance, start_ns, end_ns in self.resets:
            yield from _boot(self._instances.system(instance), start_ns, end_ns, "its counts began anew")


def _boot(system: int, low_ns: int, high_ns: int, witness: str) -> Iterator[Change]:
    """Yield the changes of a boot: cFS goes down, Telemetry Output is reset, and cFS runs again."""
    subjects = StateOwner("cfs"), _OUTPUT, _ALL_ENTRIES, StateOwner("cfs")
    states = "down", "disabled", "as at the start", "running"
    for subject, state in zip(subjects, states, strict=True):
        yield Change(system, subject, state, low_ns, high_ns, witness)


_WAKE_NS: Final = SECOND


def network_changes(
    rows: Rows, payloads: Payloads, instances: Instances, network: Network, software: Sequence[Change]
) -> Iterator[Change]:
    """Yield the changes of every SBN peer and its subscriptions, as each cFS sees them.

    Args:
        rows: table of datagrams.
        payloads: contents of SUB and UNSUB messages.
        instances: instances of cFS.
        network: connections of all peers.
        software: changes of each cFS and its applications.
    """
    pairs = [*zip(instances.items, instances.systems, strict=True)][::-1]
    systems = {(item.name, item.host): system for item, system in pairs}
    for (_, observer), connection in network.connections.items():
        system = systems.get(observer, 0)
        yield from _peer(connection, system, int(rows.time_ns[0]))
        speaks = [place for place in distinct(rows.source).tolist() if network.party(place) == observer]
        yield from _goodbyes(rows, np.isin(rows.source, speaks), connection, system, software)
        ended_ns = [item.not_before_ns for item in software if (item.state, item.system) == ("down", system)]
        yield from _subscriptions(rows, payloads, connection, system, ended_ns)


def capture_changes(away: Sequence[tuple[int, int]]) -> Iterator[Change]:
    """Yield the changes of the capture: begin and end of each span in which it could not record.

    Args:
        away: spans (start, end), ns.
    """
    for start_ns, end_ns in away:
        for state, when in (("away", start_ns), ("back", end_ns)):
            yield Change(EVERY, StateOwner("capture"), state, when, when, "nothing was captured meanwhile")


def _peer(connection: Connection, system: int, begin_ns: int) -> Iterator[Change]:
    """Yield the changes of a peer."""
    subject = StateOwner("peer", connection.peer)
    if connection.changes and connection.changes[0].why != ALREADY:
        yield Change(system, subject, "disconnected", begin_ns, begin_ns, "cFS heard nothing of it before")
    for item in connection.changes:
        yield Change(system, subject, item.state, item.time_ns, item.time_ns + _WAKE_NS, item.why)
    for last_ns, dead_ns, back_ns, (last, first), _ in connection.restarts:
        text = f"nothing from it for {(back_ns - last_ns) / SECOND:.1f} s, then it subscribed anew"
        yield Change(system, subject, "silent", last_ns, dead_ns, text, (last,))
        yield Change(system, subject, "connected", back_ns, back_ns, "it subscribed anew", (first,))


def _goodbyes(
    rows: Rows, speaks: Mask, connection: Connection, system: int, software: Sequence[Change]
) -> Iterator[Change]:
    """Yield the changes of a cFS's SBN application that ended after a DISCONNECT to its peer.

    Args:
        rows: table of datagrams.
        speaks: bool (rows,), the datagram is from the observer, whose SBN it is.
        connection: connection of the peer.
        system: number of the observer.
        software: changes of each cFS and its applications, which show whether SBN was commanded to end.
    """
    subject, changes = StateOwner("app", sbn.NAME), connection.changes
    speaks = speaks & (rows.sbn_msg_type >= 0)
    # It leaves one peer after the other.
    words = np.flatnonzero(speaks & (rows.sbn_msg_type != MsgType.DISCONNECT))
    said_ns, greets = rows.time_ns[words], np.isin(rows.sbn_msg_type[words], (MsgType.PROTO, MsgType.SUB))
    own = [item for item in software if (item.system, item.subject) == (system, subject)]
    ends_ns = [item.not_before_ns for item in own if item.state != "running"]
    sure = [(item.not_before_ns - _ENDS_NS, item.not_after_ns) for item in own if item.sure]
    for when in (item.time_ns for item in changes if item.why == SAID_GOODBYE):
        # What it had sent before may come late; what starts greets its peers.
        later = said_ns[(said_ns > when) & (greets | (said_ns - when > _SLACK_NS))][:1].tolist()
        if not later or later[0] - when > _SLACK_NS:
            is_commanded = any(0 <= when - asked_ns <= _ENDS_NS for asked_ns in ends_ns)
            text = "it sent its peer DISCONNECT, and then nothing"
            state = "stopped" if later or is_commanded else "failed"
            # Commands and events are better witnesses of an end than its peers; but who speaks runs.
            if not any(low <= when <= high for low, high in sure):
                yield Change(system, subject, state, when, when, text)
            for back_ns in later:
                yield Change(system, subject, "running", back_ns, back_ns, "it speaks to its peers again")


def _subscriptions(
    rows: Rows, payloads: Payloads, connection: Connection, system: int, ended_ns: Sequence[int]
) -> Iterator[Change]:
    """Yield the changes of a peer's subscriptions: by its messages, and by what the observer sends to it.

    Args:
        rows: table of datagrams.
        payloads: contents of SUB and UNSUB messages.
        connection: connection of the peer.
        system: number of the observer.
        ended_ns: last times before boots of the observer, which forgets the lists of its peers.
    """
    peer, changes, listed = connection.peer, connection.changes, payloads.subscriptions
    sent, said_ns = connection.sent[rows.sbn_msg_type[connection.sent] == MsgType.APP], connection.said_ns
    own, theirs = (np.isin(listed["row"], some) for some in (connection.heard, connection.sent))
    idents = {payloads.contents[index].ident for index in listed["said"][theirs].tolist()}
    # The observer refuses a list with another $Id than its own.
    own &= np.array([not idents or item.ident in idents for item in payloads.contents], bool)[listed["said"]]
    at, contents = listed["row"][own], listed["said"][own]
    # A message that does not connect its peer was not heard.
    near_ns = np.add.outer((0, _WAKE_NS), rows.time_ns[at])
    place = np.searchsorted([item.time_ns for item in changes], near_ns, "right")
    heard = np.array([False, *(item.state in {"connected", "silent"} for item in changes)])[place].any(axis=0)
    at, contents = at[heard], contents[heard]
    begins = [item.time_ns for item in changes if item.state == "connected" and item.why != ALREADY]
    begins += [ns for last_ns in ended_ns for ns in said_ns[said_ns > last_ns + SECOND][:1].tolist()]
    begins.sort()
    unsubscribed = rows.sbn_msg_type[at] == MsgType.UNSUB
    # A bridge repeats its messages twice a second. So only the first of each content counts: in each
    # connection, and again behind each UNSUB.
    left_ns = np.array([0, *(item.time_ns for item in changes if item.state == "disconnected"), NEVER])
    until_ns = np.minimum(rows.time_ns[at] + _WAKE_NS, left_ns[np.searchsorted(left_ns, rows.time_ns[at])])
    session = np.searchsorted(begins, until_ns, "right")
    first, _ = numbered(session, contents, np.cumsum(unsubscribed), unsubscribed)
    passed, _ = numbered(np.searchsorted(begins, rows.time_ns[sent], "right"), rows.msg_id[sent])
    news = [(row, int(rows.msg_id[row]), "message to") for row in sent[passed].tolist()]
    for place in first.tolist():
        verb = "UNSUB of" if unsubscribed[place] else "SUB of"
        news += [(int(at[place]), msg_id, verb) for msg_id in payloads.contents[contents[place]].wanted]
    for row, msg_id, verb in news:
        now, state = int(rows.time_ns[row]), "unsubscribed" if verb == "UNSUB of" else "subscribed"
        subject, text = StateOwner("subscription", peer, msg_id), f"{verb} {peer} for 0x{msg_id:04x}"
        yield Change(system, subject, state, now, now + _WAKE_NS, text, (row,))
    text = f"{peer} was connected and had not subscribed to it"
    msg_ids, news_ns = np.array([item[1] for item in news]), rows.time_ns[[item[0] for item in news]]
    lists = np.isin(rows.sbn_msg_type[connection.heard], (MsgType.SUB, MsgType.UNSUB))
    is_cut = (lists & rows.has(Finding.CAPTURE_CUT, connection.heard)).any()  # the rest may name it
    for since in () if is_cut else begins:
        before = left_ns[np.searchsorted(left_ns, since) - 1]
        soon = msg_ids[(np.abs(news_ns - since) <= _WAKE_NS) & (news_ns > before)]
        for msg_id in {*msg_ids.tolist()}.difference(soon.tolist()):
            subject = StateOwner("subscription", peer, msg_id)
            yield Change(system, subject, "unsubscribed", since, since + _WAKE_NS, text)
