"""Search of the highest good number: doubling until one fails, then bisection."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from edoras_tools.errors import ConfigError

_GROWTH: Final = 2


@dataclass(slots=True)
class Bisection:
    """A search for the highest whole number that is good.

    >>> search = Bisection(1, 100)
    >>> while (value := search.next) is not None:
    ...     search.tell(value, good=value < 9)
    >>> search.good, search.bad
    (8, 9)

    Attributes:
        first: where it begins.
        last: where it ends, if nothing fails.
        precision: largest distance between good and bad at the end, as a share of the good one; at least 1.
        good: the highest that was good so far; None where none was.
        bad: the lowest that was bad so far; None where none was.
    """

    first: int
    last: int
    precision: float = 0.0
    good: int | None = field(default=None, init=False)
    bad: int | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        """Check once.

        Raises:
            ConfigError: it does not begin at 1 or more, or ends before it begins.
        """
        if not 1 <= self.first <= self.last:
            raise ConfigError(f"{self.first}..{self.last} is not a rising range from 1 or more")

    @property
    def next(self) -> int | None:
        """The next value to try; None when the result is precise enough."""
        if self.good is None:
            return self.first if self.bad is None else None
        if self.bad is None:
            return min(self.good * _GROWTH, self.last) if self.good < self.last else None
        apart = self.bad - self.good
        return self.good + apart // 2 if apart > max(1, int(self.good * self.precision)) else None

    def tell(self, value: int, *, good: bool) -> None:
        """Note whether ``value`` was good."""
        if good:
            self.good = value
        else:
            self.bad = value
