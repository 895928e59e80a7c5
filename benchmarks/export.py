"""Export of Twist messages to Parquet and CSV, beside a loop over the same recording with rosbags."""

from __future__ import annotations

import resource
import struct
import subprocess
import sys
import time
from typing import TYPE_CHECKING

import numpy as np
from paths import EDORAS, MISSION, ROVER

from edoras_tools.io.formats.open import open_file
from edoras_tools.pipelines.workbench import Settings

if TYPE_CHECKING:
    from pathlib import Path

ROUNDS, STEP_US = 3, 100
LOOP = """
import sys
import pyarrow, pyarrow.parquet
from pathlib import Path
from rosbags.highlevel import AnyReader
rows = {name: [] for name in ("time", "lx", "ly", "lz", "ax", "ay", "az")}
with AnyReader([Path(sys.argv[1])]) as reader:
    chosen = [item for item in reader.connections if item.topic == "/cmd_vel"]
    for connection, time_ns, raw in reader.messages(chosen):
        message = reader.deserialize(raw, connection.msgtype)
        linear, angular = message.linear, message.angular
        values = time_ns, linear.x, linear.y, linear.z, angular.x, angular.y, angular.z
        for column, value in zip(rows.values(), values):
            column.append(value)
pyarrow.parquet.write_table(pyarrow.table(rows), sys.argv[2], compression="zstd")
"""
"""What people write who have a rosbag2 recording; it reads only the topic that it exports."""


def make_twists(path: Path, count: int) -> None:
    """Write a capture of commands of the sample, each with values of its own."""
    bench = Settings([MISSION]).workbench()
    batch = next(iter(open_file(ROVER).batches()))
    columns = bench.columns.decode(batch)
    row = int(np.flatnonzero(columns.route == bench.mission.routes.index(bench.mission.find("/cmd_vel")))[0])
    first, size = int(batch.frame_offset[row]), int(batch.frame_length[row])
    body = int(columns.cdr_offset[row]) - first + 4
    records = np.zeros(count, [("head", "<u4", 4), ("frame", "u1", size)])
    records["head"][:, 0], records["head"][:, 1] = np.divmod(
        1_795_241_000_000_000 + np.arange(count) * STEP_US, 1_000_000
    )
    records["head"][:, 2:] = size
    records["frame"] = batch.data[first : first + size]
    values = np.random.default_rng(1).normal(size=(count, 6))
    records["frame"][:, body : body + 48] = values.view(np.uint8).reshape(count, 48)
    path.write_bytes(struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 262144, 1) + records.tobytes())


def timed(command: list[str], makes: Path, rounds: int) -> dict[str, float]:
    """Run a command; return its best wall and CPU times in seconds. What it makes is removed before."""
    wall, busy = [], []
    for _ in range(rounds):
        makes.unlink(missing_ok=True)
        began, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        wall.append(time.perf_counter() - began)
        busy.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return {"wall_s": round(min(wall), 2), "cpu_s": round(min(busy), 2)}


def measure(folder: Path, count: int) -> dict[str, object]:
    """Time whole commands, start-up included."""
    capture, bag = folder / "twists.pcap", folder / "twists"
    make_twists(capture, count)
    mission = ["-c", str(MISSION)]
    export = [EDORAS, "export", "-q", str(capture), *mission, "--topic", "/cmd_vel", "-o"]
    parquet, csv, loop = (folder / f"{name}" for name in ("twists.parquet", "twists.csv", "loop.parquet"))
    found: dict[str, object] = {
        "rows": count,
        "parquet": timed([*export, str(parquet)], parquet, ROUNDS),
        "csv": timed([*export, str(csv)], csv, 1),
    }
    subprocess.run([EDORAS, "record", "-q", "-r", capture, *mission, "--rosbag2", "-o", bag], check=True)
    return {**found, "rosbags_loop": timed([sys.executable, "-c", LOOP, str(bag), str(loop)], loop, 1)}
