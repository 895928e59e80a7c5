"""The tour: an emulated cFS with two rovers on loopback, captured, decoded and recorded at the same time."""

from __future__ import annotations

from contextlib import nullcontext
from importlib.resources import as_file, files
from pathlib import Path
from time import time_ns
from typing import TYPE_CHECKING, Final

from edoras_tools.addons.lab.emulator import BOOT_NS, Served, Simulation
from edoras_tools.addons.lab.emulator.source import SimulatedSource
from edoras_tools.errors import CaptureError
from edoras_tools.io.capture.live import open_live
from edoras_tools.io.outputs import write_files
from edoras_tools.pipelines.capture.record import CaptureReport, Target, check_output, record
from edoras_tools.pipelines.reading import Limits
from edoras_tools.pipelines.workbench import Settings, Workbench, open_files

if TYPE_CHECKING:
    from collections.abc import Callable

    from edoras_tools.io import Source
    from edoras_tools.model import Columns, Decoded, PacketBatch

SAMPLES: Final = files("edoras_tools.samples")
_COMMAND_RATE_HZ: Final = 10.0


def unpack(folder: Path, *, replace: bool = False) -> tuple[Path, Path]:
    """Copy the sample missions, the capture and the Foxglove layout into the user's folder.

    Args:
        folder: target; it is created.
        replace: overwrite files of these names.

    Returns:
        The folder of missions, and the capture.

    Raises:
        ConfigError: such a file exists, and has other contents.
        CaptureError: a file cannot be written.
    """
    with as_file(SAMPLES) as samples:
        missions = [path for path in (samples / "missions").rglob("*") if path.is_file()]
        copies = {folder / path.relative_to(samples): path.read_bytes() for path in missions}
        for name in ("captures/a_rover.pcap", "foxglove_layout.json"):
            copies[folder / Path(name).name] = (samples / name).read_bytes()
    try:
        write_files(copies, force=replace)
    except CaptureError as error:
        raise CaptureError(f"{error}; name another folder with -o") from None
    return folder / "missions", folder / "a_rover.pcap"


def tour(
    folder: Path,
    seconds: float,
    *,
    show: Callable[[Decoded], None],
    notice: Callable[[str], None],
    replace: bool = False,
) -> tuple[CaptureReport, CaptureReport]:
    """Run the tour; return the reports of the live link's recording, and of the sample capture's.

    Args:
        show: called with every packet of the live link.
        notice: called with each note, one line.
        replace: overwrite the files of another tour in that folder.

    Raises:
        ConfigError: files of these names exist.
        CaptureError: a port is in use, or the folder cannot be written.
    """
    live = Target(folder / "two_rovers.mcap", transforms=True, replace=replace)
    recording = Target(folder / "a_rover.mcap", transforms=True, replace=replace)
    for target in (live, recording):
        check_output(target, ())
    missions, capture = unpack(folder, replace=replace)
    settings = Settings((missions / "two_rovers_ground.yaml", missions / "two_rovers_flight.yaml"))
    bench = settings.workbench()
    simulation = Simulation(
        scenario="two-rovers",
        start_ns=time_ns() - BOOT_NS,
        command_rate_hz=_COMMAND_RATE_HZ,
        state_rate_hz=_COMMAND_RATE_HZ,
    ).boot()
    duration_ns = int(seconds * 1e9)
    source = _source(simulation, duration_ns, bench, notice)

    def tap(batch: PacketBatch, _columns: Columns) -> None:
        for row in range(len(batch)):
            show(bench.dissector.dissect(batch[row]))

    with Served(simulation) if source.live else nullcontext():
        limits = Limits(duration_ns=duration_ns)
        report = record(source, bench, live, limits=limits, tap=tap)
    rover = Settings((missions / "rover_ground.yaml",)).workbench()
    real = record(open_files([capture]), rover, recording)
    return report, real


def _source(
    simulation: Simulation, duration_ns: int, bench: Workbench, notice: Callable[[str], None]
) -> Source:
    try:
        return open_live("lo", bench.columns.context.capture_ports())
    except CaptureError as error:
        notice(f"{error}")
        notice("therefore the same link runs in simulated time")
        return SimulatedSource(simulation, duration_ns)
