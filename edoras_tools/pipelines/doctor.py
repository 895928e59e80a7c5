"""A source into a diagnosis, once at its end or again and again while it is live."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any, Protocol

from edoras_tools.diagnosis.case import Capture
from edoras_tools.diagnosis.examination import Diagnosis, Examination
from edoras_tools.errors import ConfigError, EdorasError
from edoras_tools.pipelines.interrupt import on_interrupt
from edoras_tools.sessions.profile import SimProfile

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.sources import Source


class Onlooker(Protocol):
    """What looks on while a live diagnosis goes on."""

    def update(self, diagnosis: Diagnosis) -> None:
        """Show the diagnosis as it is now."""


@dataclass(slots=True)
class Findings:
    """What became of an examination.

    Attributes:
        diagnosis: all that was read.
        source: the source, for its statistics.
        failure: why the source ended early, if it did; all before it is judged.
        interrupted: ended by Ctrl-C.
    """

    diagnosis: Diagnosis
    source: Source
    failure: EdorasError | None = None
    interrupted: bool = False

    def summary(self) -> dict[str, Any]:
        """Return the findings in the shape of ``doctor --json``."""
        statistics = self.source.statistics
        return {
            "source": self.source.info.name,
            **self.diagnosis.as_json(),
            "warnings": list(statistics.warnings),
        }


def examine(
    source: Source,
    bench: Workbench,
    *,
    profile: SimProfile | None = None,
    clock: Callable[[], int] | None = None,
    every_ns: int = 0,
    duration_ns: int = 0,
    onlooker: Onlooker | None = None,
    progress: Callable[[Source], None] | None = None,
) -> Findings:
    """Read a source to its end and judge it.

    Args:
        source: where datagrams come from; it is closed.
        bench: mission, types and decoders.
        profile: the constants of the cFS on the link.
        clock: monotonic time in ns; needed for ``every_ns`` and ``duration_ns``.
        every_ns: also judge so often on the way; less often where judging takes long.
        duration_ns: stop after so long; 0 never.
        onlooker: shown every diagnosis on the way.
        progress: called with the source after every batch.
    """
    examination = Examination(bench.columns.context, profile)
    failure, stop = None, getattr(source, "stop", None)
    began = judged = clock() if clock else 0
    pause = every_ns
    interrupted = False
    try:
        with on_interrupt(stop or (lambda: None)) as asked:
            for batch in source.batches():
                if len(batch):
                    examination.add(batch, bench.columns.decode(batch))
                if progress is not None:
                    progress(source)
                now = clock() if clock else 0
                if onlooker is not None and clock and every_ns and now - judged >= pause:
                    onlooker.update(examination.diagnose(_capture(source)))
                    judged = clock()
                    # Judging takes a fifth of the time at most, however much there is to judge.
                    pause = max(every_ns, 5 * (judged - now))
                if (duration_ns and now - began >= duration_ns) or (asked.is_set() and stop is None):
                    break
            interrupted = asked.is_set()
    except EdorasError as error:
        failure = error
    finally:
        source.close()
    return Findings(examination.diagnose(_capture(source)), source, failure, interrupted)


def profile_with(constants: Sequence[str]) -> SimProfile:
    """Return the constants of cFS with some of them replaced.

    Args:
        constants: ``NAME=VALUE`` each, whole numbers.

    Raises:
        ConfigError: there is no such constant, or it cannot have that value.
    """
    profile = SimProfile()
    known = {item.name for item in fields(profile) if type(getattr(profile, item.name)) is int}
    changes: dict[str, Any] = {}
    for text in constants:
        name, _, value = text.partition("=")
        if name not in known:
            near = get_close_matches(name, sorted(known), 1)
            hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(sorted(known))}"
            raise ConfigError(f"constant {name!r} is not known; {hint}")
        try:
            changes[name] = int(value, 0)
        except ValueError:
            raise ConfigError(f"constant {text!r}: {value!r} is no whole number; write {name}=8") from None
    return replace(profile, **changes)


def _capture(source: Source) -> Capture:
    return Capture(source.statistics.kernel_drops, tuple(source.statistics.warnings))
