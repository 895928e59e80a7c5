"""An emulated cFS at the other end of a wire, in simulated time: no sockets, and hours in seconds."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from edoras_tools.model import Link
from edoras_tools.sessions.profile import TO_TABLE, SbnPeerConfig, SimProfile
from edoras_tools.sim import Simulation
from edoras_tools.sinks.transmit import SendStatistics
from edoras_tools.sinks.wire import Arrival

if TYPE_CHECKING:
    from edoras_tools.mission import Mission
    from edoras_tools.model import Endpoint
    from edoras_tools.pipelines.sweep_plan import Plan
    from edoras_tools.sessions.outgoing import Outgoing


class SimulatedWire:
    """A ``Wire`` to an emulated cFS; its clock is the simulation's.

    Args:
        simulation: with none of its bridges: this is in their place.
        target: where datagrams go.
        here: where its answers are heard.
        link: which link those belong to.
    """

    def __init__(self, simulation: Simulation, target: Endpoint, here: Endpoint, link: Link) -> None:
        self.statistics = SendStatistics()
        self._simulation, self._target, self._here, self._link = simulation, target, here, link
        self.ends = here, target
        self._arrived: list[Arrival] = []

    def now(self) -> int:
        """Return the simulation's time."""
        return self._simulation.now

    def epoch_ns(self) -> int:
        """Return 0: it began in 1970."""
        return 0

    def wait(self, until_ns: int) -> bool:
        """Let time pass, all of it."""
        for item in self._simulation.run(until_ns):
            if item.destination == self._here:
                self._arrived.append(Arrival(self._link, item.payload, item.source, item.destination))
        return True

    def put(self, payload: bytes) -> bool:
        """Have a datagram arrive, now."""
        self._simulation.feed(self._simulation.now, self._target, payload)
        self.statistics.sent += 1
        return True

    def send(self, out: Outgoing, first: int, last: int) -> int:
        """Have datagrams ``first`` up to ``last``, not included, arrive now."""
        return sum(self.put(out[index]) for index in range(first, last))

    def receive(self) -> list[Arrival]:
        """Return what has arrived."""
        arrived, self._arrived = self._arrived, []
        return arrived


def emulated(plan: Plan, mission: Mission) -> SimulatedWire:
    """Boot the emulated cFS of a plan, its ports those of the orders.

    Args:
        plan: its scenario is not None.
        mission: knows the SBN identity.
    """
    orders, route, limit = plan.orders, plan.route, plan.limit
    assert orders.target is not None
    assert orders.listen is not None
    assert plan.scenario is not None
    profile = SimProfile()
    if limit is not None and plan.to_cfs:
        profile = replace(profile, app_msg_limit=limit)
    elif limit is not None:
        profile = replace(profile, to_limits=TO_TABLE | {route.msg_id: limit}, sbn_msg_limit=limit)
    if route.link is Link.SBN:
        peer = SbnPeerConfig(orders.identity(mission), orders.listen.port)
        profile = replace(profile, sbn_port=orders.target.port, sbn_peers=(peer,))
    else:
        profile = replace(profile, ci_port=orders.target.port, to_port=orders.listen.port)
    simulation = Simulation(profile, plan.scenario, bridges=False)
    target = simulation.cfs.sbn_endpoint if route.link is Link.SBN else simulation.cfs.ci_endpoint
    here = replace(orders.listen, address=profile.address)
    return SimulatedWire(simulation, target, here, Link.SBN if route.link is Link.SBN else Link.TO)
