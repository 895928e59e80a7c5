"""Sockets opened, a session begun, and everything sent: what replay and inject do alike."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from edoras_tools.errors import CaptureError
from edoras_tools.model import NO_MSG_ID, Link
from edoras_tools.pipelines.gates import gates
from edoras_tools.pipelines.orders import Role, To
from edoras_tools.pipelines.safety import check_allowed
from edoras_tools.pipelines.seen import Seen
from edoras_tools.pipelines.sending import Report, Sending, in_order
from edoras_tools.sessions.profile import SECOND
from edoras_tools.sessions.sbn_client import BridgeClient, SbnClient
from edoras_tools.sinks.transmit import Listener, Transmitter
from edoras_tools.sinks.wire import UdpWire, precise_timing

if TYPE_CHECKING:
    from collections.abc import Callable

    from edoras_tools.mission import Mission
    from edoras_tools.model import Endpoint
    from edoras_tools.pipelines.keys import Keys
    from edoras_tools.pipelines.orders import Orders
    from edoras_tools.pipelines.replay import Loaded
    from edoras_tools.pipelines.sending import Watcher
    from edoras_tools.pipelines.tape import Tape
    from edoras_tools.sessions.faults import FaultMachine
    from edoras_tools.sessions.outgoing import Changes, Outgoing
    from edoras_tools.sessions.pacing import Timetable
    from edoras_tools.sessions.sbn_client import Peering
    from edoras_tools.sinks.wire import Wire


@dataclass(frozen=True, slots=True)
class Transmission:
    """Everything that a run needs, worked out before the first datagram leaves.

    Attributes:
        out: what is sent, in order.
        table: when.
        orders: placed and checked.
        mission: names what is sent and what comes back.
        changes: what is changed in each pass.
        wanted: what an SBN session subscribes to.
        notes: what people should know of it.
    """

    out: Outgoing
    table: Timetable
    orders: Orders
    mission: Mission
    changes: Changes
    wanted: tuple[int, ...] = ()
    notes: tuple[str, ...] = ()

    @classmethod
    def of(cls, loaded: Loaded, orders: Orders, mission: Mission, changes: Changes) -> Transmission:
        """Work it out.

        Args:
            loaded: what is to be sent, as recorded.
            orders: placed.
            mission: as for the class.
            changes: as for the class.

        Raises:
            ConfigError: rates contradict each other, or something is not allowed.
            RouteError: a rate is named for nothing that is sent.
        """
        subscribed = {route.msg_id for route in mission.routes if route.link is Link.SBN and not route.to_cfs}
        out = loaded.out
        table = orders.pacing(out, mission).timetable(out.time_ns, out.msg_id)
        ready = changes.once(in_order(out, table))
        check_allowed(ready, orders.allow, mission)
        wanted = tuple(sorted(subscribed)) or loaded.wanted
        return cls(ready, table, orders, mission, changes, wanted, loaded.notes)

    @property
    def total(self) -> int | None:
        """Datagrams to send; None for no end."""
        return len(self.out) * self.orders.passes if self.orders.passes else None

    def plan(self) -> dict[str, Any]:
        """Return what would be sent: the shape of ``--dry-run --json``."""
        orders, rate = self.orders, self.table.rate_hz
        msg_ids, counts = np.unique(self.out.msg_id, return_counts=True)
        topics = {route.msg_id: route.topic for route in reversed(self.mission.routes)}
        return {
            "dry_run": True,
            "to": orders.to.value,
            "target": str(orders.target),
            "listen": str(orders.listen) if orders.listen else None,
            "sender": str(orders.identity(self.mission)) if orders.has_session else None,
            "wait_for": list(orders.wait_for),
            "datagrams": self.total,
            "passes": orders.passes or None,
            "rate_asked_hz": None if rate is None else round(rate, 3),
            "duration_s": round(int(self.table.due_ns[-1]) / SECOND, 6) if len(self.out) else 0.0,
            "routes": [
                {
                    "msg_id": None if item == NO_MSG_ID else f"0x{item:04x}",
                    "topic": topics.get(item),
                    "count": count,
                }
                for item, count in zip(msg_ids.tolist(), counts.tolist(), strict=True)
            ],
            "notes": list(self.notes),
        }

    def run(
        self,
        *,
        faults: FaultMachine | None = None,
        keys: Keys | None = None,
        watcher: Watcher | None = None,
        tape: Callable[[Wire], Tape] | None = None,
        ready: Callable[[Endpoint], None] = lambda _: None,
    ) -> Report:
        """Open the sockets and send.

        Args:
            faults: what spoils datagrams on purpose.
            keys: the keyboard.
            watcher: looks on.
            tape: begins a recording of what crosses the wire.
            ready: told where answers come in, once the sockets are open.

        Raises:
            CaptureError: a socket cannot be opened, or a recording not begun; what goes wrong later is in
                ``Report.failure``.
        """
        orders = self.orders
        assert orders.target is not None
        report = Report(Seen(self.mission), self.total, self.table.rate_hz, notes=list(self.notes))
        with ExitStack() as stack:
            is_sbn = orders.to is To.SBN
            transmitter = stack.enter_context(Transmitter(orders.target, orders.listen if is_sbn else None))
            ears: list[tuple[Link, Listener]] = []
            if orders.listen is not None and not is_sbn:
                listener = Listener(orders.listen)
                stack.callback(listener.close)
                ears.append((Link.TO if orders.to is To.CI else Link.CI, listener))
            local = ears[0][1].local if ears else transmitter.local
            wire: Wire = UdpWire(transmitter, orders.to.link, ears, [keys.fileno()] if keys else ())
            recording = tape(wire) if tape else None
            wire = recording or wire
            session = self._session(wire.now())
            sending = Sending(
                wire,
                str(orders.target),
                self.out,
                self.table,
                report,
                changes=self.changes,
                passes=orders.passes,
                session=session,
                faults=faults,
                note=recording.note if recording else lambda _: None,
                keys=keys,
                paused=orders.step,
                linger_ns=orders.linger_ns or 0,
                watcher=watcher,
            )
            ready(local)
            stack.enter_context(precise_timing())
            asked = gates(
                self.out, orders, self.mission, seen=report.seen, session=session, wire=wire, local=local
            )
            sending.run(asked, orders.timeout_ns)
        if recording is not None:
            try:
                recording.close()
            except CaptureError as error:
                report.failure = report.failure or error
        return report

    def _session(self, now: int) -> Peering | None:
        if not self.orders.has_session:
            return None
        kind = BridgeClient if self.orders.role is Role.BRIDGE else SbnClient
        return kind(self.orders.identity(self.mission), self.wanted, now=now)
