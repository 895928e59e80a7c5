"""What live views look at: a pipeline's report, as far as it is shown."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from collections.abc import Mapping

    from edoras_tools.model import SourceStatistics


class Measured(Protocol):
    """Something that counts what it reads."""

    @property
    def statistics(self) -> SourceStatistics:
        """The counts, as they are now."""


class Report(Protocol):
    """A run that is under way."""

    @property
    def source(self) -> Measured:
        """Where the datagrams come from."""

    def summary(self) -> Mapping[str, Any]:
        """Return what there is so far, in the shape of ``info --json``."""
