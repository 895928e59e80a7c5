"""A relay between ground and cFS: transparent both ways, with faults, fan-out and a recording.

One thread moves the datagrams. Recording and showing are done in threads of their own, so that they cost the
datagrams no more than the copy of their bytes.
"""

from __future__ import annotations

import select
import time
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.errors import CaptureError
from edoras_tools.pipelines.interrupt import on_interrupt
from edoras_tools.pipelines.proxy_sessions import Sessions
from edoras_tools.pipelines.proxy_spoil import Outbox, Spoiler
from edoras_tools.pipelines.proxy_threads import shown, threads_take_turns
from edoras_tools.pipelines.proxy_ways import Way
from edoras_tools.sources.relay import ROOMS, SPARE, make_arena, open_port
from edoras_tools.sources.sockaddr import address_of, resolve
from edoras_tools.sources.udp import LINUX, kernel_drops

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable

    from numpy.typing import NDArray

    from edoras_tools.pipelines.keys import Keys
    from edoras_tools.pipelines.proxy_plan import ProxyPlan
    from edoras_tools.pipelines.proxy_recorder import Recorder
    from edoras_tools.pipelines.proxy_sessions import Session
    from edoras_tools.pipelines.proxy_threads import Watcher
    from edoras_tools.sessions.fault_lanes import Predicate
    from edoras_tools.sessions.faults import Fault

_TURNS: Final = 4
"""How often a busy socket is read before others have their turn."""
_SPIN_NS: Final = 20_000
"""For so long after a datagram the next is waited for awake: one of a burst need not wake anybody up."""
_WAIT_MS: Final = 20
"""How late Ctrl-C, keys and idle clients are noticed at most."""
_CHORES_NS: Final = 20_000_000
_FINISH_NS: Final = 200_000_000
"""What moving the rest may take at the end, in time of the thread: a machine that stands still loses none."""


