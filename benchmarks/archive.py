"""Index many captures with known losses: with one worker and with two, killed and resumed, on a dask cluster.

    python benchmarks/archive.py make DIR [COUNT]  # captures, and truth.json: what was lost in each
    python benchmarks/archive.py jobs DIR [KILLS]  # one worker, two, and two that are killed at random
                                                   # and resumed: time, CPU time, equal results, truth
    python benchmarks/archive.py kill DIR [KILLS]  # only killed and resumed: same index
    python benchmarks/archive.py cluster DIR       # dask's own programs, one worker killed: same index

The captures are those of an emulated cFS, with telemetry taken out at random or with more commands than its
application takes, and the rover's sample, each at a time of its own. What was taken out, and what the
emulator counted, is the truth that the index is held to.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import duckdb
import numpy as np
from msgspec.structs import replace
from paths import EDORAS, MISSION, ROVER

from edoras_tools.addons.archive.index import TABLES
from edoras_tools.addons.lab.emulator import Simulation
from edoras_tools.addons.lab.emulator.simulation import frames_of
from edoras_tools.io.formats.open import open_file
from edoras_tools.io.formats.pcap import PcapSink
from edoras_tools.io.frames.linklayer import Demux
from edoras_tools.model import concatenate
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.units import SECOND

START_NS = 1_772_323_200 * SECOND
"""2026-03-01."""
SPAN_S = 240 * 86_400
QUIET_S = 16
BASES = 12
POSE, DRIVE, SAMPLE_LOST = 0x0827, 0x1827, 92


def simulated(seed: int, hertz: float):
    """Return the datagrams of a rover at 2026-03-01, and how many commands a full queue lost."""
    seconds = random.Random(seed).randint(30, 90)
    simulation = Simulation(
        None, "rover", start_ns=START_NS, command_rate_hz=hertz, command_count=int(hertz * seconds)
    )
    sent = list(simulation.run(START_NS + (seconds + QUIET_S) * SECOND))
    return Demux().demux(frames_of(sent)), simulation.cfs.bus.counters.msg_limits


def telemetry_rows(batch) -> np.ndarray:
    """Return the rows of the rover's pose, but for the first and the last: what is missing there shows."""
    bench = Settings([MISSION]).workbench()
    columns = bench.columns.decode(batch)
    return np.flatnonzero(columns.msg_id == POSE)[1:-1]


def make(folder: Path, count: int) -> None:
    """Write captures and the truth."""
    chance = random.Random(1)
    clean = [simulated(seed, 3.0)[0] for seed in range(BASES)]
    poses = [telemetry_rows(batch) for batch in clean]
    full = [simulated(100 + seed, chance.choice([6.0, 9.0, 14.0])) for seed in range(BASES)]
    rover = concatenate(list(open_file(ROVER).batches()))
    truth = {}
    for number in range(count):
        at_ns = chance.randrange(SPAN_S) * SECOND
        kind = number % 20
        if kind == 0:
            batch, lost, begin_ns = rover, {f"0x{DRIVE:04x}": SAMPLE_LOST}, int(rover.time_ns[0])
        elif kind < 4:
            batch, limited = chance.choice(full)
            lost, begin_ns = ({f"0x{DRIVE:04x}": limited} if limited else {}), START_NS
        else:
            base = chance.randrange(BASES)
            batch, begin_ns = clean[base], START_NS
            taken = chance.sample(poses[base].tolist(), chance.choice([0, 0, 1, 2, 5, 9]))
            batch = batch.take(np.delete(np.arange(len(batch)), taken))
            lost = {f"0x{POSE:04x}": len(taken)} if taken else {}
        path = folder / f"{number % 10}" / f"run_{number:05}.pcap"
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("wb") as file:
            sink = PcapSink(file)
            sink.write(replace(batch, time_ns=batch.time_ns - begin_ns + START_NS + at_ns), None)
            sink.close(None)
        truth[str(path.resolve())] = lost
    (folder / "truth.json").write_text(json.dumps(truth))
    size = sum(path.stat().st_size for path in folder.rglob("*.pcap"))
    print(
        f"{count} captures, {size / 2**20:.0f} MiB, {sum(sum(item.values()) for item in truth.values())} lost"
    )


