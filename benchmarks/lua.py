"""tshark with our Lua beside tshark without it, on the same file: its packet list, a filter, one field."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from edoras_tools.pipelines.wireshark import dissector
from edoras_tools.pipelines.workbench import Settings

HERE = Path(__file__).parent
MISSIONS = [HERE.parent / f"samples/missions/two_rovers_{side}.yaml" for side in ("ground", "flight")]
ROUNDS = 3
FIELDS = ["-T", "fields", "-e", "frame.number", "-e"]
WORK = {
    "packet_list": ([], []),
    "filtered": (["-Y", "udp.dstport == 1234"], ["-Y", "edoras.msg_id == 0x1827"]),
    "one_field": ([*FIELDS, "udp.length"], [*FIELDS, "edoras.msg_id"]),
}
"""What tshark is asked for, without our Lua and with it."""


def measure(folder: Path, packets: int) -> dict[str, object]:
    """Return CPU seconds without and with our Lua, by turns, the best of each."""
    capture, script = folder / "lua.pcap", folder / "edoras.lua"
    subprocess.run([sys.executable, HERE / "make_capture.py", capture, str(packets)], check=True)
    script.write_text(dissector(Settings(MISSIONS))[0])
    report: dict[str, object] = {"packets": packets}
    for name, (bare, dissecting) in WORK.items():
        without = with_lua = float("inf")
        for _ in range(ROUNDS):
            without = min(without, cpu(["tshark", "-r", capture, *bare]))
            with_lua = min(
                with_lua, cpu(["tshark", "-X", f"lua_script:{script}", "-r", capture, *dissecting])
            )
        report[name] = {
            "tshark_s": round(without, 2),
            "with_lua_s": round(with_lua, 2),
            "packets_per_s": round(packets / with_lua),
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
