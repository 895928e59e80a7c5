"""Which applications the emulated cFS starts, and in which order."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.addons.lab.emulator.apps import generator, lab
from edoras_tools.addons.lab.emulator.apps.core import start_core
from edoras_tools.addons.lab.emulator.apps.generator import Generator
from edoras_tools.addons.lab.emulator.apps.lab import CiLab, SchLab, ToLab
from edoras_tools.addons.lab.emulator.apps.sbn import SbnApp
from edoras_tools.cfs import command_ingest, edoras_app, sbn, telemetry_output

if TYPE_CHECKING:
    from edoras_tools.addons.lab.emulator.apps.edoras import EdorasApp
    from edoras_tools.addons.lab.emulator.cfs import Cfs


class Apps:
    """The applications of one emulated cFS whose state can be looked at: those that run now, or ran last.

    Attributes:
        sbn: the Software Bus Network.
        ci: Command Ingest.
        edoras: the EDORAS application.
    """

    def __init__(self, cfs: Cfs, edoras: EdorasApp) -> None:
        self.sbn: SbnApp
        self.ci: CiLab
        self.edoras = edoras
        self._cfs = cfs
        cfs.begin = self._start
        cfs.boot()

    def _start(self) -> None:
        cfs = self._cfs
        start_core(cfs)
        for name, file, begin in (
            (sbn.NAME, "sbn", self._sbn),
            (command_ingest.NAME, "ci_lab", self._ci),
            (telemetry_output.NAME, "to_lab", lambda: ToLab(cfs, self.edoras.telemetry)),
            (edoras_app.NAME, "edoras_app", lambda: self.edoras.start(cfs)),
            *[(generator.NAME, "edoras_gen", lambda: Generator(cfs))] * bool(cfs.profile.generator_msg_id),
            (lab.SCHEDULER, "sch_lab", lambda: SchLab(cfs, self.edoras)),
        ):
            cfs.executive.load(name, f"/cf/{file}.so", begin)

    def _sbn(self) -> None:
        self.sbn = SbnApp(self._cfs)

    def _ci(self) -> None:
        self.ci = CiLab(self._cfs)
