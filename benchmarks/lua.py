"""tshark with our Lua and without it on one file: the packet list, a filter, fields, trees."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from edoras_tools.pipelines.wireshark.lua import dissector
from edoras_tools.pipelines.workbench import Settings

HERE = Path(__file__).parent
MISSIONS = [HERE.parent / f"samples/missions/two_rovers_{side}.yaml" for side in ("ground", "flight")]
ROUNDS = 3
FIELDS = ["-T", "fields", "-e", "frame.number", "-e"]
PAYLOAD = [*FIELDS, "data.data"]
WORK = {
    "packet_list": ([], [], 1),
    "filtered": (["-Y", "udp.dstport == 1234"], ["-Y", "edoras.msg_id == 0x1827"], 1),
    "one_field": (PAYLOAD, [*FIELDS, "edoras.msg_id"], 1),
    "one_ros_field": (PAYLOAD, [*FIELDS, "ros2.geometry_msgs.Twist.linear.x"], 1),
    "trees": (["-V"], ["-V"], 10),
    "json": (["-T", "json"], ["-T", "json"], 10),
}
"""What tshark is asked for, without our Lua and with it, and of how small a part of the packets.

What it can say of a payload without our Lua is its bytes: ``data.data`` is the peer of a field of ours.
"""


def measure(folder: Path, packets: int) -> dict[str, object]:
    """Return CPU seconds without and with our Lua, by turns, the best of each."""
    capture, script = folder / "lua.pcap", folder / "edoras.lua"
    subprocess.run([sys.executable, HERE / "make_capture.py", capture, str(packets)], check=True)
    script.write_text(dissector(Settings(MISSIONS))[0])
    report: dict[str, object] = {"packets": packets}
    for name, (bare, dissecting, part) in WORK.items():
        read = ["-r", capture, "-c", packets // part]
        without = with_lua = float("inf")
        for _ in range(ROUNDS):
            without = min(without, cpu(["tshark", *read, *bare]))
            with_lua = min(with_lua, cpu(["tshark", "-X", f"lua_script:{script}", *read, *dissecting]))
        report[name] = {
            "tshark_s": round(without, 2),
            "with_lua_s": round(with_lua, 2),
            "packets_per_s": round(packets // part / with_lua),
            "speed_of_tshark": round(without / with_lua, 2),
        }
    return report


def cpu(command: list[object]) -> float:
    """Run a command; return the CPU seconds that it took."""
    process = subprocess.Popen(list(map(str, command)), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        sys.exit(f"{command} ended with status {status}")
    return usage.ru_utime + usage.ru_stime
