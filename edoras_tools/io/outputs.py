"""Output files: locked, watched, complete before they replace another file, safe from others' links.

The rule on links is that of Linux's ``fs.protected_symlinks``, which is not enabled on every system: in a
sticky folder that others may write to, a link is followed only if it belongs to the user who follows it or to
the folder's owner.
"""

from __future__ import annotations

import errno
import os
import signal
import stat
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from glob import escape
from itertools import count
from pathlib import Path
from typing import IO, ClassVar, Final, NamedTuple

from edoras_tools.errors import CaptureError, ConfigError, OnFailure, os_errors

ENDING: Final = (signal.SIGINT, signal.SIGTERM, *((signal.SIGHUP,) if hasattr(signal, "SIGHUP") else ()))
"""The signals that end a program which writes: Ctrl-C, ``kill``, and a closed terminal."""
STDOUT: Final = Path("-")
"""Path that stands for standard output."""
_PIECES: Final = 1024
"""Most buffers in one write: Linux's IOV_MAX."""
_WRITE: Final = os.O_WRONLY | os.O_CREAT | getattr(os, "O_CLOEXEC", 0)
_LONGEST: Final = 200
"""Most bytes of the original name in a temporary name; file systems allow 255 bytes."""
_FULL: Final = {errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC)}
_LOOK_S: Final = 0.2
"""Time between two tries of a recorder to write to a full disk."""
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
        OSError: it leads through such a link.
    """
    path = path.absolute()
    for place in (path, *path.parents):
        if place.is_symlink() and _is_for_all(place.parent):
            owner = place.lstat().st_uid
            if owner not in {os.geteuid(), place.parent.stat().st_uid}:
                raise OSError(errno.ELOOP, _REFUSED if place == path else f"{place} {_REFUSED}")


class NewFile:
    """A file that gets its name when it is complete; until then, an existing file of that name is unchanged.

    Until then it has no name, so that a killed program leaves nothing. If the file system does not support
    that, it is written beside its place as ``.NAME.PID.part``. A pipe or device is written directly.
    As a context manager it is completed at the end of the block, and removed after an exception.

    Attributes:
        file: file object to write to.
        place: path where it can be opened until it is complete.
        regular: whether it will get a name: False for a pipe or device.

    Raises:
        OSError: from every method: it cannot be written, another user's link would be followed, or another
            program is writing the existing file (``BlockingIOError``).
    """

    def __init__(self, path: Path) -> None:
        check_links(path)
        self._path = path.resolve() if path.is_symlink() else path
        existing = self._path.stat() if self._path.exists() else None
        name = os.fsdecode(os.fsencode(self._path.name)[:_LONGEST])
        part = self._path.with_name(f".{name}.{os.getpid()}.part")
        self._part = None if existing and not stat.S_ISREG(existing.st_mode) else part
        self._older = lock_older(self._path) if self._part else -1
        fileno = -1
        if self._part:
            self._part.unlink(missing_ok=True)  # left by a killed process that had the same number
            fileno = _nameless(self._path.parent)
        self._named = fileno < 0
        mode = "wb" if fileno >= 0 or not self._part else "xb"
        opened = fileno if fileno >= 0 else self._part or path
        self.file: IO[bytes] = open(opened, mode, opener=opener)  # noqa: SIM115  closed below
        self.regular = self._part is not None
        self.place = Path(f"/proc/self/fd/{fileno}") if fileno >= 0 else self._part or path
        if existing and self._part:
            _take_after(self.file.fileno(), existing)

    def __enter__(self) -> IO[bytes]:
        return self.file

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None:
            self.keep()
        else:
            self.remove()

    def keep(self) -> None:
        """Complete the file and give it its name; if that fails, remove it."""
        try:
            self.file.flush()
            if self._part and not self._named:
                own = self.file.fileno()
                os.link(f"/proc/self/fd/{own}", self._part, src_dir_fd=own)  # or Python links the link itself
            self.file.close()
            if self._part:
                self._part.replace(self._path)
        except BaseException:
            self.remove()
            raise
        self._close_older()

    def _close_older(self) -> None:
        older, self._older = self._older, -1
        if older >= 0:
            os.close(older)

    def remove(self) -> None:
        """Close the file and remove it, unless it is complete."""
        self._close_older()
        with suppress(OSError):
            self.file.close()
        if self._part:
            with suppress(OSError):
                self._part.unlink(missing_ok=True)


def write_bytes(path: Path, data: bytes, *, folders: bool = False) -> None:
    """Write a whole file; if that fails, an existing one stays unchanged.

    Args:
        path: the file; an existing one is replaced when the new one is complete.
        folders: create missing folders on its path.

    Raises:
        CaptureError: it cannot be written, or another user's link would be followed.
    """
    with os_errors(f"{path}: cannot be written"):
        if folders:
            check_links(path)
            with suppress(FileExistsError):  # a file in its place: the file below cannot be opened
                path.parent.mkdir(parents=True, exist_ok=True)
        with NewFile(path) as file:
            file.write(data)


def to_write(files: Mapping[Path, bytes], *, force: bool) -> list[Path]:
    """Return the files that have to be written: all except those that exist with the same contents.

    Args:
        force: whether existing files may be replaced.

    Raises:
        ConfigError: a file exists with other contents.
        CaptureError: an existing file cannot be read.
    """
    try:
        others = [path for path, data in files.items() if not (path.is_file() and path.read_bytes() == data)]
        existing = [path for path in others if path.exists()]
    except OSError as error:
        raise CaptureError(f"{error.filename}: cannot be read: {error.strerror or error}") from error
    if existing and not force:
        raise ConfigError(
            f"{existing[0]}: exists and differs, the first of {len(existing)}; overwrite with --force"
        )
    return others


def write_files(files: Mapping[Path, bytes], *, force: bool) -> None:
    """Write files, or none if one exists with other contents; see ``to_write``. Missing folders are made.

    Raises:
        ConfigError: a file exists with other contents.
        CaptureError: a file cannot be read or written.
    """
    for path in files:
        check_folder(Path(*path.parts[:1]))
    for path in to_write(files, force=force):
        write_bytes(path, files[path], folders=True)


def check_folder(folder: Path) -> None:
    """Refuse ``-`` as a folder: it stands for standard output.

    Raises:
        ConfigError: the folder is ``-``.
    """
    if folder == STDOUT:
        raise ConfigError("-: several files are not written to standard output; name a folder")


def in_the_way(path: Path, *, split: bool = False) -> Path | None:
    """Return the file that writing to a path would destroy; None if there is none, or it is empty.

    Args:
        split: the output will be ``NAME_0.mcap``, ``NAME_1.mcap`` and so on, so such files count.
    """
    parts = [item for item in path.parent.glob(f"{escape(path.stem)}_*{escape(path.suffix)}") if split]
    for file in (path, *sorted(item for item in parts if item.stem[len(path.stem) + 1 :].isdigit())):
        if file.is_file() and file.stat().st_size:
            return file
    return None


def refuse_input(path: Path, inputs: Iterable[Path]) -> None:
    """Refuse to write over an input.

    Raises:
        ConfigError: the path is one of the inputs.
    """
    for item in inputs:
        if item.exists() and path.exists() and item.samefile(path):
            raise ConfigError(f"{path}: would overwrite its own input; name another output")


def refuse_existing(existing: Path | None) -> None:
    """Refuse to replace an existing file; None: nothing exists.

    Raises:
        ConfigError: a file exists.
    """
    if existing is not None:
        raise ConfigError(f"{existing} exists; name another output, or replace it with --force")


def check_new(path: Path, inputs: Iterable[Path] = (), *, force: bool) -> None:
    """Refuse to write a file over an input, or over an existing file.

    Args:
        force: whether an existing file may be replaced, if it is no input.

    Raises:
        ConfigError: a file would be written over, or the path is ``-``, which is standard output.
    """
    if path == STDOUT:
        raise ConfigError("-: this is not written to standard output; name a file")
    refuse_input(path, inputs)
    if not force:
        refuse_existing(in_the_way(path))
    with os_errors(f"{path}: cannot be written"):
        if (older := lock_older(path)) >= 0:
            os.close(older)


def lock_older(path: Path) -> int:
    """Lock a file or folder that is to be replaced, until the returned descriptor is closed.

    Returns:
        The descriptor; -1 if there is no such file, or it cannot be opened.

    Raises:
        BlockingIOError: another program is writing it.
    """
    if not (path.is_file() or path.is_dir()):
        return -1
    try:
        fileno = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return -1
    with OnFailure(partial(os.close, fileno)):
        _lock(fileno)
    return fileno


def name_that_fits(name: str, suffix: str) -> str:
    """Return a file name that file systems accept: a name that is too long is cut and ends in a hash."""
    data = os.fsencode(name)
    if len(data) + len(os.fsencode(suffix)) > _LONGEST:
        from hashlib import sha256

        name = data[: _LONGEST - 32].decode(errors="ignore") + "~" + sha256(data).hexdigest()[:16]
    return name + suffix


def to_disk(path: Path) -> None:
    """Return when a file's contents, and its name in its folder, are on the disk and survive a power cut.

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


