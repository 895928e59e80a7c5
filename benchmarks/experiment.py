"""How often an interval of ``edoras experiment`` holds the loss that the emulated cFS counts in the long run.

For each of 200 settings the interval comes from five runs, which are recorded and diagnosed; the truth is the
mean of the emulator's own account over other runs, which nobody diagnoses. Prints the share of the settings
whose interval holds it: 95 % intervals should in 90 to 99 %.

    python benchmarks/experiment.py [--cells 200] [--reference 20]
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
from pathlib import Path

from edoras_tools.addons.lab.experiment import (
    AFTER_COMMANDS_NS,
    BEFORE_COMMANDS_NS,
    Experiment,
    ExperimentPlan,
)
from edoras_tools.units import SECOND

LIMITS, RATES = (2, 3, 4, 5, 6), range(6, 26)
RUNS, SECONDS = 5, 6


def account_share(bench, seed):
    """Return the share of commands that one run loses by the emulator's account."""
    simulation = bench.simulation(random.Random(seed), SECOND)
    begin_ns, rate = simulation.now, bench.cell.settings["rate"]
    count = round(rate * SECONDS)
    simulation.connect(rate, command_count=count, after_ns=BEFORE_COMMANDS_NS)
    for _ in simulation.run(begin_ns + BEFORE_COMMANDS_NS + SECONDS * SECOND + AFTER_COMMANDS_NS):
        pass
    return command_losses(simulation.cfs.account.losses(begin_ns)) / count


def command_losses(losses):
    """Return how many commands were lost at CI's socket and in the application's pipe."""
    places = {"EDORAS_APP_PIPE", "socket 1234"}
    return sum(number for (hop, _, _), number in losses.items() if hop in places)


def coverage(folder, cells, reference):
    """Return of how many cells, and of how many it is, that the interval holds the truth."""
    wide = {"rate": RATES[: max(1, cells // 10)], "app_msg_limit": LIMITS}
    plan = ExperimentPlan(
        ("rover", "arm"), settings=wide, duration_ns=SECONDS * SECOND, least=RUNS, most=RUNS
    )
    experiment = Experiment(plan, folder)
    report = experiment.run(lambda text: print(text, end="\r", file=sys.stderr, flush=True))
    held = 0
    for cell in report["cells"]:
        command = next(item for item in cell["topics"] if item["topic"].startswith("/c"))
        bench = experiment.benches[cell["cell"]]
        shares = [account_share(bench, f"{cell['cell']} {number}") for number in range(reference)]
        truth, interval = sum(shares) / reference, command["loss"]
        inside = interval["low"] <= truth <= interval["high"]
        held += inside
        if not inside:
            print(f"{cell['cell']}: {truth:.4f} is not in {interval['low']:.4f} to {interval['high']:.4f}")
    return held, len(report["cells"])


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=200)
    parser.add_argument("--reference", type=int, default=20)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        held, cells = coverage(Path(folder) / "runs", options.cells, options.reference)
    print(f"{held} of {cells} intervals hold the emulator's own account: {held / cells:.1%}")


if __name__ == "__main__":
    main()
