"""An emulated cFS (not flight software): on loopback in real time, or in simulated time without sockets.

>>> simulation = Simulation(scenario="rover")
>>> datagrams = list(simulation.run(until_ns=10_000_000_000))
"""

from edoras_tools.addons.lab.emulator.cfs import Scenario
from edoras_tools.addons.lab.emulator.simulation import (
    BOOT_NS,
    MISSIONS,
    SCENARIOS,
    Served,
    Simulation,
    WireDatagram,
    serve,
)

__all__ = ["BOOT_NS", "MISSIONS", "SCENARIOS", "Scenario", "Served", "Simulation", "WireDatagram", "serve"]