class Proxy:
    """One relay, bound when constructed: nothing that is sent to it afterwards is missed.

    Args:
        plan: what is relayed where.
        recorder: called once the ports are bound; gives what takes the datagrams that are sent.
        where: compiles the filter expressions of faults.

    Attributes:
        plan: as given.
        endpoint: what is listened on, with the port that the system chose where it was left to it.
        forth: towards the targets, a way each.
        back: towards the clients.
        sessions: the clients.
        machine: the faults.
        recorder: what was given, or None.
        interrupted: ended by Ctrl-C.

    Raises:
        CaptureError: a port is in use, or a target is not known or cannot be reached.
        ConfigError: a fault has a filter expression that is wrong.
    """

    def __init__(
        self,
        plan: ProxyPlan,
        *,
        recorder: Callable[[], Recorder] | None = None,
        where: Callable[[str], Predicate] | None = None,
    ) -> None:
        self.plan = plan
        self.recorder: Recorder | None = None
        self.interrupted = False
        self._stopping = False
        self._epoch_ns = time.time_ns() - time.monotonic_ns()
        self._arena = make_arena()
        self._times = np.zeros(ROOMS + SPARE, np.int64)
        self.machine = plan.faults.start(where=where)
        self._spoiler = Spoiler(self.machine, self._arena, plan.link, self._note)
        targets = [resolve(target, "--target") for target in plan.targets]
        self.forth = [Way(f"to {address.endpoint}") for _, address in targets]
        self.back = Way("to clients")
        bind = resolve(plan.bind, "--bind")[1] if plan.bind else None
        client = resolve(plan.client, "--client")[1] if plan.client else None
        self._active_ns = self._chores_ns = 0
        self._poll = select.poll()
        self._owners: dict[int, tuple[socket.socket, Session | None]] = {}
        self._listen = open_port(plan.listen)
        self.endpoint = address_of(self._listen.family, self._listen.getsockname()).endpoint
        self._poll.register(self._listen, select.POLLIN)
        try:
            self.sessions = Sessions(
                self._listen,
                targets,
                (self.forth, self.back),
                queue_bytes=plan.queue_bytes,
                most=plan.clients,
                watch=self._watch,
                forget=self._forget,
                bind=bind,
            )
        except CaptureError:
            self._listen.close()
            raise
        if recorder is not None:
            try:
                self.recorder = self.sessions.flows = recorder()
            except CaptureError:
                self.close()
                raise
        if client is not None:
            self.sessions.of(client.packed, self._now())

    @property
    def lost(self) -> int:
        """Datagrams that the proxy itself lost, those that it did not record included."""
        missed = self.recorder.missed if self.recorder else 0
        dropped = self.forth[0].kernel_drops + self.back.kernel_drops
        overflowed = sum(way.overflowed for way in (*self.forth, self.back))
        return dropped + overflowed + self.machine.overflowed + missed

    @property
    def title(self) -> str:
        """The relay in a few words."""
        return f"{self.plan.link.label} {self.endpoint} to {', '.join(map(str, self.plan.targets))}"

    def stop(self) -> None:
        """End ``run``; for any thread or signal handler."""
        self._stopping = True

    def run(
        self, *, duration_ns: int = 0, watcher: Watcher[Proxy] | None = None, keys: Keys | None = None
    ) -> None:
        """Relay until ``stop``, Ctrl-C, the key q, or for so long.

        Args:
            duration_ns: how long; 0 for no end.
            watcher: looks on.
            keys: 1 to 9 switch faults, q ends.

        Raises:
            CaptureError: a socket failed.
        """
        if keys is not None:
            self._poll.register(keys.fileno(), select.POLLIN)
        began = self._now()
        end = began + duration_ns if duration_ns else 1 << 63
        with on_interrupt(self.stop) as asked, shown(self, watcher), threads_take_turns():
            while not self._stopping and (now := self._now()) < end:
                self._turn(now, min(end, self._chores_ns), keys)
            self.interrupted = asked.is_set()
            self._finish()

    def close(self) -> None:
        """Close every socket, and the recording; may be called twice."""
        if self._listen.fileno() < 0:
            return
        self._chores()
        self.sessions.close()
        self._listen.close()
        if self.recorder is not None:
            self.recorder.close(sum(way.kernel_drops for way in (*self.forth[:1], self.back)))

    def switch(self, index: int) -> None:
        """Put a fault in force, or out of it."""
        if index < len(self.machine.rules):
            self.machine.switch(index, not self.machine.enabled[index], now=self._now())

    def summary(self) -> dict[str, Any]:
        """Return the shape of ``proxy --json``."""
        machine, recorder = self.machine, self.recorder
        recorded = recorder.ledger if recorder else None
        return {
            **self.plan.summary(),
            "listen": str(self.endpoint),
            "ways": [way.summary() for way in (*self.forth, self.back)],
            "clients": [
                {
                    "address": str(session.client.endpoint),
                    "received": session.received,
                    "answered": session.answered,
                }
                for session in self.sessions
            ],
            "clients_evicted": self.sessions.evicted,
            "faults": [
                {"rule": rule.text, "kind": rule.kind.name, "on": on, "struck": struck}
                for rule, on, struck in zip(machine.rules, machine.enabled, machine.struck, strict=True)
            ],
            "held": machine.held,
            "held_overflowed": machine.overflowed,
            "recorded": recorded.datagrams if recorded else None,
            "unrecorded": recorder.missed if recorder else 0,
            "lost": self.lost,
            "routes": recorded.routes() if recorded else [],
        }

    def _now(self) -> int:
        """Return the time, ns since 1970, that never steps back."""
        return time.monotonic_ns() + self._epoch_ns

    def _turn(self, now: int, until: int, keys: Keys | None) -> None:
        """Move what there is to move, or wait for it."""
        due = self.machine.next_ns
        until = until if due is None else min(until, due)
        wait_ms = 0
        if now - self._active_ns > _SPIN_NS and not self.forth[0].queued + self.back.queued:
            wait_ms = min(max(until - now, 0) // 1_000_000, _WAIT_MS)
        for fileno, _ in self._poll.poll(wait_ms):
            if fileno == self._listen.fileno():
                self._from_clients()
            elif fileno in self._owners:
                self._from_target(*self._owners[fileno])
            elif keys is not None:
                self._obey(keys)
        now = self._now()
        if due is not None and due <= now:
            self._deliver(now)
        if now >= self._chores_ns:
            self._chores()

    def _finish(self) -> None:
        """Move what has arrived already."""
        end = time.thread_time_ns() + _FINISH_NS
        while time.thread_time_ns() < end and any(
            fileno in self._owners or fileno == self._listen.fileno() for fileno, _ in self._poll.poll(0)
        ):
            self._turn(self._now(), 0, None)
        self._chores()

    def _from_clients(self) -> None:
        arena = self._arena
        for _ in range(_TURNS):
            count = arena.receive(self._listen)
            if count <= 0:
                return
            now = self._arrived(count)
            senders = arena.senders(count)
            if count == 1 or (senders == senders[0]).all():
                self._forth(self.sessions.of(senders[0].tobytes(), now), count, now)
            else:
                rows: dict[bytes, list[int]] = {}
                for row, packed in enumerate(senders.view("V32").ravel().tolist()):
                    rows.setdefault(packed, []).append(row)
                for packed, places in rows.items():
                    self._forth(self.sessions.of(packed, now), np.array(places), now)
            if count < ROOMS:
                return

    def _from_target(self, port: socket.socket, session: Session | None) -> None:
        for _ in range(_TURNS):
            count = self._arena.receive(port)
            if count < 0:
                way = self.forth[session.ports.index(port) if session else 0]
                way.refused += 1
                continue
            if not count:
                return
            now = self._arrived(count)
            way = self.back
            way.received += count
            way.received_bytes += int(self._arena.length[:count].sum())
            if session is None:
                way.unclaimed += count
            else:
                session.last_ns = now
                session.answered += count
                self._relay(session, count, now, forth=False)
            if count < ROOMS:
                return

    def _arrived(self, count: int) -> int:
        """Note when datagrams came; return the time."""
        self._times[:count] = self._arena.times(count)
        self._active_ns = now = self._now()
        return now

    def _forth(self, session: Session, rows: int | NDArray[np.int64], now: int) -> None:
        count = rows if isinstance(rows, int) else len(rows)
        length = self._arena.length[:rows] if isinstance(rows, int) else self._arena.length[rows]
        octets = int(length.sum())
        for way in self.forth:
            way.received += count
            way.received_bytes += octets
        session.last_ns = now
        session.received += count
        self._relay(session, rows, now, forth=True)

    def _relay(self, session: Session, rows: int | NDArray[np.int64], now: int, *, forth: bool) -> None:
        """Send what lies in some rooms on, as far as faults let it."""
        to_cfs = self.plan.to_cfs is forth
        if not self.plan.faults or not self.machine.concerns(self.plan.link, to_cfs=to_cfs):
            self._send(session, rows, forth=forth)
            return

        def emit(chosen: NDArray[np.int64]) -> None:
            self._send(session, chosen, forth=forth)

        self._times[ROOMS:] = now
        places = np.arange(rows) if isinstance(rows, int) else rows
        self._spoiler.spoil(places, to_cfs=to_cfs, now=now, stream=session.number, emit=emit)

    def _send(self, session: Session, rows: int | NDArray[np.int64], *, forth: bool) -> None:
        outlets = session.forth if forth else [session.back]
        for outlet in outlets:
            outlet.send(self._arena, rows)
        sent_ns = time.time_ns()
        # What was held back or made on the way is late on purpose.
        late = sent_ns - (self._times[:rows] if isinstance(rows, int) else self._times[rows[rows < ROOMS]])
        for outlet in outlets:
            outlet.way.note(late)
        if self.recorder is not None:
            self.recorder.take(self._arena, rows, self._times, session.flows[0 if forth else 1])

    def _deliver(self, now: int) -> None:
        """Send what was held back and is due."""
        self._times[ROOMS:] = now
        self._active_ns = now
        outbox, last = None, None
        for delivery in self.machine.due(now):
            key = (delivery.stream, delivery.to_cfs is self.plan.to_cfs)
            if outbox is None or key != last:
                if outbox is not None:
                    outbox.flush()
                outbox, last = self._outbox(*key), key
            outbox.put(delivery.payload)
        if outbox is not None:
            outbox.flush()

    def _outbox(self, number: int, forth: bool) -> Outbox:
        session = self.sessions.numbered(number)

        def emit(rows: NDArray[np.int64]) -> None:
            if session is None:  # forgotten meanwhile
                (self.forth[0] if forth else self.back).unclaimed += len(rows)
            else:
                self._send(session, rows, forth=forth)

        return Outbox(self._arena, emit)

    def _note(self, faults: list[Fault]) -> None:
        if self.recorder is not None:
            self.recorder.note(faults)

    def _chores(self) -> None:
        """Do what need not be done for every datagram."""
        now = self._now()
        self._chores_ns = now + _CHORES_NS
        for session in self.sessions:
            for outlet in (*session.forth, session.back):
                if outlet.waits:
                    outlet.flush()
        for way in (*self.forth, self.back):
            way.fold()
        if LINUX:
            dropped = kernel_drops(self._listen)
            for way in self.forth:
                way.kernel_drops = dropped
        self.back.kernel_drops = self.sessions.drops()
        if self.machine.next_ns is None:
            self.sessions.expire(now, self.plan.idle_ns)
        if self.recorder is not None:
            self.recorder.tick(now)

    def _obey(self, keys: Keys) -> None:
        for key in keys.pressed():
            if key == "q":
                self.stop()
            elif key in "123456789":
                self.switch(int(key) - 1)

    def _watch(self, port: socket.socket, session: Session | None) -> None:
        self._owners[port.fileno()] = (port, session)
        self._poll.register(port, select.POLLIN)

    def _forget(self, port: socket.socket) -> None:
        del self._owners[port.fileno()]
        self._poll.unregister(port)
