"""An emulated cFS, honest about being one: on loopback in real time, or in simulated time without a socket.

>>> simulation = Simulation(scenario="rover")
>>> datagrams = list(simulation.run(until_ns=10_000_000_000))
"""

from edoras_tools.sim.server import serve
from edoras_tools.sim.simulation import SCENARIOS, Scenario, Sent, Simulation

__all__ = ["SCENARIOS", "Scenario", "Sent", "Simulation", "serve"]
