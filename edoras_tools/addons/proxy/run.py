"""A relay between ground and cFS: transparent both ways, with faults, several targets and a recording.

Rules:

1. One thread moves the datagrams. Recording and display have their own threads; they cost the moving thread
   only a copy of the bytes.
2. Datagrams leave unchanged and in order, unless a fault changes that: they are sent from the buffer slots
   that received them, and while a socket's buffer is full, later ones wait behind earlier ones.
3. A client has its own socket towards each target, so that answers can be assigned to it.
4. Every loss here has a count: in the kernel, in a full queue, in the recording, without a client.
5. Datagrams are forwarded first, then counted and copied for the recording.
6. Where the system allows it, the thread runs before programs of normal priority while it takes little time.
7. After traffic the thread polls again at once for a short time; then it sleeps until something arrives or
   is due.
"""

from __future__ import annotations

import select
import time
from collections.abc import Callable
from contextlib import ExitStack
from itertools import groupby
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.addons.proxy.clients import Clients, ProxyClient
from edoras_tools.addons.proxy.plan import FaultStage, Outbox, ProxyPlan
from edoras_tools.io.net.buffer import SLOTS, SPARE, make_buffer
from edoras_tools.io.net.sockets import kernel_drops, local_endpoint, open_bound, resolve
from edoras_tools.io.net.transmit import Direction
from edoras_tools.io.processes import Precedence
from edoras_tools.pipelines.reading import Keys, on_interrupt, threads_take_turns, watched
from edoras_tools.units import MILLISECOND

if TYPE_CHECKING:
    import socket

    from numpy.typing import NDArray

    from edoras_tools.pipelines.recorder import RelayRecorder
    from edoras_tools.render.terminal.text import Watcher
    from edoras_tools.sessions.faults.machine import Predicate
    from edoras_tools.sessions.faults.rules import Fault

_TURNS: Final = 4
"""Times that a busy socket is read before the others are read."""
_SPIN_NS: Final = 20_000
"""Time after a datagram in which the sockets are polled without sleeping, so that bursts need no wake-ups."""
_UPKEEP_NS: Final = 20 * MILLISECOND
"""Period of the other work, and maximum delay until Ctrl-C, keys and idle clients are noticed."""
_FINISH_NS: Final = 200_000_000
"""Maximum processor time for moving the rest at the end; time in which the machine stalls does not count."""


