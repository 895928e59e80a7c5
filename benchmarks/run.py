"""Measure edoras-tools beside tshark on this machine, in one run; print a table and keep it as JSON.

Run: make bench            (or: python benchmarks/run.py [--packets N] [--only NAME])
Figures are ratios where a peer does comparable work: machines are noisy, their noise is shared.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

import bridge
import codegen
import export
import filters
import foxglove_live
import limits
import lua
import pacing
import proxy
import rows
import tui
from paths import EDORAS, HERE, MISSION, ROVER, TWO_ROVERS, captured, compiled

ROUNDS = 3
LIVE_RATE, LIVE_BYTES, LIVE_SECONDS = 100_000, 200, 10
LIVE_PORT = 1234
ENDS = {0, 3}
"""Exit codes of a command that did its work: 3 where it found losses."""


def timed(command: list[str], *, rounds: int = ROUNDS, makes: Path | None = None) -> float:
    """Run a command; return its best wall time in seconds.

    What it ``makes`` is removed before, so that no round has to empty the file of the one before.
    """
    best = float("inf")
    for _ in range(rounds):
        if makes:
            makes.unlink(missing_ok=True)
        began = time.perf_counter()
        done = subprocess.run(command, check=False, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        if done.returncode not in ENDS:
            sys.exit(f"{' '.join(command)} ended with {done.returncode}")
        best = min(best, time.perf_counter() - began)
    return best


def peak_memory(command: list[str], makes: Path) -> float:
    """Run a command that makes a file anew; return the most memory in MiB that it and its processes had."""
    makes.unlink(missing_ok=True)
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    most = 0
    while process.poll() is None:
        with suppress(OSError):  # it has just ended
            children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
            most = max(most, sum(proportional_kib(each) for each in (process.pid, *children)))
        time.sleep(0.01)
    if process.returncode not in ENDS:
        sys.exit(f"{' '.join(command)} ended with {process.returncode}")
    return most / 1024


def proportional_kib(process: int | str) -> int:
    """Return the memory of a process; what several share is divided among them."""
    lines = Path(f"/proc/{process}/smaps_rollup").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("Pss:"))


def first_line(command: list[str]) -> float:
    """Return the best time in seconds until a command's first line."""
    best = float("inf")
    for _ in range(ROUNDS):
        began = time.perf_counter()
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
            process.stdout.readline()
            best = min(best, time.perf_counter() - began)
            process.kill()
    return best


def record_beside_tshark(folder: Path, packets: int) -> dict[str, object]:
    """File to MCAP, beside tshark printing three fields of the same file, and zstd compressing it."""
    capture = captured(folder, packets)
    fields = ["-T", "fields", "-e", "frame.time_epoch", "-e", "udp.dstport", "-e", "data.data"]
    recording = folder / "mixed.mcap"
    plain = [EDORAS, "record", "-q", "-r", str(capture), "-o", str(recording)]
    record = [*plain, *TWO_ROVERS]
    without = timed(plain, makes=recording)
    ours = timed(record, makes=recording)
    theirs = timed(["tshark", "-r", str(capture), *fields], rounds=1)
    ours = min(ours, timed(record, makes=recording))
    jobs = [timed([*record, "--jobs", str(count)], makes=recording) for count in (1, 2)]
    packed = folder / "mixed.zst"
    pack = ["zstd", "-q", "-1", str(capture), "-o", str(packed)]
    zstd = timed(pack, makes=packed) if shutil.which("zstd") else None
    report = json.loads(
        subprocess.run([EDORAS, "info", "--json", recording], check=True, capture_output=True).stdout
    )
    if report["datagrams"] != packets:
        sys.exit(f"{report['datagrams']} of {packets} datagrams were recorded")
    return {
        "packets": packets,
        "file_mib": round(capture.stat().st_size / 2**20),
        "edoras_s": round(ours, 3),
        "tshark_s": round(theirs, 3),
        "edoras_packets_per_s": round(packets / ours),
        "tshark_packets_per_s": round(packets / theirs),
        "times_tshark": round(theirs / ours, 1),
        "one_job_s": round(jobs[0], 3),
        "two_jobs_s": round(jobs[1], 3),
        "zstd_1_s": zstd and round(zstd, 3),
        "without_mission_s": round(without, 3),
        "times_tshark_without_mission": round(theirs / without, 1),
        "peak_memory_mib": round(peak_memory(record, recording)),
    }


def one_and_two_processes(folder: Path, packets: int) -> dict[str, object]:
    """What reads whole files, with one process and with two; beside it zstd compressing the same file."""
    capture = captured(folder, packets)
    made = folder / "jobs"
    commands = {
        "record": ["record", "-q", "--force", "-o", f"{made}.mcap"],
        "info": ["info", "-q"],
        "doctor": ["doctor", "-q"],
        "export": ["export", "-q", "--force", "-o", f"{made}/"],
    }
    results: dict[str, object] = {"packets": packets}
    for name, command in commands.items():
        times = []
        for count in ("1", "2"):
            whole = [EDORAS, *command, *TWO_ROVERS, "--jobs", count, str(capture)]
            times.append(timed(whole, rounds=1))
            results[f"{name}_{count}_job_s"] = round(times[-1], 2)
            results[f"{name}_{count}_job_mib"] = round(peak_memory(whole, Path(f"{made}.mcap")))
        results[f"{name}_times_one"] = round(times[0] / times[1], 2)
    results |= two_recordings(folder, capture)
    if shutil.which("zstd"):
        pack = ["zstd", "-q", "-f", "-1", str(capture), "-o", f"{made}.zst"]
        results["zstd_1_s"] = round(timed(pack, rounds=1), 2)
    return results


