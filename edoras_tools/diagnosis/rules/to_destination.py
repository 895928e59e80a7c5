"""Telemetry Output sends to one address at a time: it was told another than where the ground listens."""

from __future__ import annotations

from ipaddress import AddressValueError, IPv4Address
from itertools import pairwise
from typing import TYPE_CHECKING

from edoras_tools.cfs import telemetry_output
from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.links.ci import CI
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.evidence.payloads import OutputCommand

ID = "to_destination"


def judge(case: Case) -> Iterator[Verdict]:
    """Go through the enable commands: addresses that are none, and addresses that change."""
    rows = case.rows
    enables = [
        item
        for item in case.payloads.output
        if item.function_code == telemetry_output.ENABLE and rows.link[item.row] == CI
    ]
    for item in enables:
        if not is_address(item.address):
            yield _no_address(case, item)
    by_target: dict[int, list[OutputCommand]] = {}
    for item in enables:
        if is_address(item.address):
            by_target.setdefault(int(rows.destination[item.row]), []).append(item)
    for members in by_target.values():
        if len({item.address for item in members}) > 1:
            yield _fight(case, members)


def is_address(text: str) -> bool:
    """Tell whether a text is an IPv4 address."""
    try:
        IPv4Address(text)
    except AddressValueError:
        return False
    return True


def _no_address(case: Case, item: OutputCommand) -> Verdict:
    start_ns = int(case.rows.time_ns[item.row])
    said = [
        record
        for record in case.said(start_ns, start_ns + 2 * SECOND, telemetry_output.NAME)
        if telemetry_output.ENABLED.phrase in record.message
    ]
    return Verdict(
        ID,
        Severity.WARNING,
        f"Telemetry Output was enabled for {item.address!r}, which is no address: where it sends then is up "
        "to the flight host",
        msg_id=case.of_known(telemetry_output.COMMAND_MSG_ID),
        link="ci",
        hop="TO_LAB_APP",
        start_ns=start_ns,
        end_ns=start_ns,
        evidence=(
            f"packet {case.rows.number[item.row]} at {case.at(start_ns)}, {case.rows.length[item.row]} bytes",
            *(f"cFS said: {record}" for record in said[:1]),
        ),
        remedy="send the whole char[16]: 24 bytes in all",
    )


def _fight(case: Case, members: list[OutputCommand]) -> Verdict:
    rows = case.rows
    times = [int(rows.time_ns[item.row]) for item in members]
    steps = [f"{case.at(time_ns)} {item.address}" for time_ns, item in zip(times, members, strict=True)]
    senders = {case.endpoints[rows.source[item.row]].address for item in members}
    changes = sum(a.address != b.address for a, b in pairwise(members))
    fighting = changes > 1
    return Verdict(
        ID,
        Severity.WARNING,
        (
            f"two ground stations fight over Telemetry Output: it was redirected {changes} times, and sends "
            "to one address at a time"
            if fighting
            else "Telemetry Output was redirected: the first ground station gets nothing from then on"
        ),
        msg_id=case.of_known(telemetry_output.COMMAND_MSG_ID),
        link="to",
        hop="TO_LAB_APP",
        start_ns=times[0],
        end_ns=times[-1],
        evidence=(
            f"enabled from: {', '.join(sorted(senders))}",
            "enabled for: " + ", ".join(steps[:8]) + (", ..." if len(steps) > 8 else ""),
        ),
        remedy="enable TO from one station only, and fan its telemetry out from there (edoras proxy)",
    )
