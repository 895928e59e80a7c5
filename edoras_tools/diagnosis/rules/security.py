"""Who sends commands, and what nobody checks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.cfs.names import PRIVILEGED, command_name
from edoras_tools.diagnosis.verdict import Verdict, habit, security
from edoras_tools.links.ci import CI
from edoras_tools.links.sbn import SBN
from edoras_tools.links.to import TO
from edoras_tools.model import Finding, Peer
from edoras_tools.wire.arrays.order import by_value, groups, numbered
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.case import Case


def stranger_commands(case: Case) -> Iterator[Verdict]:
    """Commands from an address that telemetry never goes to: no ground station of this capture.

    Name every such address; silent where the capture shows no telemetry of that cFS.
    """
    rows = case.rows
    address = np.array([item.address for item in case.endpoints] or [""], object)
    down = rows.link == TO
    stations: dict[str, set[str]] = {}
    sources, destinations = rows.source[down], rows.destination[down]
    ways, _ = numbered(sources, destinations)
    for source, destination in zip(sources[ways].tolist(), destinations[ways].tolist(), strict=True):
        stations.setdefault(address[source], set()).add(address[destination])
    sent = sound_commands(case)
    by_way: dict[tuple[str, str], list[NDArray[np.intp]]] = {}
    for _, at in by_value(numbered(rows.source[sent], rows.destination[sent])[1]):
        row = sent[at[0]]
        way = address[rows.source[row]], address[rows.destination[row]]
        by_way.setdefault(way, []).append(sent[at])
    for (sender, target), parts in by_way.items():
        members = np.sort(np.concatenate(parts))
        known = stations.get(target)
        if not known or sender in known or sender == target:  # the flight host itself is no stranger
            continue
        kinds = members[numbered(rows.msg_id[members], rows.function_code[members])[0]].tolist()
        names = sorted({case.name(int(rows.msg_id[row])) for row in kinds})
        start_ns = int(rows.time_ns[members[0]])
        allowed = {text for row in kinds if (text := privilege(case, row))}
        yield security(
            f"{plural(len(members), 'command')} to CI at {target} from {sender}, to which no telemetry of it "
            "goes: CI obeys whoever reaches its port",
            f"packet {rows.number[members[0]]} at {case.at(start_ns)} is the first",
            f"telemetry goes to {', '.join(sorted(known))}",
            f"MsgIds: {', '.join(names[:6])}" + (", ..." if len(names) > 6 else ""),
            *(f"it could {text}" for text in sorted(allowed)),
            link="ci",
            hop="CI_LAB_APP",
            span=case.span(members),
            remedy="if it is a second ground station, nothing; else let only the station reach CI's port "
            "(a firewall, or authentication in front of CI)",
            confidence="medium",
        )


_UNSOUND_NETWORK = Finding.TRUNCATED | Finding.SBN_UNKNOWN_TYPE | Finding.SBN_SIZE_MISMATCH


def identity_from_two_addresses(case: Case) -> Iterator[Verdict]:
    """One SBN identity that speaks from two addresses.

    Name every identity that does: a receiver tells peers apart by it, never by their address.
    """
    rows = case.rows
    spoke = np.flatnonzero((rows.link == SBN) & (rows.sbn_msg_type >= 0) & ~rows.has(_UNSOUND_NETWORK))
    identity = rows.spacecraft_id.astype(np.uint64) << 32 | rows.processor_id
    for who, members in groups(identity, spoke):
        first: dict[str, int] = {}
        count: dict[str, int] = {}
        for source, own in groups(rows.source, members):
            address = case.endpoints[source].address
            first[address] = min(int(own[0]), first.get(address, int(own[0])))
            count[address] = count.get(address, 0) + len(own)
        if len(first) < 2:
            continue
        order = sorted(first, key=first.__getitem__)
        second = first[order[1]]
        yield security(
            f"SBN peer {Peer(who >> 32, who & 0xFFFFFFFF)} speaks from {len(order)} addresses: "
            f"{', '.join(order)}; cFS takes whatever bears its identity",
            *(
                f"{address}: {plural(count[address], 'datagram')}, the first at "
                f"{case.at(int(rows.time_ns[first[address]]))}"
                for address in order[:8]
            ),
            link="sbn",
            hop="SBN",
            span=(int(rows.time_ns[second]), int(rows.time_ns[members[-1]])),
            remedy="give each peer its own processor_id; if there is only one, somebody else uses its name",
            confidence="medium",
        )


def repeated_commands(case: Case) -> Iterator[Verdict]:
    """Commands that repeat bytes which another address sent before: a recording that is sent again.

    Name every address that does; bare headers, as a no-op, are the same whoever sends them.
    """
    rows = case.rows
    sent = sound_commands(case)
    sent = sent[rows.packet_length[sent] > rows.header_length[sent]]
    hosts = {name: index for index, name in enumerate(dict.fromkeys(item.address for item in case.endpoints))}
    host_of = np.array([hosts[item.address] for item in case.endpoints] or [0])
    names = list(hosts)
    _, first, which = np.unique(rows.packet_print[sent], return_index=True, return_inverse=True)
    sender = host_of[rows.source[sent]]
    origin = sender[first[which]]
    repeats = np.flatnonzero(sender != origin)
    for who, at in by_value(sender[repeats]):
        members = sent[repeats[at]]
        origins = sorted({names[item] for item in origin[repeats[at]].tolist()})
        start_ns, row = int(rows.time_ns[members[0]]), int(members[0])
        earlier = int(sent[first[which[np.searchsorted(sent, row)]]])
        yield security(
            f"{plural(len(members), 'command')} from {names[who]} repeat, byte for byte, what "
            f"{', '.join(origins)} sent before: a recording is being sent again",
            f"packet {rows.number[row]} at {case.at(start_ns)} repeats packet {rows.number[earlier]}",
            f"MsgIds: {', '.join(sorted({case.name(int(rows.msg_id[item])) for item in members}))}",
            link="ci",
            hop="CI_LAB_APP",
            span=case.span(members),
            remedy="the bridges' commands carry no count and no time, so that cFS obeys old ones again; let "
            "only the station reach CI's port",
            confidence="medium",
        )


_MOST: Final = 8
"""Senders and times that are named."""
_UNSOUND = Finding.TRUNCATED | Finding.INVALID_MSG_ID | Finding.WRONG_DIRECTION | Finding.LENGTH_MISMATCH


def sound_commands(case: Case) -> NDArray[np.intp]:
    """Return the rows of sound commands to CI, in order of capture."""
    rows = case.rows
    return np.flatnonzero((rows.link == CI) & (rows.function_code >= 0) & ~rows.has(_UNSOUND))


def privilege(case: Case, row: int) -> str:
    """Return what a command allows whoever sends it; nothing for an ordinary one."""
    return PRIVILEGED.get((int(case.rows.msg_id[row]), int(case.rows.function_code[row])), "")


def privileged_commands(case: Case) -> Iterator[Verdict]:
    """Commands that change what the flight software is: applications, processor, tables, files, memory.

    Name each kind of such command with where it came from, whoever sent it.
    """
    rows = case.rows
    sent = sound_commands(case)
    for _, at in by_value(numbered(rows.msg_id[sent], rows.function_code[sent])[1]):
        members, row = sent[at], int(sent[at[0]])
        if not privilege(case, row):
            continue
        msg_id, code = int(rows.msg_id[row]), int(rows.function_code[row])
        senders = sorted(
            {case.endpoints[source].address for source in np.unique(rows.source[members]).tolist()}
        )
        times = rows.time_ns[members].tolist()
        yield security(
            f"{plural(len(members), 'command')} {command_name(msg_id, code)} on {case.name(msg_id)} from "
            f"{_some(senders)}: it can {PRIVILEGED[msg_id, code]}",
            f"sent at {_some([case.at(when) for when in times])}",
            f"packet {rows.number[members[0]]} is the first",
            msg_id=msg_id,
            link="ci",
            hop="CI_LAB_APP",
            span=(times[0], times[-1]),
            remedy="see that whoever sent it was meant to; CI asks nobody who he is",
        )


def _some(texts: Sequence[str]) -> str:
    """Return the first of some texts, and how many more there are."""
    more = f" and {len(texts) - _MOST} more" if len(texts) > _MOST else ""
    return ", ".join(texts[:_MOST]) + more


def checksum(case: Case) -> Iterator[Verdict]:
    """Nobody here checks a command's checksum, and the bridges do not send one.

    Tell of absent ones; wrong ones are told of one by one as bad commands.
    """
    rows = case.rows
    commands = (rows.link == CI) & (rows.function_code >= 0)
    absent = int((commands & rows.has(Finding.CHECKSUM_ABSENT)).sum())
    if absent:
        of = int(commands.sum())
        yield habit(
            f"{absent:,} of {of:,} commands carry no checksum, as the EDORAS bridges send them; no cFS "
            "application here checks it, so a damaged command is obeyed",
            "the checksum byte is 0, and 0 is not right",
            link="ci",
            hop="ground bridge",
            remedy="none needed on a link that checks for itself; else compute it (0xFF XOR every byte) "
            "and have the application call CFE_MSG_ValidateChecksum",
        )
