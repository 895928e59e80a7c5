"""The emulated cFS on loopback sockets, in a thread of its own."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Self

from edoras_tools.errors import EdorasError
from edoras_tools.sim import serve

if TYPE_CHECKING:
    from edoras_tools.sim import Simulation
    from edoras_tools.sim.server import Watch


class Served:
    """A simulation on its sockets for as long as a block lasts.

    Args:
        simulation: what to serve.
        watch: looks on.
    """

    def __init__(self, simulation: Simulation, watch: Watch | None = None) -> None:
        self._simulation, self._watch = simulation, watch
        self._stop, self._ready = threading.Event(), threading.Event()
        self._failure: EdorasError | None = None
        self._thread = threading.Thread(target=self._run, name="emulated cFS", daemon=True)

    def _run(self) -> None:
        try:
            serve(self._simulation, stop=self._stop, ready=self._ready.set, watch=self._watch)
        except EdorasError as error:
            self._failure = error
        finally:
            self._ready.set()

    def __enter__(self) -> Self:
        self._thread.start()
        self._ready.wait()
        if self._failure:
            raise self._failure
        return self

    def __exit__(self, *_error: object) -> None:
        self._stop.set()
        self._thread.join()
