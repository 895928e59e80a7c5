"""tshark with our Lua and without it on one file: the packet list, a filter, fields, trees."""

from __future__ import annotations

from typing import TYPE_CHECKING

from paths import MISSIONS, captured
from rounds import command

from edoras_tools.addons.wireshark.program import dissector
from edoras_tools.pipelines.workbench import Settings

if TYPE_CHECKING:
    from pathlib import Path

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
    capture, script = captured(folder, packets), folder / "edoras.lua"
    script.write_text(dissector(Settings(MISSIONS))[0])
    report: dict[str, object] = {"packets": packets}
    for name, (bare, dissecting, part) in WORK.items():
        read = ["-r", capture, "-c", packets // part]
        without = with_lua = float("inf")
        for _ in range(ROUNDS):
            without = min(without, command(["tshark", *read, *bare])["cpu_s"])
            with_lua = min(
                with_lua, command(["tshark", "-X", f"lua_script:{script}", *read, *dissecting])["cpu_s"]
            )
        report[name] = {
            "tshark_s": round(without, 2),
            "with_lua_s": round(with_lua, 2),
            "packets_per_s": round(packets // part / with_lua),
            "speed_of_tshark": round(without / with_lua, 2),
        }
    return report
