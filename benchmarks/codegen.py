"""The generated C beside rosbags: one message from CDR and back to CDR."""

from __future__ import annotations

import json
import random
import shutil
import subprocess
import sys
import time
from pathlib import Path

from rosbags.typesys import Stores, get_typestore

from edoras_tools.addons.codegen.generation import LibraryOrder, generate
from edoras_tools.addons.codegen.plan import BoundRule, Bounds
from edoras_tools.addons.codegen.writing import write_folder
from edoras_tools.pipelines.sending.inject import arbitrary
from edoras_tools.ros import TypeStore

JOINTS = [f"big_arm_joint_{number}" for number in range(2, 9)]
MESSAGES = {
    "geometry_msgs/msg/Twist": {},
    "geometry_msgs/msg/PoseStamped": {"header": {"frame_id": "world"}},
    "sensor_msgs/msg/JointState": {"name": JOINTS, "position": [0.5] * 7},
    "nav_msgs/msg/Odometry": None,
    "sensor_msgs/msg/LaserScan": {"ranges": [1.5] * 1080},
    "sensor_msgs/msg/PointCloud2": {"data": [7] * 32000},
}
BOUNDS = (
    BoundRule.read("sensor_msgs/LaserScan.ranges=1080"),
    BoundRule.read("sensor_msgs/PointCloud2.data=32000"),
)
SECONDS = 0.5
DRIVER = """\
#define _POSIX_C_SOURCE 199309L
#include <stdio.h>
#include <time.h>
#include <edoras_core/interface.h>

static double now(void)
{
    struct timespec spec;

    clock_gettime(CLOCK_MONOTONIC, &spec);
    return (double)spec.tv_sec + 1e-9 * (double)spec.tv_nsec;
}

int main(int count, char **arguments)
{
    static uint8_t cdr[65536], back[65536];
    static double message[65536];
    const TypeInfo_t *const type = get_type_info(arguments[1], arguments[2]);
    const size_t size = fread(cdr, 1U, sizeof(cdr), stdin);
    size_t length = 0U;
    long rounds = 0;
    double begun = now(), passed;

    do {
        for (int i = 0; i < 1000; ++i) {
            if ((type->decode(message, cdr, size) != EDORAS_OK) ||
                (type->encode(message, back, sizeof(back), &length) != EDORAS_OK) || (length != size)) {
                return 1;
            }
        }
        rounds += 1000;
        passed = now() - begun;
    } while (passed < SECONDS);
    printf("%.3f ", 1e6 * passed / (double)rounds);
    begun = now();
    rounds = 0;
    do {
        for (int i = 0; i < 1000; ++i) {
            (void)set_uint32((uint8_t *)message, type, "header.stamp.nanosec", (uint32_t)i);
        }
        rounds += 1000;
        passed = now() - begun;
    } while (passed < SECONDS);
    printf("%.3f\\n", 1e6 * passed / (double)rounds);
    return count != 3;
}
"""


def measure(folder: Path) -> dict[str, object]:
    """Return microseconds a message, both ways together, of each, and how many times faster the C is."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        sys.exit("a C compiler is missing: apt install gcc")
    out, store, theirs = folder / "codegen", TypeStore(), get_typestore(Stores.ROS2_JAZZY)
    write_folder(out, generate(store, LibraryOrder(tuple(MESSAGES), Bounds(64, 40, BOUNDS))).files)
    (out / "driver.c").write_text(DRIVER)
    program = out / "driver"
    command = [
        compiler,
        "-O2",
        "-std=c99",
        f"-DSECONDS={SECONDS}",
        f"-I{out}",
        *map(str, sorted(out.glob("*.c"))),
    ]
    subprocess.run([*command, "-o", str(program)], check=True)
    results: dict[str, object] = {}
    for name, values in MESSAGES.items():
        cdr = store.encode(name, arbitrary(store, name, random.Random(1)) if values is None else values)
        package, _, short = name.split("/")
        printed = subprocess.run(
            [str(program), package, short], input=cdr, check=True, stdout=subprocess.PIPE, timeout=60
        ).stdout
        ours, by_name = map(float, printed.split())
        rounds, begun = 0, time.perf_counter()
        while time.perf_counter() - begun < SECONDS:
            for _ in range(100):
                theirs.serialize_cdr(theirs.deserialize_cdr(cdr, name), name)
            rounds += 100
        rosbags = 1e6 * (time.perf_counter() - begun) / rounds
        results[name] = {
            "cdr_bytes": len(cdr),
            "c_us": round(ours, 3),
            "rosbags_us": round(rosbags, 2),
            "times": round(rosbags / ours, 1),
        } | ({"set_by_name_us": round(by_name, 3)} if name.endswith("JointState") else {})
    return results


if __name__ == "__main__":
    import tempfile

    with tempfile.TemporaryDirectory() as place:
        print(json.dumps(measure(Path(place)), indent=2))