def two_recordings(folder: Path, capture: Path) -> dict[str, object]:
    """Two recordings at once without ``--jobs``, beside one: how many times as much is done in a second."""
    made = [folder / f"at_once_{number}.mcap" for number in range(2)]
    commands = [[EDORAS, "record", "-q", *TWO_ROVERS, "-r", str(capture), "-o", str(path)] for path in made]
    one = {
        "one_job": timed([*commands[0], "--jobs", "1"], rounds=1, makes=made[0]),
        "alone": timed(commands[0], rounds=1, makes=made[0]),
    }
    made[0].unlink()
    began = time.perf_counter()
    running = [subprocess.Popen(command) for command in commands]
    if sum(process.wait() for process in running):
        sys.exit("one of two recordings failed")
    both = time.perf_counter() - began
    return {
        "two_records_s": round(both, 2),
        **{f"two_records_times_{name}": round(2 * seconds / both, 2) for name, seconds in one.items()},
    }


def memory_of_a_large_file(folder: Path, packets: int) -> dict[str, object]:
    """Peak memory does not grow with the file."""
    capture = captured(folder, packets)
    recording = folder / "large.mcap"
    record = [EDORAS, "record", "-q", "-r", str(capture), *TWO_ROVERS, "-o", str(recording)]
    return {
        "packets": packets,
        "seconds": round(timed(record, rounds=1, makes=recording), 2),
        "peak_memory_mib": round(peak_memory(record, recording)),
    }


def live(folder: Path) -> dict[str, object]:
    """Datagrams from another process over loopback into a recording, none lost."""
    target = folder / "live.mcap"
    recorder = subprocess.Popen(
        [EDORAS, "record", "-i", "lo", "-o", str(target), "--json", *TWO_ROVERS],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    while "capturing" not in recorder.stderr.readline():
        if recorder.poll() is not None:
            sys.exit("the recorder did not start: live capture needs CAP_NET_RAW")
    sender = subprocess.run(
        [
            sys.executable,
            HERE / "sender.py",
            str(LIVE_PORT),
            str(LIVE_RATE),
            str(LIVE_BYTES),
            str(LIVE_SECONDS),
        ],
        check=True,
        capture_output=True,
        text=True,
    )
    sent = json.loads(sender.stdout)
    time.sleep(0.5)
    recorder.send_signal(signal.SIGINT)
    report = json.loads(recorder.communicate()[0])
    recorded = json.loads(
        subprocess.run([EDORAS, "info", "--json", str(target)], check=True, capture_output=True).stdout
    )
    return {
        "sent": sent["sent"],
        "sent_per_s": round(sent["sent"] / sent["seconds"]),
        "recorded": recorded["datagrams"],
        "kernel_drops": report["capture_drops"],
        "lost": sent["sent"] - recorded["datagrams"],
    }


def start_up() -> dict[str, object]:
    """Time until the first thing a user sees."""
    capture, mission = str(ROVER), str(MISSION)
    return {
        "edoras_help_s": round(timed([EDORAS, "--help"], rounds=5), 3),
        "edoras_sniff_first_line_s": round(first_line([EDORAS, "sniff", "-r", capture, "-c", mission]), 3),
        "tshark_first_line_s": round(first_line(["tshark", "-r", capture]), 3),
    }


def processor() -> str:
    """Return the name of the processor, as Linux tells it."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(": ")[2]
    return platform.processor()


def main() -> None:
    """Run all benchmarks, or one."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--packets", type=int, default=1_000_000)
    parser.add_argument(
        "--only",
        choices=[
            *("record", "jobs", "memory", "live", "limits", "startup", "pacing"),
            *(
                "texts",
                "tcp",
                "sbn",
                "starts",
                "doctor",
                "images",
                "counts",
                "window",
                "topic",
                "growth",
                "files",
                "messages",
                "inject",
                "relays",
                "shares",
            ),
            "highest",
            *("proxy", "bridge", "foxglove", "where", "lua", "codegen", "tui", "export"),
        ],
    )
    options = parser.parse_args()
    if not shutil.which("tshark"):
        sys.exit("tshark is missing: make judges")
    compiled()
    results: dict[str, object] = {
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "processor": processor(),
        "load": os.getloadavg(),
    }
    took_s: dict[str, int] = {}
    results["took_s"] = took_s
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for key, run in {
            "startup": start_up,
            "record": lambda: record_beside_tshark(folder, options.packets),
            **rows.measure(folder, options.packets),
            "jobs": lambda: one_and_two_processes(folder, 4 * options.packets),
            "memory": lambda: memory_of_a_large_file(folder, 4 * options.packets),
            "live": lambda: live(folder),
            "limits": lambda: limits.measure(folder),
            "pacing": lambda: pacing.measure(folder),
            "proxy": lambda: proxy.measure(folder),
            "bridge": lambda: bridge.measure(folder),
            "foxglove": foxglove_live.measure,
            "where": lambda: filters.measure(folder, options.packets),
            "lua": lambda: lua.measure(folder, options.packets // 5),
            "codegen": lambda: codegen.measure(folder),
            "tui": lambda: tui.measure(folder, options.packets),
            "export": lambda: export.measure(folder, options.packets),
        }.items():
            if options.only in {None, key}:
                began = time.monotonic()
                results[key] = run()
                took_s[key] = round(time.monotonic() - began)
                print(key, json.dumps(results[key], indent=2), f"\ntook {took_s[key]} s", flush=True)
    out = HERE / "out"
    out.mkdir(exist_ok=True)
    (out / "results.json").write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
