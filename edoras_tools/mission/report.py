"""Mistakes and warnings, collected while files are read and reported together."""

from __future__ import annotations

from operator import itemgetter

import msgspec

from edoras_tools.errors import ConfigError


def printable(text: str, limit: int = 60) -> str:
    """Return text that fits in one line: control characters escaped, cut at ``limit`` characters."""
    text = "".join(item if item.isprintable() else item.encode("unicode_escape").decode() for item in text)
    return text if len(text) <= limit else text[: limit - 3] + "..."


class Mistakes(msgspec.Struct, eq=False):
    """The mistakes and warnings of one file.

    Attributes:
        file: name of the file, for messages.
        mistakes: line number and ``FILE:LINE: KEY: what is wrong; what is allowed``, in the order found.
        warnings: in the same form, parameters that work but are probably mistakes.
    """

    file: str
    mistakes: list[tuple[int, str]] = msgspec.field(default_factory=list)
    warnings: list[tuple[int, str]] = msgspec.field(default_factory=list)

    def mistake(self, line: int, key: str, message: str) -> None:
        """Add a mistake. ``line`` counts from 1; 0 is the whole file."""
        self.mistakes.append((line, self._text(line, key, message)))

    def warn(self, line: int, key: str, message: str) -> None:
        """Add a warning: something that works but is probably a mistake."""
        self.warnings.append((line, self._text(line, key, message)))

    def raise_all(self) -> None:
        """Raise the mistakes, in the order of their lines.

        Raises:
            ConfigError: if there is one.
        """
        if self.mistakes:
            raise ConfigError(*(text for _, text in sorted(self.mistakes, key=itemgetter(0))))

    def _text(self, line: int, key: str, message: str) -> str:
        place = printable(self.file, 200) + (f":{line}" if line else "")
        return f"{place}: {printable(key)}: {message}" if key else f"{place}: {message}"
