"""Output files: locked and watched; in a shared folder another user's symbolic link is not followed.

The rule is that of Linux's ``fs.protected_symlinks``, which is not enabled on every system: in a sticky
folder that others may write to, a link is followed only if it belongs to the user who follows it or to the
folder's owner.
"""

from __future__ import annotations

import errno
import os
import stat
from contextlib import suppress
from glob import escape
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Final

from edoras_tools.errors import CaptureError, ConfigError

if TYPE_CHECKING:
    from collections.abc import Iterable

_PIECES: Final = 1024
"""Most buffers in one write, Linux's IOV_MAX."""
_REFUSED: Final = "is another user's link in a shared folder; name another output"


def opener(path: str, flags: int) -> int:
    """Open a file for ``open(path, mode, opener=opener)``.

    Raises:
        OSError: it cannot be opened, or another user's link would be followed.
    """
    place = Path(path)
    check_links(place)
    # A path that is no link now must not be one when it is opened; nobody else can replace one's own link.
    if _is_for_all(place.parent) and not place.is_symlink():
        flags |= os.O_NOFOLLOW
    try:
        return os.open(path, flags, 0o666)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise OSError(errno.ELOOP, _REFUSED) from error
        raise


def check_links(path: Path) -> None:
    """Refuse a path that leads through another user's link.

    Raises:
        OSError: it does.
    """
    path = path.absolute()
    for place in (path, *path.parents):
        if place.is_symlink() and _is_for_all(place.parent):
            owner = place.lstat().st_uid
            if owner not in {os.geteuid(), place.parent.stat().st_uid}:
                raise OSError(errno.ELOOP, _REFUSED if place == path else f"{place} {_REFUSED}")


def write_bytes(path: Path, data: bytes, *, folders: bool = False) -> None:
    """Write a whole file, or none: one that could be written in part only is removed.

    Args:
        path: the file; an existing one is replaced.
        data: its contents.
        folders: create missing folders on its path.

    Raises:
        CaptureError: it cannot be written, or another user's link would be followed.
    """
    try:
        if folders:
            check_links(path)
            path.parent.mkdir(parents=True, exist_ok=True)
        with open(path, "wb", opener=opener) as file:
            try:
                file.write(data)
                file.flush()
            except OSError:
                if stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                    path.resolve().unlink(missing_ok=True)
                raise
    except OSError as error:
        raise CaptureError(f"{path}: cannot be written: {error.strerror or error}") from error


def in_the_way(path: Path, *, split: bool = False) -> Path | None:
    """Return the file that writing to a path would destroy; None if there is none, or it is empty.

    Args:
        path: the path.
        split: ``NAME_0.mcap``, ``NAME_1.mcap`` and so on will be written, so parts of another run count.
    """
    parts = [item for item in path.parent.glob(f"{escape(path.stem)}_*{escape(path.suffix)}") if split]
    for there in (path, *sorted(item for item in parts if item.stem[len(path.stem) + 1 :].isdigit())):
        if there.is_file() and there.stat().st_size:
            return there
    return None


def refuse_input(path: Path, inputs: Iterable[Path]) -> None:
    """Refuse to write over an input.

    Raises:
        ConfigError: the path is one of the inputs.
    """
    for item in inputs:
        if item.exists() and path.exists() and item.samefile(path):
            raise ConfigError(f"{path}: would overwrite its own input; name another output")


def refuse_existing(there: Path | None) -> None:
    """Refuse to replace what is there, if anything.

    Raises:
        ConfigError: something is.
    """
    if there is not None:
        raise ConfigError(f"{there} exists; name another output, or replace it with --force")


def check_new(path: Path, inputs: Iterable[Path] = (), *, force: bool) -> None:
    """Refuse to write a file over an input, or over what exists.

    Args:
        path: the file.
        inputs: what is read.
        force: what exists may be replaced, if it is no input.

    Raises:
        ConfigError: it would be written over.
    """
    refuse_input(path, inputs)
    if not force:
        refuse_existing(in_the_way(path))


def to_disk(path: Path) -> None:
    """Return once a file's contents, and its name in its folder, are on the disk and survive a power cut.

    Raises:
        OSError: the disk failed, or the file does not exist.
    """
    for place in (path, path.absolute().parent):
        fileno = os.open(place, os.O_RDONLY)
        try:
            os.fdatasync(fileno)
        finally:
            os.close(fileno)


def _is_for_all(folder: Path) -> bool:
    mode = folder.stat().st_mode if folder.exists() else 0
    return bool(mode & stat.S_ISVTX and mode & (stat.S_IWGRP | stat.S_IWOTH))


