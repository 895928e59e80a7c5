"""The options of ``record`` that keep the last seconds and write them where a trigger fires."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from edoras_tools.cli import options
from edoras_tools.cli.declare import headed
from edoras_tools.errors import ConfigError

if TYPE_CHECKING:
    from edoras_tools.pipelines.capture.snapshot import SnapshotPlan
    from edoras_tools.pipelines.capture.triggers import Triggers

_KINDS = ("finding", "rule", "where")
_LEAST_BYTES = 1_000_000


def trigger(text: str) -> tuple[str, str]:
    """Read ``finding``, ``finding:NAME``, ``rule``, ``rule:ID`` or ``where:EXPR``; return kind and rest."""
    from edoras_tools.words import did_you_mean

    kind, colon, rest = text.partition(":")
    if kind not in _KINDS or (colon and not rest) or (kind == "where" and not rest):
        hint = "" if kind in _KINDS else did_you_mean(kind, _KINDS, 1)
        forms = "write finding, finding:NAME, rule, rule:ID or 'where:EXPR'"
        raise typer.BadParameter(f"{text!r} is not a trigger; {hint or forms}")
    known: list[str] = []
    if kind == "where":
        options.where(rest)
    elif kind == "rule":
        from edoras_tools.diagnosis.rules import rules

        known = list(rules())
    else:
        from edoras_tools.model import Finding

        known = [item.label for item in Finding]
    if rest and known and rest not in known:
        hint = did_you_mean(rest, known, 1) or f"there are {', '.join(known)}"
        raise typer.BadParameter(f"no {kind} is named {rest!r}; {hint}")
    return kind, rest


@headed("Snapshots")
class SnapshotOptions(NamedTuple):
    """Whether only what is around a trigger is written."""

    snapshot: Annotated[bool, "Keep the last seconds in memory; write them when a trigger fires."] = False
    before: Annotated[options.Time, "Time before a trigger; default 30s."] = None
    after: Annotated[options.Time, "Time after it; default 10s."] = None
    before_size: Annotated[
        options.Size, "Most memory for what is kept; the oldest is dropped first; default 512M."
    ] = None
    trigger: Annotated[
        list[Any] | None,
        typer.Option(parser=trigger),
        "WHAT",
        "What fires, beside t, Enter and signal USR1: finding[:NAME], rule[:ID] of the doctor, or "
        "'where:EXPR'; repeatable.",
    ] = None
    socket: Annotated[Path | None, "PATH", "Also fire when asked on this Unix socket."] = None
    fire: Annotated[Path | None, "PATH", "Only ask the recorder at this socket for a snapshot."] = None

    def check(self, *, splits: bool) -> None:
        """Refuse options that have no effect with each other.

        Raises:
            ConfigError: there are such.
        """
        needs = [name for name, value in self._asdict().items() if value is not None and value is not False]
        needs = [f"--{name.replace('_', '-')}" for name in needs if name not in {"snapshot", "fire"}]
        if needs and not self.snapshot:
            raise ConfigError(f"{needs[0]} is an option of --snapshot: add --snapshot, or leave it out")
        if self.snapshot and splits:
            raise ConfigError("--snapshot writes a file for each trigger: leave the --split options out")
        if self.before_size is not None and self.before_size < _LEAST_BYTES:
            raise ConfigError("--before-size is less than 1M: a batch of datagrams would not fit")

    def plan(self) -> SnapshotPlan | None:
        """Return these options in the form that pipelines take; None without --snapshot."""
        if not self.snapshot:
            return None
        from edoras_tools.model import Finding
        from edoras_tools.pipelines.capture.snapshot import SnapshotPlan
        from edoras_tools.render.severity import NOTABLE

        given = self.trigger or []
        labels = {item.label: int(item) for item in Finding}
        usual = SnapshotPlan()
        findings = 0
        for kind, rest in given:
            if kind == "finding":
                findings |= labels[rest] if rest else int(NOTABLE)
        return SnapshotPlan(
            usual.before_ns if self.before is None else self.before,
            usual.after_ns if self.after is None else self.after,
            self.before_size or usual.before_bytes,
            findings,
            tuple(rest for kind, rest in given if kind == "where"),
            frozenset(rest for kind, rest in given if kind == "rule" and rest),
            ("rule", "") in given,
        )

    def triggers(self, stack: ExitStack) -> Triggers:
        """Open the triggers of this machine; a stack closes them.

        Raises:
            CaptureError: the socket cannot be made.
        """
        from edoras_tools.pipelines.capture.triggers import listening
        from edoras_tools.pipelines.interrupt import Keys

        is_terminal = sys.stdin is not None and sys.stdin.isatty()
        keys = stack.enter_context(Keys()) if is_terminal else None
        return stack.enter_context(listening(keys, self.socket))
