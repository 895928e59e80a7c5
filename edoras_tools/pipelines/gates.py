"""What to wait for before the first datagram leaves, and what to say when it does not come."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.model import NO_MSG_ID
from edoras_tools.pipelines.safety import called
from edoras_tools.sessions import telemetry_output
from edoras_tools.wire import cfe

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from edoras_tools.mission import Mission
    from edoras_tools.model import Endpoint
    from edoras_tools.pipelines.orders import Orders
    from edoras_tools.pipelines.seen import Seen
    from edoras_tools.sessions.outgoing import Outgoing
    from edoras_tools.sessions.sbn_client import Peering
    from edoras_tools.sinks.wire import Wire

_MOST_NAMED: Final = 4


@dataclass(frozen=True, slots=True)
class Gate:
    """Something to wait for before the first datagram.

    Attributes:
        name: how people call it.
        open: tells whether it has come.
        ask: called about once a second until it has.
        explain: says what was tried and what is usually wrong; given the seconds that it took.
    """

    name: str
    open: Callable[[], bool]
    explain: Callable[[float], str]
    ask: Callable[[], None] = lambda: None


def gates(
    out: Outgoing,
    orders: Orders,
    mission: Mission,
    *,
    seen: Seen,
    session: Peering | None,
    wire: Wire,
    local: Endpoint,
) -> Iterator[Gate]:
    """Yield the gates that the orders name.

    Args:
        out: what will be sent.
        orders: placed.
        mission: gives MsgIds their topics.
        seen: what came back so far.
        session: the SBN session, where there is one.
        wire: to ask over.
        local: where answers come in.
    """
    for item in orders.wait_for:
        if item == "peer" and session is not None:
            yield _peer(out, orders, mission, session, wire, local)
        elif item == "to-enabled":
            yield _enabled(orders, seen, wire, local)
        elif item.startswith("event:"):
            yield _event(item.removeprefix("event:"), seen, local)


def _peer(
    out: Outgoing, orders: Orders, mission: Mission, session: Peering, wire: Wire, local: Endpoint
) -> Gate:
    wanted = set(np.unique(out.msg_id[out.msg_id != NO_MSG_ID]).tolist())

    def explain(seconds: float) -> str:
        if session.answered is None:
            refused = f"; {orders.target} refuses, nobody listens there" if wire.statistics.refused else ""
            return (
                f"no SBN peer answered at {orders.target} within {seconds:.1f} s{refused}; tried PROTO and "
                f"SUB, once a second, as {session.peer} from {local}; usually cFS is not up, or its SBN peer "
                f"table has no {session.peer} at UDP {local.port}: say --as SC:CPU and --listen PORT as the "
                "table does"
            )
        missing = sorted(wanted - session.subscribed)
        some = ", ".join(called(msg_id, mission) for msg_id in missing[:_MOST_NAMED])
        more = f" and {len(missing) - _MOST_NAMED} more" if len(missing) > _MOST_NAMED else ""
        return (
            f"SBN peer {session.answered} answered, but did not subscribe to {some}{more} within "
            f"{seconds:.1f} s; usually the application that takes it does not run; leave it out with "
            "--route, or send it all the same with --wait-for nothing"
        )

    return Gate("peer", lambda: session.connected and wanted <= session.subscribed, explain)


def _enabled(orders: Orders, seen: Seen, wire: Wire, local: Endpoint) -> Gate:
    address = local.address if local.address != "0.0.0.0" else orders.here  # noqa: S104  compared, not bound

    def ask() -> None:
        wire.put(enable_output(address))

    def explain(seconds: float) -> str:
        return (
            f"no telemetry came to {local} within {seconds:.1f} s; asked {orders.target} once a second to "
            f"enable it towards {address}; usually cFS or its TO_LAB is not up, or it sends to another port "
            f"than {local.port}"
        )

    return Gate("to-enabled", lambda: seen.telemetry > 0, explain, ask)


def _event(text: str, seen: Seen, local: Endpoint) -> Gate:
    def explain(seconds: float) -> str:
        count = len(seen.events)
        return (
            f"no event with {text!r} came to {local} within {seconds:.1f} s ({count} others did); usually "
            "telemetry is not enabled: --wait-for to-enabled before it, or a longer --timeout"
        )

    return Gate(f"event:{text}", lambda: seen.says(text), explain)


def enable_output(address: str) -> bytes:
    """Return the command that has Telemetry Output send to an IPv4 address, as the ground bridge sends it."""
    return cfe.emit_command(
        telemetry_output.COMMAND_MSG_ID,
        telemetry_output.ENABLE,
        address.encode().ljust(16, b"\0"),
        sequence_flags=0,
        with_checksum=False,
    )
