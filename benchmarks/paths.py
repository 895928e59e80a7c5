"""What the benchmarks read and run: the installed program, the samples, and captures that a script makes."""

from __future__ import annotations

import compileall
import os
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
EDORAS = str(Path(sys.executable).with_name("edoras"))
ROVER, MISSION = ROOT / "samples/captures/a_rover.pcap", ROOT / "samples/missions/rover_ground.yaml"
MISSIONS = [ROOT / f"samples/missions/two_rovers_{side}.yaml" for side in ("ground", "flight")]
"""Of the traffic in the captures that are made."""
TWO_ROVERS = [argument for path in MISSIONS for argument in ("-c", str(path))]


def compiled() -> None:
    """Compile the modules that are measured, and let programs use that: else each start does it anew."""
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    for name in ("edoras_tools", "dissectors"):
        compileall.compile_dir(ROOT / name, quiet=1)


def captured(folder: Path, packets: int, tcp: int = 0) -> Path:
    """Return a capture of mixed traffic, ``tcp`` % of it over TCP, made where the folder has none."""
    capture = folder / (f"{packets}_tcp_{tcp}.pcap" if tcp else f"{packets}.pcap")
    if not capture.exists():
        make = [sys.executable, HERE / "make_capture.py", capture, str(packets), "--tcp", str(tcp)]
        subprocess.run(make, check=True)
    return capture
