"""A wire to an emulated cFS in simulated time: no sockets; hours take seconds."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from edoras_tools.addons.lab.emulator import Simulation
from edoras_tools.cfs.profile import TO_TABLE, SbnPeerConfig, SimProfile
from edoras_tools.io.net.transmit import SendStatistics
from edoras_tools.io.net.wire import Arrival
from edoras_tools.links.table import carrying

if TYPE_CHECKING:
    from edoras_tools.addons.lab.sweep.plan import SweepPlan
    from edoras_tools.mission import Mission
    from edoras_tools.model import Endpoint, Link
    from edoras_tools.sessions.outgoing import Outgoing


class SimulatedWire:
    """A ``Wire`` to an emulated cFS; its clock is the simulation's.

    Args:
        simulation: without bridges, because the wire replaces them.
        target: where datagrams go.
        here: where answers are received.
        link: the link of the answers.
    """

    def __init__(self, simulation: Simulation, target: Endpoint, here: Endpoint, link: Link) -> None:
        self.statistics = SendStatistics()
        self._simulation, self._target, self._here, self._link = simulation, target, here, link
        self.ends = here, target
        self._arrived: list[Arrival] = []

    def now(self) -> int:
        """Return the simulation's time in ns."""
        return self._simulation.now

    def epoch_ns(self) -> int:
        """Return 0: the simulation starts in 1970."""
        return 0

    def wait(self, until_ns: int) -> bool:
        """Run the simulation until that time."""
        for item in self._simulation.run(until_ns):
            if item.destination == self._here:
                self._arrived.append(Arrival(self._link, item.payload, item.source, item.destination))
        return True

    def put(self, payload: bytes) -> bool:
        """Deliver a datagram to the simulation now."""
        self._simulation.feed(self._simulation.now, self._target, payload)
        self.statistics.sent += 1
        return True

    def send(self, out: Outgoing, first: int, last: int) -> int:
        """Deliver datagrams ``first`` up to ``last``, not included, now."""
        return sum(self.put(out[index]) for index in range(first, last))

    def receive(self) -> list[Arrival]:
        """Return what has arrived."""
        arrived, self._arrived = self._arrived, []
        return arrived


def profile_of(plan: SweepPlan, mission: Mission) -> SimProfile:
    """Return the constants of the cFS at the other end: of the emulated one, or of a stock cFS.

    Args:
        plan: with defaults filled in.
    """
    options, route, limit = plan.options, plan.route, plan.limit
    msg_ids = plan.headers.msg_ids
    profile = SimProfile(
        generator_msg_id=msg_ids.known(plan.generator),
        extended_header=plan.headers.extended,
        msg_id_version=msg_ids.version,
    )
    if plan.scenario is None:
        return profile
    assert options.target is not None
    assert options.listen is not None
    if limit is not None and plan.to_cfs:
        profile = replace(profile, app_msg_limit=limit)
    elif limit is not None:
        limits = TO_TABLE | {msg_ids.known(route.msg_id): limit}
        profile = replace(profile, to_limits=limits, sbn_msg_limit=limit)
    if route.link.peers:
        peer = SbnPeerConfig(options.identity(mission), options.listen.port)
        return replace(profile, sbn_port=options.target.port, sbn_peers=(peer,))
    return replace(profile, ci_port=options.target.port, to_port=options.listen.port)


def emulated(plan: SweepPlan, profile: SimProfile) -> SimulatedWire:
    """Boot the emulated cFS of a plan.

    Args:
        plan: its scenario must not be None.
        profile: see ``profile_of``.
    """
    assert plan.options.listen is not None
    assert plan.scenario is not None
    simulation = Simulation(profile, plan.scenario, bridges=False)
    on_network = plan.route.link.peers
    target = simulation.cfs.sbn_endpoint if on_network else simulation.cfs.ci_endpoint
    here = replace(plan.options.listen, address=profile.address)
    return SimulatedWire(
        simulation, target, here, carrying("flight" if on_network else "ground", to_cfs=False)
    )