class Patience(NamedTuple):
    """Behaviour of a recorder while the disk is full.

    Attributes:
        tell: called with a line of text when it begins to wait, and when it continues.
        over: returns whether to stop waiting.
    """

    tell: Callable[[str], None]
    over: Callable[[], bool]


@contextmanager
def waiting_for_room(patience: Patience) -> Iterator[None]:
    """Let all recordings of this process wait while the disk is full, except those without any bytes yet."""
    before, OutputFile.patience = OutputFile.patience, patience
    try:
        yield
    finally:
        OutputFile.patience = before


class OutputFile:
    """A file that is written from its beginning, by one program at a time.

    It is locked (``flock``), so that a second writer is refused and nothing is lost. If a file with contents
    exists at the path, that one is locked too and stays unchanged until ``finish``; the new file has a free
    name beside it until then (``path_beside``). A pipe or device (``/dev/null``) and ``STDOUT`` are only
    written.

    Args:
        path: the file; an existing one is replaced by ``finish``.

    Attributes:
        path: where the file is written; after ``finish`` the path of the caller.
        older: the file that will be replaced; None if there is none.
        spares: whether ``finish`` keeps the older file, and this one beside it.
        size: bytes written so far.
        waits: begin and end of each time that the disk was full, ns since 1970.

    Raises:
        OSError: from every method: it cannot be opened or written; ``BlockingIOError`` if another program is
            writing it.
    """

    patience: ClassVar[Patience | None] = None

    def __init__(self, path: Path) -> None:
        self.path = path
        self.waits: list[tuple[int, int]] = []
        self._full_ns = 0
        self.older: Path | None = None
        self.spares = False
        self.size = 0
        self._held = -1
        self._truncated = False
        self._fileno = os.dup(1) if path == STDOUT else opener(str(path), _WRITE)
        status = os.fstat(self._fileno)
        self._regular = path != STDOUT and stat.S_ISREG(status.st_mode)
        self._own = False
        with OnFailure(self.close):
            if self._regular:
                _lock(self._fileno)
                if status.st_size:
                    self.older, self._held = path, self._fileno
                    self.path = path_beside(path.resolve() if path.is_symlink() else path)
                    self._fileno = -1
                    self._fileno = opener(str(self.path), _WRITE | os.O_EXCL)
                    _take_after(self._fileno, status)
                    _lock(self._fileno)
                self._own = True
        status = os.fstat(self._fileno)
        self._inode = status.st_dev, status.st_ino

    def write(self, *pieces: bytes | memoryview) -> None:
        """Write bytes; on return the operating system has them. A truncated file gets no more."""
        if self._is_cut():
            return
        rest = [memoryview(piece) for piece in pieces]
        complete = 0
        while complete < len(rest):
            try:
                count = os.writev(self._fileno, rest[complete : complete + _PIECES])
            except OSError as error:
                if not (self.size and error.errno in _FULL and self._wait_for_room()):
                    raise
                continue
            if self._full_ns:
                self._go_on()
            self.size += count
            while complete < len(rest) and count >= len(rest[complete]):
                count -= len(rest[complete])
                complete += 1
            if count:
                rest[complete] = rest[complete][count:]

    def _wait_for_room(self) -> bool:
        """Wait shortly for room on the disk; return whether to try again."""
        patience = self.patience
        if patience is None or patience.over():
            return False
        if not self._full_ns:
            self._full_ns = time.time_ns()
            patience.tell(f"{self.path}: the disk is full; the recording waits for room")
        time.sleep(_LOOK_S)
        return True

    def _go_on(self) -> None:
        self.waits.append((self._full_ns, time.time_ns()))
        seconds, self._full_ns = (self.waits[-1][1] - self._full_ns) / 1e9, 0
        if self.patience:
            self.patience.tell(
                f"{self.path}: the disk has room again after {seconds:.1f} s; recording goes on"
            )

    def fate(self) -> str:
        """Return what another program did to the file, e.g. ``was deleted``; empty if nothing.

        A closed file that was moved cannot be found.
        """
        if not self._regular:
            return ""
        closed = self._fileno < 0
        if not closed and self._is_cut():
            return "was truncated"
        try:
            status = self.path.stat()
        except OSError:
            if closed:
                return "was deleted or moved"
            if now := self.place:
                return f"was moved to {now}"
            return "was moved to where this program cannot see it" if self.linked else "was deleted"
        if (status.st_dev, status.st_ino) != self._inode:
            return "was replaced by another file"
        return "was truncated" if status.st_size < self.size else ""

    @property
    def place(self) -> Path | None:
        """The present path of the file, if the system knows it; None if it has no name any more."""
        try:
            now = Path(f"/proc/self/fd/{self._fileno}").readlink()
            status = now.stat()
        except OSError:
            return None
        return now if (status.st_dev, status.st_ino) == self._inode else None

    @property
    def linked(self) -> bool:
        """Whether the file still has a name; a service may not see its folder (``ProtectHome=``)."""
        return self._fileno >= 0 and os.fstat(self._fileno).st_nlink > 0

    def _is_cut(self) -> bool:
        if self._regular and not self._truncated:
            self._truncated = os.fstat(self._fileno).st_size < self.size
        return self._truncated

    def fileno(self) -> int:
        """Return the file descriptor."""
        return self._fileno

    def finish(self) -> None:
        """Close the complete file; it replaces the older one, unless that is spared."""
        older, self.older = self.older, self.older if self.spares else None
        if older and not self.spares and not self.fate():
            self.path.replace(older.resolve() if older.is_symlink() else older)
            self.path = older
        self.close()

    def remove(self) -> None:
        """Close and delete the file, unless another file has its name now."""
        if self._own and not self.fate():
            with suppress(OSError):
                self.path.unlink()
        self.close()

    def close(self) -> None:
        """Close and unlock the file; closing twice does nothing. An empty file is deleted.

        Otherwise, a service that restarts again and again on a full disk would leave one file each time.
        """
        fileno, self._fileno = self._fileno, -1
        lock, self._held = self._held, -1
        if lock >= 0:
            os.close(lock)
        if fileno < 0:
            return
        if self._own and not self.size:
            with suppress(OSError):
                status = self.path.lstat()
                if (status.st_dev, status.st_ino) == self._inode and not status.st_size:
                    self.path.unlink()
        os.close(fileno)