class Proxy:
    """One relay; the constructor binds its ports, and nothing that is sent afterwards is missed.

    Args:
        plan: settings.
        recorder: called once the ports are bound; returns the recorder of the datagrams that are sent.
        where: compiles the filter expressions of faults.

    Attributes:
        plan: settings.
        endpoint: the address that it listens on, with the port that the system chose if none was given.
        to_target: counters of the direction to each target.
        to_client: counters of the direction to the clients.
        clients: the clients.
        machine: the faults.
        recorder: the recorder, or None.
        interrupted: whether Ctrl-C ended it.

    Raises:
        CaptureError: a port is in use, or a target is unknown or unreachable.
        ConfigError: the filter expression of a fault is wrong.
    """

    def __init__(
        self,
        plan: ProxyPlan,
        *,
        recorder: Callable[[], RelayRecorder] | None = None,
        where: Callable[[str], Predicate] | None = None,
    ) -> None:
        self.plan = plan
        self.recorder: RelayRecorder | None = None
        self.interrupted = False
        self._stopping = False
        self._epoch_ns = time.time_ns() - time.monotonic_ns()
        self._buffer = make_buffer()
        self._times = np.zeros(SLOTS + SPARE, np.int64)
        self.machine = plan.faults.start(where=where, headers=plan.headers)
        self._faults = FaultStage(self.machine, self._buffer, plan.link, self._note)
        targets = [resolve(target, f"--target {target}") for target in plan.targets]
        self.to_target = [Direction(f"to {address.endpoint}") for _, address in targets]
        self.to_client = Direction("to clients")
        client = resolve(plan.client, f"--client {plan.client}")[1] if plan.client else None
        self._precedence = Precedence()
        self._active_ns = self._upkeep_ns = self._untimed = 0
        self._poll = select.poll()
        self._owners: dict[int, tuple[socket.socket, ProxyClient | None]] = {}
        self._listen = open_bound(plan.listen, f"--listen {plan.listen}")
        self.endpoint = local_endpoint(self._listen)
        self._poll.register(self._listen, select.POLLIN)
        with ExitStack() as stack:
            stack.callback(self._listen.close)
            self.clients = Clients(
                plan,
                self._listen,
                targets,
                self.to_target,
                self.to_client,
                watch=self._watch,
                forget=self._forget,
            )
            stack.callback(self.clients.close)
            if recorder is not None:
                self.recorder = recorder()
            stack.pop_all()
        if client is not None:
            self.clients.at(client.packed, self._now())

    @property
    def lost(self) -> int:
        """Datagrams that the proxy itself lost, including those that it did not record."""
        missed = self.recorder.missed if self.recorder else 0
        dropped = self.to_target[0].kernel_drops + self.to_client.kernel_drops
        overflowed = sum(direction.overflowed for direction in self.directions)
        return dropped + overflowed + self.machine.overflowed + missed

    @property
    def directions(self) -> list[Direction]:
        """The counters of all directions: to each target and to the clients."""
        return [*self.to_target, self.to_client]

    @property
    def title(self) -> str:
        """A short description of the relay."""
        return f"{self.plan.link.label} {self.endpoint} to {', '.join(map(str, self.plan.targets))}"

    def stop(self) -> None:
        """End ``run``; for any thread or signal handler."""
        self._stopping = True

    def run(
        self, *, duration_ns: int = 0, watcher: Watcher[Proxy] | None = None, keys: Keys | None = None
    ) -> None:
        """Relay until ``stop``, Ctrl-C, the key q, or the end of the duration.

        Args:
            duration_ns: duration, ns; 0: without end.
            watcher: updated while it runs.
            keys: 1 to 9 switch faults on and off, q quits.

        Raises:
            CaptureError: a socket failed.
        """
        if keys is not None:
            self._poll.register(keys.fileno(), select.POLLIN)
        began = self._now()
        end = began + duration_ns if duration_ns else 1 << 63
        with (
            on_interrupt(self.stop) as interrupt,
            watched(self, watcher),
            threads_take_turns(),
            self._precedence,
        ):
            while not self._stopping and (now := self._now()) < end:
                self._turn(now, min(end, self._upkeep_ns), keys)
            self.interrupted = interrupt.is_set()
            self._finish()

    def close(self) -> None:
        """Close every socket, and the recording; may be called twice."""
        if self._listen.fileno() < 0:
            return
        self._keep_up()
        self.clients.close()
        self._listen.close()
        if self.recorder is not None:
            self.recorder.close(self.to_target[0].kernel_drops + self.to_client.kernel_drops)

    def switch(self, index: int) -> None:
        """Switch a fault on or off."""
        if index < len(self.machine.rules):
            self.machine.switch(index, not self.machine.enabled[index], now=self._now())

    def summary(self) -> dict[str, Any]:
        """Return the shape of ``proxy --json``."""
        machine, recorder = self.machine, self.recorder
        recorded = recorder.recorded if recorder else None
        return {
            **self.plan.summary(),
            "listen": str(self.endpoint),
            "ways": [direction.summary() for direction in self.directions],
            "clients": [
                {
                    "address": str(client.address.endpoint),
                    "received": client.received,
                    "answered": client.answered,
                }
                for client in self.clients
            ],
            "clients_evicted": self.clients.evicted,
            "faults": [
                {"rule": rule.text, "kind": rule.kind.name, "on": on, "struck": struck}
                for rule, on, struck in zip(machine.rules, machine.enabled, machine.struck, strict=True)
            ],
            "held": machine.waiting,
            "held_overflowed": machine.overflowed,
            "recorded": recorded.datagrams if recorded else None,
            "unrecorded": recorder.missed if recorder else 0,
            "lost": self.lost,
            "routes": list(recorded.routes) if recorded else [],
        }

    def _now(self) -> int:
        """Return the time in ns since 1970, from a clock that never steps back."""
        return time.monotonic_ns() + self._epoch_ns

    def _turn(self, now: int, until: int, keys: Keys | None) -> None:
        """Move the datagrams that have arrived or are due, or wait for them."""
        due = self.machine.next_ns
        wait_ms = 0
        if now - self._active_ns > _SPIN_NS and not self.to_target[0].queued + self.to_client.queued:
            wait_ms = max(-(-(until - now) // MILLISECOND), 0)  # rather late than polling without sleep
            if due is not None:
                wait_ms = min(wait_ms, max(due - now, 0) // MILLISECOND)  # not later than the deadline
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
        if now >= self._upkeep_ns:
            self._keep_up()

    def _finish(self) -> None:
        """Move the datagrams that have already arrived."""
        end = time.thread_time_ns() + _FINISH_NS
        while time.thread_time_ns() < end and any(
            fileno in self._owners or fileno == self._listen.fileno() for fileno, _ in self._poll.poll(0)
        ):
            self._turn(self._now(), 0, None)
        self._keep_up()

    def _from_clients(self) -> None:
        buffer = self._buffer
        for _ in range(_TURNS):
            count = buffer.receive(self._listen)
            if count <= 0:
                return
            now = self._arrived(count)
            senders = buffer.senders(count)
            packed, every = senders[0].tobytes(), senders.tobytes()
            if every == packed * count:
                self._to_target(self.clients.at(packed, now), count, now)
            else:
                slots: dict[bytes, list[int]] = {}
                for slot, packed in enumerate(senders.view("V32").ravel().tolist()):
                    slots.setdefault(packed, []).append(slot)
                for packed, rows in slots.items():
                    self._to_target(self.clients.at(packed, now), np.array(rows), now)
            if count < SLOTS:
                return

    def _from_target(self, opened: socket.socket, client: ProxyClient | None) -> None:
        for _ in range(_TURNS):
            count = self._buffer.receive(opened)
            if count < 0:
                self.to_target[client.sockets.index(opened) if client else 0].refused += 1
                continue
            if not count:
                return
            now = self._arrived(count)
            direction = self.to_client
            if client is None:
                direction.unclaimed += count
            else:
                client.last_ns = now
                client.answered += count
                self._relay(client, count, now, to_target=False)
            direction.received += count
            direction.received_bytes += int(self._buffer.length[:count].sum())
            if count < SLOTS:
                return

    def _arrived(self, count: int) -> int:
        """Record that datagrams arrived; return the time. ``_send`` gets the arrival times later."""
        self._untimed = count
        self._active_ns = now = self._now()
        return now

    def _to_target(self, client: ProxyClient, slots: int | NDArray[np.int64], now: int) -> None:
        client.last_ns = now
        self._relay(client, slots, now, to_target=True)
        length = self._buffer.length[:slots] if isinstance(slots, int) else self._buffer.length[slots]
        total = int(length.sum())
        for direction in self.to_target:
            direction.received += len(length)
            direction.received_bytes += total
        client.received += len(length)

    def _relay(
        self, client: ProxyClient, slots: int | NDArray[np.int64], now: int, *, to_target: bool
    ) -> None:
        """Forward the datagrams in some slots, after applying faults."""
        to_cfs = self.plan.to_cfs is to_target
        if not self.plan.faults or not self.machine.concerns(self.plan.link, to_cfs=to_cfs):
            self._send(client, slots, to_target=to_target)
            return

        def send(selection: NDArray[np.int64]) -> None:
            self._send(client, selection, to_target=to_target)

        self._times[SLOTS:] = now
        selection = np.arange(slots) if isinstance(slots, int) else slots
        self._faults.apply(selection, to_cfs=to_cfs, now=now, stream=client.number, send=send)

    def _send(self, client: ProxyClient, slots: int | NDArray[np.int64], *, to_target: bool) -> None:
        outlets = client.to_target if to_target else [client.to_client]
        for outlet in outlets:
            outlet.send(self._buffer, slots)
        sent_ns = time.time_ns()
        if self._untimed:
            self._times[: self._untimed] = self._buffer.times(self._untimed)
            self._untimed = 0
        # Datagrams that faults delayed or made are late on purpose.
        arrived = self._times[:slots] if isinstance(slots, int) else self._times[slots[slots < SLOTS]]
        for outlet in outlets:
            outlet.direction.add_latencies(sent_ns - arrived)
        if self.recorder is not None:
            self.recorder.take(self._buffer, slots, self._times, client.ends[0 if to_target else 1])

    def _deliver(self, now: int) -> None:
        """Send delayed datagrams that are due."""
        self._times[SLOTS:] = now
        self._active_ns = now
        ways = groupby(self.machine.due(now), key=lambda item: (item.stream, item.to_cfs is self.plan.to_cfs))
        for (number, to_target), deliveries in ways:
            outbox = self._outbox(number, to_target)
            for delivery in deliveries:
                outbox.put(delivery.payload)
            outbox.flush()

    def _outbox(self, number: int, to_target: bool) -> Outbox:
        client = self.clients.numbered(number)

        def send(slots: NDArray[np.int64]) -> None:
            if client is None:  # removed in between
                (self.to_target[0] if to_target else self.to_client).unclaimed += len(slots)
            else:
                self._send(client, slots, to_target=to_target)

        return Outbox(self._buffer, send)

    def _note(self, faults: list[Fault]) -> None:
        if self.recorder is not None:
            self.recorder.note(faults)

    def _keep_up(self) -> None:
        """Do the periodic work: queues, counters, idle clients, the recording."""
        now = self._now()
        self._upkeep_ns = now + _UPKEEP_NS
        self._precedence.look()
        for client in self.clients:
            for outlet in client.outlets:
                if outlet.waits:
                    outlet.flush()
        dropped = kernel_drops(self._listen)
        for direction in self.to_target:
            direction.kernel_drops = dropped
        self.to_client.kernel_drops = self.clients.drops()
        for direction in self.directions:
            direction.count_latencies()
        if self.machine.next_ns is None:
            self.clients.expire(now, self.plan.idle_ns)
        if self.recorder is not None:
            self.recorder.tick(now)

    def _obey(self, keys: Keys) -> None:
        for key in keys.pressed():
            if key == "q":
                self.stop()
            elif key in "123456789":
                self.switch(int(key) - 1)

    def _watch(self, opened: socket.socket, client: ProxyClient | None) -> None:
        self._owners[opened.fileno()] = (opened, client)
        self._poll.register(opened, select.POLLIN)

    def _forget(self, opened: socket.socket) -> None:
        del self._owners[opened.fileno()]
        self._poll.unregister(opened)