class OutputFile:
    """A file that is written from its beginning, by one program at a time.

    It is locked (``flock``) before it is truncated, so that a second writer is refused and nothing is lost.
    A pipe or device (``/dev/null``) is only written.

    Args:
        path: the file; an existing one is replaced.

    Attributes:
        path: as given.
        size: bytes written so far.

    Raises:
        OSError: from every method: it cannot be opened or written; ``BlockingIOError`` if another program is
            writing it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.size = 0
        self._truncated = False
        self._fileno = opener(str(path), os.O_WRONLY | os.O_CREAT | getattr(os, "O_CLOEXEC", 0))
        status = os.fstat(self._fileno)
        self._regular = stat.S_ISREG(status.st_mode)
        self._own = False
        self._inode = status.st_dev, status.st_ino
        if self._regular:
            try:
                _lock(self._fileno)
                # Even an empty file that was truncated is written to the disk by ext4 when it is closed.
                if status.st_size:
                    os.ftruncate(self._fileno, 0)
                self._own = True
            except OSError:
                self.close()
                raise

    def write(self, *pieces: bytes | memoryview) -> None:
        """Write bytes; they have left the process on return. A file that was truncated gets no more."""
        if self._is_cut():
            return
        rest = [memoryview(piece) for piece in pieces]
        done = 0
        while done < len(rest):
            count = os.writev(self._fileno, rest[done : done + _PIECES])
            self.size += count
            while done < len(rest) and count >= len(rest[done]):
                count -= len(rest[done])
                done += 1
            if count:
                rest[done] = rest[done][count:]

    def fate(self) -> str:
        """Return what another program did to the file, e.g. ``was deleted``; an empty text if nothing.

        Once it is closed, nobody knows where it was moved.
        """
        if not self._regular:
            return ""
        closed = self._fileno < 0
        if not closed and self._is_cut():
            return "was truncated"
        try:
            there = self.path.stat()
        except OSError:
            if closed:
                return "was deleted or moved"
            if now := self.place:
                return f"was moved to {now}"
            return "was moved to where this program cannot see it" if self.linked else "was deleted"
        if (there.st_dev, there.st_ino) != self._inode:
            return "was replaced by another file"
        return "was truncated" if there.st_size < self.size else ""

    @property
    def place(self) -> Path | None:
        """Where the file is now, if the system can say; None if it has no name any more."""
        try:
            now = Path(f"/proc/self/fd/{self._fileno}").readlink()
            status = now.stat()
        except OSError:
            return None
        return now if (status.st_dev, status.st_ino) == self._inode else None

    @property
    def linked(self) -> bool:
        """Whether the file has a name somewhere; a service may not see the folder (``ProtectHome=``)."""
        return self._fileno >= 0 and os.fstat(self._fileno).st_nlink > 0

    def _is_cut(self) -> bool:
        if self._regular and not self._truncated:
            self._truncated = os.fstat(self._fileno).st_size < self.size
        return self._truncated

    def fileno(self) -> int:
        """Return the file descriptor."""
        return self._fileno

    def close(self) -> None:
        """Close the file, and unlock it; closing twice does nothing. A file that is empty still is removed.

        A service that is started again and again while the disk is full would leave one each time.
        """
        fileno, self._fileno = self._fileno, -1
        if fileno < 0:
            return
        if self._own and not self.size:
            with suppress(OSError):
                there = self.path.lstat()
                if (there.st_dev, there.st_ino) == self._inode and not there.st_size:
                    self.path.unlink()
        os.close(fileno)


def path_beside(path: Path) -> Path:
    """Return an unused path next to another one: ``NAME_1.mcap`` and so on."""
    for number in count(1):
        stem = f"{path.stem}_{number}"
        if not any(path.with_name(name).exists() for name in (stem + path.suffix, f"{stem}_0{path.suffix}")):
            return path.with_name(stem + path.suffix)
    raise AssertionError("counting does not end")


def _lock(fileno: int) -> None:
    """Lock a file, if its file system supports that.

    Raises:
        BlockingIOError: another program has locked it.
    """
    try:
        import fcntl
    except ImportError:  # Windows
        return
    try:
        fcntl.flock(fileno, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise BlockingIOError(
            errno.EWOULDBLOCK, "another program is writing it; name another output"
        ) from error
    except OSError as error:
        if error.errno not in {errno.ENOLCK, errno.EOPNOTSUPP, errno.EINVAL, errno.ENOSYS}:
            raise