def _nameless(folder: Path) -> int:
    """Return the descriptor of a new file without a name in a folder, or -1 if that is not supported."""
    try:
        fileno = os.open(folder, os.O_TMPFILE | os.O_WRONLY | os.O_CLOEXEC, 0o666)
    except (AttributeError, OSError):
        return -1
    if not Path(f"/proc/self/fd/{fileno}").exists():
        os.close(fileno)
        return -1
    return fileno


def output_name(path: Path) -> str:
    """Return the name of an output in messages."""
    return "standard output" if path == STDOUT else str(path)


def path_beside(path: Path) -> Path:
    """Return an unused path next to another one: ``NAME_1.mcap`` and so on."""
    for number in count(1):
        stem = f"{path.stem}_{number}"
        if not any(path.with_name(name).exists() for name in (stem + path.suffix, f"{stem}_0{path.suffix}")):
            return path.with_name(stem + path.suffix)
    raise AssertionError("counting does not end")


def part_path(path: Path, number: int) -> Path:
    """Return the file of a part: ``NAME_0.mcap`` and so on."""
    return path.with_name(f"{path.stem}_{number}{path.suffix}")


def _take_after(fileno: int, older: os.stat_result) -> None:
    """Give a new file the permissions of the file that it replaces, and its owner if that is allowed."""
    with suppress(OSError):
        os.fchmod(fileno, stat.S_IMODE(older.st_mode))
        os.fchown(fileno, older.st_uid, older.st_gid)


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