TIMED = """
import resource, sys, time
from edoras_tools.cli import main
began = time.monotonic()
code = 0
try:
    main.run(main.program("archive"))
except SystemExit as end:
    code = end.code
own, others = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
print(time.monotonic() - began, own.ru_utime + own.ru_stime, others.ru_utime + others.ru_stime, code)
"""


def indexed(folder: Path, index: Path, *options: str) -> list[float]:
    """Index a folder; return seconds, CPU seconds of the program and of its workers, and the exit code."""
    command = [sys.executable, "-c", TIMED, "archive", str(folder), "--index", str(index), "-q"]
    done = subprocess.run(
        [*command, "-c", str(MISSION), *options], check=True, stdout=subprocess.PIPE, text=True
    )
    return [float(word) for word in done.stdout.split()]


def contents(index: Path) -> dict[str, int]:
    """Return a hash of the rows of every table, in an order of their own."""
    with duckdb.connect(str(index), read_only=True) as opened:
        return {
            name: opened.execute(f"SELECT count(*), sum(hash(t)::HUGEINT) FROM {name} t").fetchall()
            for name in TABLES
        }


def held_to_truth(index: Path, folder: Path) -> str:
    """Return how many captures have exactly the losses that are known."""
    truth = json.loads((folder / "truth.json").read_text())
    sql = "SELECT capture, msg_id, sum(lost)::INT FROM outcomes WHERE lost > 0 GROUP BY ALL"
    found: dict[str, dict[str, int]] = {name: {} for name in truth}
    with duckdb.connect(str(index), read_only=True) as opened:
        for capture, msg_id, lost in opened.execute(sql).fetchall():
            found[capture][msg_id] = lost
        total = opened.execute("SELECT sum(lost)::INT FROM captures").fetchone()[0]
    right = sum(found[name] == lost for name, lost in truth.items())
    known = sum(sum(item.values()) for item in truth.values())
    for name in [name for name in truth if found[name] != truth[name]][:5]:
        print(f"  {name}: {found[name]}, known {truth[name]}")
    return f"{right} of {len(truth)} captures have the known losses; {total} lost, known {known}"


def jobs(folder: Path, kills: int) -> None:
    """Index with one worker, with two, and with two that are killed and resumed."""
    with tempfile.TemporaryDirectory() as temporary:
        one, two = Path(temporary) / "1.duckdb", Path(temporary) / "2.duckdb"
        print(f"load {os.getloadavg()[0]:.1f} on {len(os.sched_getaffinity(0))} cores")
        times = {}
        for number, index in ((1, one), (2, two)):
            times[number] = indexed(folder, index, "--jobs", str(number))
            seconds, own, others, _ = times[number]
            print(f"--jobs {number}: {seconds:.1f} s; CPU: coordinator {own:.1f} s, workers {others:.1f} s")
        again = indexed(folder, two, "--jobs", "2")
        print(f"nothing new: {again[0]:.1f} s")
        print(f"one to two: {times[1][0] / times[2][0]:.2f}; equal: {contents(one) == contents(two)}")
        print(held_to_truth(two, folder))
        index = Path(temporary) / "killed.duckdb"
        equal = killed(folder, index, times[2][0], kills) and contents(two) == contents(index)
        print(f"killed {kills} times and resumed: equal: {equal}; {held_to_truth(index, folder)}")


def kill(folder: Path, kills: int) -> None:
    """Kill the program at random moments, and resume it."""
    with tempfile.TemporaryDirectory() as temporary:
        whole, index = Path(temporary) / "whole.duckdb", Path(temporary) / "killed.duckdb"
        equal = killed(folder, index, indexed(folder, whole)[0], kills) and contents(whole) == contents(index)
        print(f"resumed; equal: {equal}; {held_to_truth(index, folder)}")


