"""How often a draft of ``edoras check`` refuses a good run, and how often it misses a bad one.

Replays 163 commands at 10 Hz into the emulated rover 200 times, at phases drawn by lot, in simulated time;
drafts expectations from 1, 3 and 10 of these runs 200 times each, and holds all others to them. Then the
same with ten percentage points more loss, another rate, a field scaled by 1.1, and without a topic. Real runs
can be named, made with the ``drive.pcap`` of the folder. What is known of a run is judged, not
read again for each draft; of one draft in 20 ``check`` itself reads it.

    python benchmarks/drafts.py [--runs 200] [--folder DIR] [--real RUN.mcap ...]
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np
from msgspec.structs import replace

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "tests/support")]

from rewriting import datagrams, write  # noqa: E402

from edoras_tools.addons.lab.experiment import CellBench, ExperimentPlan  # noqa: E402
from edoras_tools.addons.runs.check import NOTABLE_FINDINGS, Figures, Subject, check  # noqa: E402  # noqa: E402
from edoras_tools.addons.runs.check import _bounded as bounded  # noqa: E402
from edoras_tools.addons.runs.draft import _FIELD as FIELD  # noqa: E402
from edoras_tools.addons.runs.draft import Draft  # noqa: E402
from edoras_tools.addons.runs.expectations import load_expectations  # noqa: E402
from edoras_tools.addons.runs.run import read_runs  # noqa: E402
from edoras_tools.diagnosis.verdict import Severity  # noqa: E402
from edoras_tools.pipelines.capture.record import Target, record  # noqa: E402
from edoras_tools.pipelines.selection import Selection  # noqa: E402
from edoras_tools.pipelines.workbench import Settings, open_files  # noqa: E402

COMMANDS, LOSSY = 163, 0.205
SCALED = 1.1
MISSION = ROOT / "samples/missions/rover_ground.yaml"


class Lossy(CellBench):
    """Runs in which the network in front of cFS loses commands, so that ten points more are lost."""

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


def refused(run, expected):
    """Return what a run does not meet, from what is known of it: as ``check``, which reads it again."""
    parts, unmet = run.parts(), []
    for topic in expected.topics:
        subject = Subject.of_name(topic.name, run.context)
        figures = Figures.of(subject, parts)
        unmet += [
            f"{subject.name} {key}"
            for key, bound in topic.bounds.items()
            if not bounded(subject.name, key, bound, figures).passed
        ]
        fields = run.values[subject.name].fields if subject.name in run.values else {}
        for item in topic.fields:
            name, low, high, same = FIELD.fullmatch(item.where).groups()
            own = fields.get(name)
            if own is None or own.low < float(low or same) or own.high > float(high or same):
                unmet.append(f"{subject.name} {name}")
    whole = run.whole()
    unmet += [
        f"capture {key}"
        for key, bound in expected.bounds.items()
        if not bounded("capture", key, bound, whole).passed
    ]
    grave = {item.rule for item in run.diagnosis.verdicts if item.severity >= Severity.WARNING}
    unmet += [f"verdict {name}" for name in grave - expected.verdicts]
    findings = NOTABLE_FINDINGS & run.ledger.findings.keys()
    return unmet + [f"finding {name}" for name in findings - expected.findings]


def truly(path, expected):
    """Return whether ``check`` refuses a run."""
    source = open_files([path])
    return bool(check(source, Settings([MISSION]).workbench(source.info), expected).failed)


def _loss(run):
    rows = [row for row in run.diagnosis.headlines if row.topic == "/cmd_vel"]
    return sum(row.missing for row in rows) / sum(row.sent for row in rows)


def main():
    """Make the runs, and print the shares."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--real", type=Path, nargs="*", default=[])
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        folder.mkdir(exist_ok=True)
        plain, scaled = drive(folder)
        few = max(2, options.runs // 10)
        good = runs_of(folder, "good", options.runs, plain)
        kinds = {
            "real runs": options.real,
            "10 points more loss": runs_of(folder, "lossy", few, plain, bench=Lossy),
            "9 Hz for 10": runs_of(folder, "slower", few, plain, 9.0),
            "a field scaled by 1.1": runs_of(folder, "scaled", few, scaled),
            "a topic missing": without(folder, good[:few]),
        }
        known = dict(zip(good, read_runs(good, Settings([MISSION])), strict=True))
        others = {name: read_runs(paths, Settings([MISSION])) for name, paths in kinds.items()}
        for name, runs in {"good": list(known.values()), **others}.items():
            print(f"{name}: {len(runs)} runs, {np.mean([_loss(run) for run in runs] or [0]):.1%} lost")
        chance, file = random.Random(1), folder / "expect.yaml"
        for size in (1, 3, 10):
            why, counts, agreed = Counter(), Counter(), 0
            for place in range(options.runs):
                own = [good[place]] if size == 1 else chance.sample(good, size)
                file.write_text(Draft([known[item] for item in own]).text)
                expected = load_expectations(file)
                for path in good:
                    if path not in own:
                        unmet = refused(known[path], expected)
                        why.update(unmet)
                        counts["checks"] += 1
                        counts["refused"] += bool(unmet)
                for name, runs in others.items():
                    counts[name] += sum(bool(refused(run, expected)) for run in runs)
                if place % 20 == 0:
                    path = chance.choice(good)
                    agreed += truly(path, expected) == bool(refused(known[path], expected))
                    for name in list(others)[1:]:
                        path = chance.choice(kinds[name])
                        agreed += truly(path, expected)
            total = counts["checks"]
            print(f"drafts from {size}: {counts['refused']:,} of {total:,} good runs refused", end=" ")
            print(f"({counts['refused'] / total:.2%}) {dict(why.most_common(6))}; as check in {agreed}")
            for name, runs in others.items():
                if runs:
                    print(f"  {name}: {counts[name]:,} of {options.runs * len(runs):,} refused")


if __name__ == "__main__":
    main()
