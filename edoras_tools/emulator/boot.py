"""Which applications the emulated cFS starts, and in which order."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from edoras_tools.emulator.apps.core import start_core
from edoras_tools.emulator.apps.generator import Generator
from edoras_tools.emulator.apps.lab import CiLab, SchLab, ToLab
from edoras_tools.emulator.apps.sbn import SbnApp

if TYPE_CHECKING:
    from edoras_tools.emulator.apps.edoras import EdorasApp
    from edoras_tools.emulator.cfs import Cfs


@dataclass(frozen=True, slots=True, eq=False)
class Apps:
    """The applications of one emulated cFS whose state can be looked at.

    Attributes:
        sbn: the Software Bus Network.
        ci: Command Ingest.
        edoras: the EDORAS application.
    """

    sbn: SbnApp
    ci: CiLab
    edoras: EdorasApp


def boot(cfs: Cfs, edoras: EdorasApp) -> Apps:
    """Start the core applications, the lab applications and the EDORAS application, now."""
    start_core(cfs)
    sbn = SbnApp(cfs)
    ci = CiLab(cfs)
    ToLab(cfs, edoras.telemetry)
    edoras.start(cfs)
    Generator(cfs)
    SchLab(cfs, edoras)
    return Apps(sbn, ci, edoras)