def killed(folder: Path, index: Path, seconds: float, kills: int) -> bool:
    """Index a folder, killed so many times on the way; return whether some kill left one half done.

    Args:
        folder: the captures.
        index: where their index is made.
        seconds: how long it takes in one go. Each try has from 0.4 to 1.2 of its share, so
            that the last kills come before the end.
        kills: how many times.
    """
    chance, shares = random.Random(2), []
    total = len(json.loads((folder / "truth.json").read_text()))
    command = [EDORAS, "archive", str(folder), "--index", str(index), "-q", "-c", str(MISSION)]
    for _ in range(kills):
        with subprocess.Popen(command, start_new_session=True) as running:
            time.sleep(2 + chance.uniform(0.4, 1.2) * seconds / (kills + 1))
            over = running.poll() is not None
            running.send_signal(signal.SIGKILL)
        await_workers(running.pid)
        count = 0
        if index.exists():
            with duckdb.connect(str(index)) as opened:
                tables = opened.execute("SELECT count(*) FROM duckdb_tables()").fetchone()[0]
                count = opened.execute("SELECT count(*) FROM captures").fetchone()[0] if tables else 0
        print(f"  {'ended before it was killed' if over else 'killed'}; {count} of {total} captures indexed")
        shares.append(0 if over else count)
    subprocess.run(command, check=True)
    return any(0 < count < total for count in shares)


def await_workers(group: int) -> None:
    """Wait until the workers of a program that was killed have noticed."""
    for _ in range(600):
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return
        time.sleep(0.1)
    sys.exit("workers outlive the program by more than a minute")


def cluster(folder: Path) -> None:
    """Index with dask's own programs; then again, and kill one of the workers."""
    dask = str(Path(sys.executable).with_name("dask"))
    with tempfile.TemporaryDirectory() as temporary:
        whole = Path(temporary) / "whole.duckdb"
        seconds = indexed(folder, whole)[0]
        address_file = Path(temporary) / "scheduler.json"
        quiet = {"stderr": subprocess.DEVNULL}
        words = ["--scheduler-file", str(address_file)]
        started = [
            subprocess.Popen([dask, "scheduler", "--host", "127.0.0.1", "--port", "0", *words], **quiet)
        ]
        try:
            while not address_file.exists():
                time.sleep(0.1)
            address = json.loads(address_file.read_text())["address"]
            worker = [
                dask,
                "worker",
                address,
                "--nthreads",
                "1",
                "--no-nanny",
                "--local-directory",
                temporary,
            ]
            started += [subprocess.Popen(worker, **quiet) for _ in range(2)]
            for name, victim in (("two workers", None), ("one killed", started[1])):
                index = Path(temporary) / f"{name}.duckdb"
                command = [EDORAS, "archive", str(folder), "--index", str(index), "-c", str(MISSION)]
                with subprocess.Popen([*command, "--scheduler", address]) as running:
                    if victim is not None:
                        time.sleep(0.3 * seconds)
                        victim.kill()
                assert running.returncode == 0
                print(f"{name}: equal: {contents(whole) == contents(index)}")
        finally:
            for item in reversed(started):
                item.terminate()
                item.wait()


def main() -> None:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=["make", "jobs", "kill", "cluster"])
    parser.add_argument("folder", type=Path)
    parser.add_argument("count", type=int, nargs="?", default=0)
    options = parser.parse_args()
    if options.what == "make":
        make(options.folder, options.count or 2000)
    elif options.what == "jobs":
        jobs(options.folder, options.count or 5)
    elif options.what == "kill":
        kill(options.folder, options.count or 5)
    else:
        cluster(options.folder)


if __name__ == "__main__":
    main()
