"""Conditions to wait for before the first datagram leaves, and the message if they are not met."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from edoras_tools.cfs import sbn, telemetry_output
from edoras_tools.io.net.sockets import ANY_ADDRESS, own_address
from edoras_tools.model import NO_MSG_ID, Endpoint
from edoras_tools.pipelines.sending.options import SendOptions, called
from edoras_tools.sessions.sbn import SbnConnection
from edoras_tools.units import MILLISECOND
from edoras_tools.wire import cfe

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from edoras_tools.io.net.transmit import Wire
    from edoras_tools.links.protocol import SendingSession
    from edoras_tools.mission import Mission
    from edoras_tools.pipelines.sending.responses import Responses
    from edoras_tools.sessions.outgoing import Outgoing

_MOST_NAMED: Final = 4
_ONE_REPORT_NS: Final = 4300 * MILLISECOND
"""Time in which CI reports its count: SCH_LAB asks each 4 s in stock cFS, each second in the demos."""
_AFTER_ASKING_NS: Final = 8300 * MILLISECOND
"""Time for a second, equal report as well: then CI has read the commands that enable telemetry."""


class Condition(NamedTuple):
    """Something to wait for before the first datagram leaves.

    Attributes:
        name: for the user.
        met: returns whether it is met.
        ask: called about once a second until it is met.
        explain: returns the usual cause and what was tried; its argument is the time waited, s.
        patience_ns: time to wait before going on without it, ns; 0: it is required.
        hopeless: returns whether it can no longer be met.
    """

    name: str
    met: Callable[[], bool]
    explain: Callable[[float], str]
    ask: Callable[[], None] = lambda: None
    patience_ns: int = 0
    hopeless: Callable[[], bool] = lambda: False


def conditions(
    out: Outgoing,
    options: SendOptions,
    mission: Mission,
    *,
    responses: Responses,
    session: SbnConnection | SendingSession | None,
    wire: Wire,
    local: Endpoint,
) -> Iterator[Condition]:
    """Yield the conditions that the options name.

    Args:
        out: datagrams to send.
        options: options from ``placed``.
        mission: provides the topics of MsgIds.
        responses: responses received so far.
        session: the SBN session, if there is one.
        wire: sends the requests.
        local: endpoint where answers are received.
    """
    for item in options.wait_for:
        if item == "peer" and session is not None and options.to.sending:
            yield Condition(
                "peer", lambda: session.connected, lambda seconds: _silent(options, session, seconds)
            )
        elif item == "peer" and isinstance(session, SbnConnection):
            yield _peer(out, options, mission, responses, session=session, wire=wire, local=local)
        elif item == "to-enabled":
            yield _enabled(options, responses, wire, local)
        elif item.startswith("event:"):
            yield _event(item.removeprefix("event:"), responses, local)


def _silent(options: SendOptions, session: Any, seconds: float) -> str:
    if why := session.absence():
        return f"{why}, within {seconds:.1f} s"
    return (
        f"{options.target} did not answer as a receiver of {options.to.link.name} within {seconds:.1f} s; "
        "name it with --target"
    )


def _peer(
    out: Outgoing,
    options: SendOptions,
    mission: Mission,
    responses: Responses,
    *,
    session: SbnConnection,
    wire: Wire,
    local: Endpoint,
) -> Condition:
    msg_ids = set(np.unique(out.msg_id[out.msg_id != NO_MSG_ID]).tolist())

    own = session.own._asdict()
    refusals = [
        f"{event.app} {event.event_id}: {event.text.format(**own)}"
        for event in (sbn.UNKNOWN_PEER, sbn.UNKNOWN_PROCESSOR)
    ]
    crash = (
        ". Look whether cFS still runs: SBN's TCP module crashes it when a connection closes whose peer it "
        "does not know"
        if options.tcp
        else ""
    )

    def complaint() -> str | None:
        return next((text for text in refusals if text in responses.events), None)

    def unknown() -> bool:
        return session.answered is None and complaint() is not None

    def explain(seconds: float) -> str:
        if unknown():
            return (
                f"no SBN peer answered at {options.target} within {seconds:.1f} s: cFS says {complaint()!r}: "
                f"its SBN peer table has no such peer; set --as SC:CPU as in the table{crash}"
            )
        if session.answered is None:
            place = (
                ": set --as SC:CPU"
                if options.tcp
                else f" at UDP {local.port}: set --as SC:CPU and --listen PORT"
            )
            refusal = f"; {options.target} refuses: no program listens there"
            refused = refusal if wire.statistics.refused else ""
            return (
                f"no SBN peer answered at {options.target} within {seconds:.1f} s{refused}; tried PROTO and "
                f"SUB, once a second, as {session.own} from {local}; usually cFS is not running, or its SBN "
                f"peer table has no {session.own}{place} as in the table{crash}"
            )
        missing = sorted(msg_ids - session.subscribed)
        some = ", ".join(called(msg_id, mission) for msg_id in missing[:_MOST_NAMED])
        more = f" and {len(missing) - _MOST_NAMED} more" if len(missing) > _MOST_NAMED else ""
        return (
            f"SBN peer {session.answered} answered, but did not subscribe to {some}{more} within "
            f"{seconds:.1f} s; usually the application that receives it is not running; leave it out with "
            "--route, or send it anyway with --wait-for nothing"
        )

    return Condition(
        "peer", lambda: session.connected and msg_ids <= session.subscribed, explain, hopeless=unknown
    )


def _enabled(options: SendOptions, responses: Responses, wire: Wire, local: Endpoint) -> Condition:
    address = (
        own_address(options.target) if options.target and local.address == ANY_ADDRESS else local.address
    )

    def ask() -> None:
        wire.put(enable_output(address, options.headers))

    def explain(seconds: float) -> str:
        return (
            f"no telemetry came to {local} within {seconds:.1f} s; asked {options.target} once a second to "
            f"enable it towards {address}; usually cFS or its TO_LAB is not running, or it does not send to "
            f"port {local.port}"
        )

    return Condition("to-enabled", lambda: responses.telemetry > 0, explain, ask)


def count_known(out: Outgoing, options: SendOptions, responses: Responses, wire: Wire) -> Iterator[Condition]:
    """Yield the optional condition that CI's count is known, if CI can be followed.

    Args:
        out: datagrams to send; no condition for the command that enables telemetry alone.
        options: options from ``placed``.
        responses: responses received so far.
        wire: wire; it shows whether anything was sent before.
    """
    at_once = not options.follows_ci or "nothing" in options.wait_for or leaves_at_once(out, options)
    if not at_once and not only_enables(out, options.headers):
        yield Condition(
            "count",
            lambda: responses.ingest.is_known,
            lambda _: "",
            patience_ns=_AFTER_ASKING_NS if wire.statistics.sent else _ONE_REPORT_NS,
        )


def leaves_at_once(out: Outgoing, options: SendOptions) -> bool:
    """Return whether a single datagram is sent and its result is not judged: waiting is not worthwhile."""
    return len(out) == options.passes == 1 and not options.expect and options.max_loss is None


def only_enables(out: Outgoing, headers: cfe.Headers) -> bool:
    """Return whether only the command that enables telemetry is sent."""
    enable = headers.msg_ids.of_known(telemetry_output.COMMAND_MSG_ID)
    if len(out) != 1 or out.msg_id[0] != enable:
        return False
    return bool(headers.command.parse(out[0][headers.start :])["function_code"] == telemetry_output.ENABLE)


def _event(text: str, responses: Responses, local: Endpoint) -> Condition:
    def explain(seconds: float) -> str:
        count = len(responses.events)
        return (
            f"no event with {text!r} came to {local} within {seconds:.1f} s ({count} others did); usually "
            "telemetry is not enabled: put --wait-for to-enabled before it, or set a longer --timeout"
        )

    return Condition(f"event:{text}", lambda: responses.says(text), explain)


def enable_output(address: str, headers: cfe.Headers = cfe.STANDARD) -> bytes:
    """Return the command that makes Telemetry Output send to an IPv4 address, as the ground bridge does.

    Args:
        address: address as text.
        headers: headers of the receiving cFE.
    """
    return cfe.emit_command(
        headers.msg_ids.of_known(telemetry_output.COMMAND_MSG_ID),
        telemetry_output.ENABLE,
        address.encode().ljust(16, b"\0"),
        sequence_flags=0,
        with_checksum=False,
        headers=headers,
    )
