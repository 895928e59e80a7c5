"""Access to captures in folders and files by fsspec, local or at a URL, and to the version of a file."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any, Final

import msgspec
from fsspec.core import url_to_fs
from fsspec.implementations.local import LocalFileSystem

from edoras_tools.errors import CaptureError
from edoras_tools.io.formats.table import FILE_SUFFIXES

_PACKED: Final = ("", ".gz", ".zst")
_SUFFIXES: Final = tuple(suffix + packed for suffix in FILE_SUFFIXES for packed in _PACKED)
_ASKED_AT_ONCE: Final = 8
_HINTS: Final = {"s3": "pip install s3fs", "gs": "pip install gcsfs", "abfs": "pip install adlfs"}
_NOT_FOUND: Final = 404
_NO_KEYS: Final = "set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or name a profile with AWS_PROFILE"
_VERSIONS: Final = ("ETag", "etag", "Last-Modified", "LastModified", "updated", "mtime")
"""Names of a file's version in server answers, the best first."""


class ListedFile(msgspec.Struct, frozen=True):
    """A capture as its folder lists it.

    Attributes:
        url: address; for a local file its absolute path.
        size: size, bytes; -1 if unknown.
        version: changes when the file does.
    """

    url: str
    size: int
    version: str


def find_captures(roots: Iterable[str]) -> list[ListedFile]:
    """Return every capture in and below some folders, and every named file, by URL.

    Raises:
        CaptureError: a folder or file does not exist, or cannot be listed.
    """
    files: dict[str, ListedFile] = {}
    for root in roots:
        try:
            files |= {item.url: item for item in _under(root)}
        except ImportError as error:
            scheme = root.partition(":")[0]
            hint = _HINTS.get(scheme, f"install what fsspec needs for {scheme}:")
            raise CaptureError(f"{root}: {error}; {hint}") from error
        except Exception as error:  # each file system has its own errors
            cause = cause_of(error)
            if isinstance(cause, FileNotFoundError):
                raise CaptureError(f"{root}: there is no such file or folder; check the name") from error
            hint = f"; {_NO_KEYS}" if type(cause).__name__ == "NoCredentialsError" else ""
            raise CaptureError(f"{root}: cannot be listed: {reason_of(cause)}{hint}") from error
    if no_text := [url for url in files if url.encode(errors="replace").decode() != url]:
        raise CaptureError(f"{no_text[0]}: its name is not UTF-8, which an index cannot hold; rename it")
    return sorted(files.values(), key=lambda item: item.url)


def _under(root: str) -> Iterator[ListedFile]:
    system, path = url_to_fs(root)
    if _is_file(system, path):
        yield _listed(system, path, system.info(path))
        return
    listing = system.find(path, detail=True)
    if not listing and not system.exists(path):
        raise FileNotFoundError(root)
    captures = {name: item for name, item in listing.items() if name.lower().endswith(_SUFFIXES)}
    if _is_local(system):
        # no pipes or devices
        captures = {name: item for name, item in captures.items() if Path(name).is_file()}
    # A folder of a web server is a page: size and date of a file are known only after a request for it.
    unknown = [name for name, item in captures.items() if item.get("size") is None]
    with ThreadPoolExecutor(_ASKED_AT_ONCE) as pool:
        captures |= dict(zip(unknown, pool.map(system.info, unknown), strict=True))
    for name, item in captures.items():
        yield _listed(system, name, item)


def _is_file(system: Any, path: str) -> bool:
    """Return whether a path is a file. A web server's folder is one too, but its address ends with ``/``."""
    if _is_local(system):
        return Path(path).is_file()
    item = system.info(path)
    page = str(item.get("mimetype", "")).startswith("text/html")
    return item["type"] == "file" and not page and not path.endswith("/")


def _listed(system: Any, path: str, item: Mapping[str, Any]) -> ListedFile:
    if _is_local(system):
        status = Path(path).stat()  # of the target of a link
        return ListedFile(path, status.st_size, str(status.st_mtime_ns))
    size, versions = item.get("size"), (item.get(name) for name in _VERSIONS)
    version = next((str(value).strip('"') for value in versions if value is not None), "")
    return ListedFile(system.unstrip_protocol(path), -1 if size is None else size, version)


def _is_local(system: Any) -> bool:
    return isinstance(system, LocalFileSystem)


def listed_now(url: str) -> ListedFile:
    """Return the file at a URL as it is now.

    Raises:
        OSError: there is none, or the request failed.
    """
    system, path = url_to_fs(url)
    system.invalidate_cache()
    return _listed(system, path, system.info(path))


@contextmanager
def at_hand(url: str) -> Iterator[Path]:
    """Yield a local file with the contents of a URL: itself if it is local, else a copy, removed at the end.

    Raises:
        OSError: it cannot be fetched.
    """
    system, path = url_to_fs(url)
    if _is_local(system):
        yield Path(path)
        return
    with NamedTemporaryFile(prefix="edoras-", suffix="".join(Path(path).suffixes[-2:])) as copy:
        system.get_file(path, copy.name)
        yield Path(copy.name)


def is_remote(url: str) -> bool:
    """Return whether a capture must be fetched, by its URL."""
    return "://" in url


def root_of(text: str) -> str:
    """Return a user's argument as a URL, or as an absolute path without a slash at its end."""
    system, path = url_to_fs(text)
    return str(path) if _is_local(system) else str(system.unstrip_protocol(path))


def cause_of(error: BaseException) -> BaseException:
    """Return the cause of an error: fsspec reports any failure of a web server as a missing file."""
    cause = error.__cause__
    if not isinstance(error, FileNotFoundError) or cause is None or getattr(cause, "status", 0) == _NOT_FOUND:
        return error
    from_web = isinstance(cause, OSError) or type(cause).__module__.startswith("aiohttp.")
    return cause_of(cause) if from_web else error


def reason_of(error: BaseException) -> str:
    """Return the cause of an error, in one line."""
    if isinstance(error, FileNotFoundError):
        return "it is no longer there"
    return (getattr(error, "strerror", None) or str(error) or type(error).__name__).splitlines()[0]
