"""Extracts the files of CFDP transactions from an input.

Rules:

1. Bytes are written as they come, into a separate folder inside the output; a file gets its name at the end.
   An incomplete file gets the suffix ``.incomplete``, with zeros for the missing bytes.
2. A name from the capture is used only if it stays below the output and is printable. A file with another
   name, or without one, is named after its transaction. No file is overwritten.
"""

from __future__ import annotations

import os
import shutil
from collections import Counter
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from edoras_tools.addons.cfdp.transactions import FileEvidence, Transaction
from edoras_tools.errors import CaptureError
from edoras_tools.io.outputs import check_folder, check_links, lock_older
from edoras_tools.pipelines.reading import Limits, reading

if TYPE_CHECKING:
    from edoras_tools.io import Source
    from edoras_tools.pipelines.selection import Selection
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.render.terminal.text import Progress

_LONGEST: Final = 255
"""Maximum length of a part of a path on all usual file systems, bytes."""


def safe_path(name: str | None) -> Path | None:
    """Return the relative path of a file name in a capture; None for one that is refused.

    A slash in front stands for the receiver's folder, as in EDORAS, and is removed.
    """
    parts = (name or "").lstrip("/").split("/")
    safe = all(
        part not in {"", ".", ".."}
        and part.isprintable()
        and "\\" not in part
        and len(os.fsencode(part)) <= _LONGEST - len(".incomplete") - 4
        for part in parts
    )
    return Path(*parts) if safe else None


class TakenFile(msgspec.Struct):
    """A transaction, and its extracted file.

    Attributes:
        transaction: transaction.
        checksum_right: whether the checksum is that of EOF; None if unknown.
        path: path of the file; None if none was written.
        refused: whether its name was not safe.
    """

    transaction: Transaction
    checksum_right: bool | None
    path: Path | None = None
    refused: bool = False

    @property
    def good(self) -> bool:
        """Whether the file is complete, and its transaction ended without error."""
        return self.transaction.state == "finished" and self.checksum_right is not False

    def summary(self) -> dict[str, Any]:
        """Return the file in the form of ``files --json``."""
        item = self.transaction
        names = ("source_entity_id", "transaction_sequence_number", "destination_entity_id", "acknowledged")
        counts = ("segments", "resent", "filled", "naks")
        more = ("source_file_name", "destination_file_name", "file_size", "first_ns", "last_ns", "silence_ns")
        return {
            **{name: getattr(item, name) for name in (*names, *more, *counts)},
            "received": item.received.size,
            "holes": len(item.holes),
            "state": item.state,
            "checksum_type": item.checksum_type,
            "checksum_right": self.checksum_right,
            "path": str(self.path) if self.path else None,
            "refused": self.refused,
        }


class FilesReport(msgspec.Struct):
    """The result of ``edoras files``.

    Attributes:
        source: the input.
        files: files, one for each transaction, in order of their first PDU.
        left_out: number of PDUs of transactions beyond the limit.
        corrupt: number of PDUs with a wrong CRC, which are ignored.
        failure: error that ended the input early, if any.
    """

    source: Source
    files: list[TakenFile] = msgspec.field(default_factory=list)
    left_out: int = 0
    corrupt: int = 0
    failure: CaptureError | None = None

    def summary(self) -> dict[str, Any]:
        """Return the report in the form of ``files --json``."""
        return {
            "source": self.source.info.name,
            "transactions": [item.summary() for item in self.files],
            "left_out": self.left_out,
            "corrupt": self.corrupt,
        }


def take_out(
    source: Source,
    bench: Workbench,
    folder: Path | None = None,
    *,
    selection: Selection | None = None,
    limits: Limits = Limits(),  # noqa: B008  frozen
    progress: Progress | None = None,
) -> FilesReport:
    """Follow the CFDP transactions of an input, and write their files; the input is closed.

    Args:
        source: the input.
        bench: mission, types and decoders.
        folder: folder for the files, new or empty; None to write none.
        selection: selection of datagrams.
        limits: conditions of the end.
        progress: shows the progress of reading.

    Raises:
        ConfigError: the folder is not empty, or the selection has an error.
        CaptureError: the folder cannot be written.
    """
    report = FilesReport(source)
    with ExitStack() as opened:
        loop = opened.enter_context(reading(source, bench, selection, limits, keeps_failure=True))
        spool = opened.enter_context(_Spool(folder)) if folder else None
        follower = FileEvidence(spool.keep if spool else None, bench.mission.pdu_msg_ids)
        for rows in loop:
            follower.add(*rows.alone())
            if progress is not None:
                progress.read(source)
        report.left_out, report.corrupt = follower.left_out, follower.corrupt
        report.failure = loop.failure
        for item in follower.transactions:
            file = TakenFile(item, item.checksum_right)
            if spool:
                spool.finish(file)
            report.files.append(file)
    return report


class _Spool(AbstractContextManager["_Spool"]):
    """Writes the files below a folder.

    Args:
        folder: folder; created if it does not exist.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._files: dict[Transaction, Path] = {}
        self._names: Counter[tuple[Path, bool]] = Counter()  # number of further files with a name
        self._open = folder / ".edoras.part"
        check_folder(folder)
        try:
            check_links(self._open)
            folder.mkdir(parents=True, exist_ok=True)
            if any(item != self._open for item in folder.iterdir()):
                raise CaptureError(f"{folder}: is not empty; name a new folder")
            self._open.mkdir(mode=0o700, exist_ok=True)
            self._lock = lock_older(self._open)
            for leftover in self._open.iterdir():  # from a program that was killed
                leftover.unlink()
        except OSError as error:
            raise self._failed(error) from error

    def __exit__(self, *error: object) -> None:
        shutil.rmtree(self._open, ignore_errors=True)
        if self._lock >= 0:
            os.close(self._lock)

    def _failed(self, error: OSError) -> CaptureError:
        return CaptureError(f"{self._folder}: cannot be written: {error.strerror or error}")

    def _place(self, item: Transaction) -> Path:
        if item not in self._files:
            self._files[item] = self._open / str(len(self._files))
            self._files[item].touch()
        return self._files[item]

    def keep(self, item: Transaction, offset: int, piece: bytes) -> None:
        """Write bytes of a file.

        Raises:
            CaptureError: they cannot be written.
        """
        try:
            with self._place(item).open("r+b", buffering=0) as file:
                file.seek(offset)
                while piece:
                    piece = piece[file.write(piece) :]
        except OSError as error:
            raise self._failed(error) from error

    def finish(self, file: TakenFile) -> None:
        """Give a file its name.

        Raises:
            CaptureError: it cannot be renamed.
        """
        item = file.transaction
        if item not in self._files and not item.complete:
            return
        place = self._place(item)
        name = item.destination_file_name or item.source_file_name
        path = safe_path(name)
        file.refused = path is None and name is not None
        own = Path(item.name.replace(":", "_"))
        try:
            try:
                file.path = self._free(path or own, item.complete)
            except (FileExistsError, NotADirectoryError):  # a file is in the place of a folder
                file.path = self._free(own, item.complete)
            place.rename(file.path)
        except OSError as error:
            raise self._failed(error) from error

    def _free(self, name: Path, complete: bool) -> Path:
        """Return an unused path, and create its folder."""
        path = self._folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        suffix = "" if complete else ".incomplete"
        candidate = path.with_name(path.name + suffix)
        while candidate.exists():
            self._names[path, complete] += 1
            candidate = path.with_name(f"{path.name}.{self._names[path, complete] + 1}{suffix}")
        return candidate
