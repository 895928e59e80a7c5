"""``record --after-split``: runs a command for each complete file of a recording, beside the recorder.

Rules that this file keeps:

1. One thread takes the files and runs one command after the other; the recorder never waits for it while it
   records.
2. If a command fails, or does not end within 10 minutes, a warning says so, and it runs again after 1, 2, 4
   and 8 s.
3. At the end of the recording, each remaining file is tried without further pauses; failures are reported,
   and the recording is complete all the same.
"""

from __future__ import annotations

import queue
import shlex
import subprocess
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from edoras_tools.errors import CaptureError, ConfigError
from edoras_tools.words import listed, plural

if TYPE_CHECKING:
    from pathlib import Path

PAUSES_S: Final = (1.0, 2.0, 4.0, 8.0)
_LONGEST_S: Final = 600.0


class AfterSplit:
    """Runs a command for each complete file.

    Args:
        command: words in the syntax of a shell, run without a shell; ``{}`` is the file.
        on_warning: called with a line for each failure, on the thread that runs the commands.
        longest_s: longest time in s that a command may take.

    Raises:
        ConfigError: the command cannot be read, or has no ``{}``.
    """

    def __init__(
        self, command: str, on_warning: Callable[[str], None], longest_s: float = _LONGEST_S
    ) -> None:
        try:
            self._words = shlex.split(command)
        except ValueError as error:
            raise ConfigError(f"--after-split {command!r}: {error}") from error
        if not any("{}" in word for word in self._words):
            raise ConfigError(
                f"--after-split {command!r}: write {{}} where the file is to stand: 'gzip {{}}'"
            )
        self._on_warning, self._longest_s = on_warning, longest_s
        self._files: queue.SimpleQueue[Path | None] = queue.SimpleQueue()
        self._ending = threading.Event()
        self._failed: list[str] = []
        self._thread = threading.Thread(target=self._run, name="after split", daemon=True)
        self._thread.start()

    def add(self, path: Path) -> None:
        """Hand over a complete file."""
        self._files.put(path)

    def end(self) -> None:
        """Wait until every file was tried.

        Raises:
            CaptureError: commands failed; the error lists their files.
        """
        self._files.put(None)
        self._ending.set()
        self._thread.join()
        if self._failed:
            count = plural(len(self._failed), "file")
            raise CaptureError(
                f"--after-split failed for {count}, which are there: {listed(self._failed, 4)}"
            )

    def _run(self) -> None:
        while (path := self._files.get()) is not None:
            for pause_s in (*PAUSES_S, None):
                why = self._failure(path)
                if not why:
                    break
                again = "" if pause_s is None or self._ending.is_set() else f"; again in {pause_s:g} s"
                self._on_warning(f"--after-split of {path}: {why}{again}")
                if not again:
                    self._failed.append(str(path))
                    break
                self._ending.wait(pause_s)

    def _failure(self, path: Path) -> str:
        """Run the command; return why it failed, empty if it did not."""
        if not path.exists():
            return ""  # it was moved, or --keep deleted it: nothing is left to do
        words = [word.replace("{}", str(path)) for word in self._words]
        try:
            process = subprocess.run(  # noqa: S603  the user's own words
                words,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                timeout=self._longest_s,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return f"{words[0]} did not end within {self._longest_s:g} s"
        except OSError as error:
            return f"{words[0]} cannot be run: {error.strerror or error}"
        if not process.returncode:
            return ""
        last = process.stderr.decode(errors="replace").strip().rpartition("\n")[2]
        return f"{words[0]} ended with exit code {process.returncode}" + (f": {last}" if last else "")
