"""Takes the files of CFDP transactions out of an input.

The rules that this file keeps:

1. Bytes go to the disk as they come, into a folder of their own inside the output; a file gets its name at
   the end. A file of which bytes are missing gets the suffix ``.incomplete``; zeros are in their place.
2. A name is taken from the capture only if it stays below the output and can be printed. A file with another
   name, or none, is called by its transaction. Nothing is overwritten.
"""

from __future__ import annotations

import os
import shutil
from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from edoras_tools.addons.cfdp.transactions import FileEvidence, Transaction
from edoras_tools.errors import CaptureError
from edoras_tools.io.outputs import check_folder, check_links, lock_older
from edoras_tools.pipelines.reading import Limits, reading

if TYPE_CHECKING:
    from typing_extensions import Self

    from edoras_tools.io import Source
    from edoras_tools.pipelines.selection import Selection
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.render.terminal.text import Progress

_LONGEST: Final = 255
"""Bytes of a part of a path, on all usual file systems."""


def safe_path(name: str | None) -> Path | None:
    """Return the relative path that a file name of a capture stands for; None for one that is refused.

    A slash in front stands for the folder of the receiver, as with EDORAS, and is left out.
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
    """A transaction, and what was written of its file.

    Attributes:
        transaction: what was followed.
        checksum_right: whether the checksum is that of EOF; None where it cannot be told.
        path: the file; None if none was written.
        refused: whether its name was not safe.
    """

    transaction: Transaction
    checksum_right: bool | None
    path: Path | None = None
    refused: bool = False

    @property
    def good(self) -> bool:
        """Whether the file came whole, and its transaction ended well."""
        return self.transaction.state == "finished" and self.checksum_right is not False

    def summary(self) -> dict[str, Any]:
        """Return it in the form of ``files --json``."""
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
        files: one for each transaction, in order of their first PDU.
        left_out: PDUs of transactions beyond the limit.
        corrupt: PDUs with a wrong CRC, which are not taken.
        failure: why the input ended early, if it did.
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
        folder: where files go, new or empty; None to write none.
        selection: which datagrams.
        limits: when to end.
        progress: shows how far the input is read.

    Raises:
        ConfigError: something is in the folder, or the selection has an error.
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


class _Spool:
    """Writes the files below a folder.

    Args:
        folder: created if it is not there.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._files: dict[Transaction, Path] = {}
        self._names: Counter[tuple[Path, bool]] = Counter()  # how many more files have one
        self._open = folder / ".edoras.part"
        check_folder(folder)
        try:
            check_links(self._open)
            folder.mkdir(parents=True, exist_ok=True)
            if any(item != self._open for item in folder.iterdir()):
                raise CaptureError(f"{folder}: is not empty; name a new folder")
            self._open.mkdir(mode=0o700, exist_ok=True)
            self._lock = lock_older(self._open)
            for leftover in self._open.iterdir():  # by a program that was killed
                leftover.unlink()
        except OSError as error:
            raise self._failed(error) from error

    def __enter__(self) -> Self:
        return self

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
            except (FileExistsError, NotADirectoryError):  # a file is where a folder is needed
                file.path = self._free(own, item.complete)
            place.rename(file.path)
        except OSError as error:
            raise self._failed(error) from error

    def _free(self, name: Path, complete: bool) -> Path:
        """Return a path where nothing is, and make its folder."""
        path = self._folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        suffix = "" if complete else ".incomplete"
        candidate = path.with_name(path.name + suffix)
        while candidate.exists():
            self._names[path, complete] += 1
            candidate = path.with_name(f"{path.name}.{self._names[path, complete] + 1}{suffix}")
        return candidate
