"""Telemetry Output was told to send less, or forgot where to: what was published meanwhile is missing."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from edoras_tools.cfs import telemetry_output
from edoras_tools.cfs.commands import ENABLE_OUTPUT
from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.links.to import TO
from edoras_tools.units import SECOND
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "to_stopped"


def judge(case: Case) -> Iterator[Verdict]:
    """Name each command that stops telemetry, and what sequence counts show to be missing for all of them."""
    rows = case.rows
    lost = [loss for loss in case.losses if loss.closed]
    missing = sum(case.telemetry.closed.get(id(stream), 0) for stream in case.streams if stream.link is TO)
    missing += sum(loss.lost for loss in lost)
    counted = f"{plural(missing, 'message')} that were published meanwhile were not sent"

    def told(when: int) -> dict[str, Any]:
        """Return the lost, of those that this stop explains first, and what is known of all."""
        here = [loss for loss in lost if loss.start_ns - SECOND <= when <= loss.end_ns + SECOND]
        for loss in here:
            lost.remove(loss)
        number = sum(loss.lost for loss in here)
        known = [f"sequence counts: {counted}"] if missing else []
        if number:
            known.append(
                f"0x803 counts {number:,} of them lost at {telemetry_output.PIPE}, which nobody emptied: "
                "lost, though Telemetry Output would not have sent them either"
            )
        return {"lost": number or None, "evidence": tuple(known)}

    for item in case.payloads.output:
        if item.function_code not in telemetry_output.STOPS:
            continue
        when = int(rows.time_ns[item.row])
        what = "every MsgId" if item.msg_id < 0 else case.name(item.msg_id)
        known = told(when)
        yield Verdict(
            ID,
            Severity.WARNING,
            f"Telemetry Output was told to stop sending {what} at {case.at(when)}",
            msg_id=item.msg_id if item.msg_id >= 0 else None,
            topic=case.topic(item.msg_id) if item.msg_id >= 0 else None,
            link="to",
            hop=telemetry_output.NAME,
            start_ns=when,
            end_ns=when,
            lost=known["lost"],
            evidence=(
                (
                    f"packet {rows.number[item.row]}: {rows.msg_id[item.row]:#06x}, function code "
                    f"{item.function_code}, from {case.endpoints[rows.source[item.row]].address}"
                ),
                *known["evidence"],
            ),
            remedy=f"add it again: {case.inject('to-add', f'0x{item.msg_id:04x}')}"
            if item.msg_id >= 0
            else f"add what is wanted again, e.g. {case.inject('to-add', f'0x{case.of_known(0x0803):04x}')}",
        )
    streams = [stream for stream in case.streams if stream.link is TO]
    moved = sorted(
        {
            int(rows.time_ns[stream.rows[at + 1]])
            for stream in streams
            for at in (rows.source[stream.rows][1:] != rows.source[stream.rows][:-1]).nonzero()[0].tolist()
        }
    )
    if moved:
        yield Verdict(
            ID,
            Severity.WARNING,
            f"Telemetry Output sends from another port at {case.at(moved[0])}: it was restarted, and forgot "
            "that it was enabled",
            link="to",
            hop=telemetry_output.NAME,
            start_ns=moved[0],
            end_ns=moved[0],
            **told(moved[0]),
            remedy=f"enable it again: {case.inject(ENABLE_OUTPUT)}",
        )
    for sender, spans in case.telemetry.silences.items():
        number = sum(case.telemetry.silenced.get(id(item), 0) for item in streams if item.sender == sender)
        for start_ns, end_ns in spans if number else ():
            failed = case.suppressed((start_ns, end_ns))
            yield Verdict(
                ID,
                Severity.ERROR if failed else Severity.WARNING,
                f"Telemetry Output sent nothing from {case.at(start_ns)} to {case.at(end_ns)}, until it was "
                "enabled: "
                + ("its socket failed" if failed else "its socket failed, or it sent to another address"),
                link="to",
                hop=telemetry_output.SOCKET,
                lost=number if failed and len(spans) == 1 else None,
                start_ns=start_ns,
                end_ns=end_ns,
                evidence=(
                    f"sequence counts: {plural(number, 'message')} that the software bus did not lose",
                    *((f"event {failed}",) if failed else ()),
                ),
                remedy="look at the address that it was enabled for; after an error of its socket Telemetry "
                f"Output drops what comes until it is enabled again: {case.inject(ENABLE_OUTPUT)}",
                confidence="high" if failed else "medium",
            )
