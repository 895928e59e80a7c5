"""How often a draft of ``edoras check`` refuses a good run, and how often it misses a bad one.

Replays 163 commands at 10 Hz into the emulated rover 200 times, at phases drawn by lot, in simulated time; drafts
expectations from 1, 3 and 10 of these runs, and checks other ones. Then the same with ten percentage points more
loss, another rate, a field scaled by 1.1, and without a topic. Real runs can be named: they are checked, too.

    python benchmarks/drafts.py [--runs 200] [--checks 5] [--folder DIR] [--real RUN.mcap ...]
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "tests/support")]

from rewriting import datagrams, write  # noqa: E402

from edoras_tools.addons.lab.experiment.plan import ExperimentPlan  # noqa: E402
from edoras_tools.addons.lab.experiment.run import CellBench  # noqa: E402
from edoras_tools.addons.runs.check import check  # noqa: E402
from edoras_tools.addons.runs.draft import Draft  # noqa: E402
from edoras_tools.addons.runs.expectations import load_expectations  # noqa: E402
from edoras_tools.addons.runs.run import read_runs  # noqa: E402
from edoras_tools.pipelines.capture.record import Target, record  # noqa: E402
from edoras_tools.pipelines.selection import Selection  # noqa: E402
from edoras_tools.pipelines.workbench import Settings, open_files  # noqa: E402

COMMANDS, LOSSY = 163, 0.225
SCALED = 1.1
MISSION = ROOT / "samples/missions/rover_ground.yaml"


class Lossy(CellBench):
    """Runs in which the network in front of cFS loses commands, so that ten percentage points more are lost."""

    def simulation(self, chance, start_ns):
        made = super().simulation(chance, start_ns)
        deliver = made.feed

        def feed(time_ns, destination, data):
            if len(data) < 70 or chance.random() >= LOSSY:
                deliver(time_ns, destination, data)

        made.feed = feed
        return made


def drive(folder):
    """Write the commands that are replayed, and the same with every field scaled."""
    sent = [
        item for item in datagrams(ROOT / "samples/captures/a_rover.pcap") if item.payload[:2] == b"\x18\x27"
    ]
    sent = sent[:COMMANDS]
    cdr = 28
    scaled = [
        replace(
            item, payload=item.payload[:cdr] + (np.frombuffer(item.payload[cdr:], "<f8") * SCALED).tobytes()
        )
        for item in sent
    ]
    return write(folder / "drive.pcap", sent), write(folder / "scaled.pcap", scaled)


def runs_of(folder, name, number, replay, rate=0.0, bench=CellBench):
    """Make runs, but for those that are there."""
    settings = {"rate": [rate]} if rate else {}
    plan = ExperimentPlan(("rover",), replay=replay, settings=settings)
    maker = bench(plan, next(plan.cells()))
    paths = [folder / name / f"{place:03}.mcap" for place in range(1, number + 1)]
    for place, path in enumerate(paths, 1):
        if not path.exists():
            print(f"{name} {place}", end="\r", file=sys.stderr, flush=True)
            maker.run(path, 0, place)
    return paths


def without(folder, paths):
    """Write runs without the telemetry topic."""
    made = []
    for path in paths:
        made.append(folder / "missing" / path.name)
        source = open_files([path])
        target = Target(made[-1], replace=True, jobs=1)
        record(
            source,
            Settings([MISSION]).workbench(source.info),
            target,
            selection=Selection(where="msg_id != 0x827"),
        )
    return made


def judged(path, file, failures):
    """Return whether a run is refused; count what for."""
    source = open_files([path])
    report = check(source, Settings([MISSION]).workbench(source.info), load_expectations(file))
    unmet = [f"{item.about} {item.expectation}" for item in report.results if not item.passed]
    failures.update(unmet)
    return bool(unmet)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--checks", type=int, default=5)
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--real", type=Path, nargs="*", default=[])
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        folder.mkdir(exist_ok=True)
        plain, scaled = drive(folder)
        few = max(2, options.runs // 10)
        good = runs_of(folder, "good", options.runs, plain)
        bad = {
            "10 points more loss": runs_of(folder, "lossy", few, plain, bench=Lossy),
            "9 Hz for 10": runs_of(folder, "slower", few, plain, 9.0),
            "a field scaled by 1.1": runs_of(folder, "scaled", few, scaled),
            "a topic missing": without(folder, good[:few]),
        }
        known = dict(zip(good, read_runs(good, Settings([MISSION])), strict=True))
        lost = {
            name: np.mean([_loss(run) for run in read_runs(paths, Settings([MISSION]))])
            for name, paths in bad.items()
        }
        print(
            f"lost: {np.mean([_loss(run) for run in known.values()]):.1%}, { ({k: f'{v:.1%}' for k, v in lost.items()}) }"
        )
        chance = random.Random(1)
        file = folder / "expect.yaml"
        for size in (1, 3, 10):
            failures, refused, checks = Counter(), 0, 0
            missed, tries, real = Counter(), Counter(), 0
            drafts = max(2, options.runs // max(1, size // 2))
            for place in range(drafts):
                own = [good[place]] if size == 1 else chance.sample(good, size)
                file.write_text(Draft([known[item] for item in own]).text)
                for path in chance.sample(
                    [item for item in good if item not in own], min(options.checks, options.runs - size)
                ):
                    refused += judged(path, file, failures)
                    checks += 1
                for name, paths in bad.items():
                    missed[name] += not judged(chance.choice(paths), file, Counter())
                    tries[name] += 1
                if options.real:
                    real += judged(chance.choice(options.real), file, failures)
            print(
                f"draft from {size}: {refused} of {checks} good runs refused ({refused / checks:.1%})",
                dict(failures),
            )
            print("  missed:", {name: f"{missed[name]} of {tries[name]}" for name in bad})
            if options.real:
                print(f"  real runs refused: {real} of {drafts}")


def _loss(run):
    rows = [row for row in run.diagnosis.headlines if row.topic == "/cmd_vel"]
    return sum(row.missing for row in rows) / sum(row.sent for row in rows)


if __name__ == "__main__":
    main()
