"""An index as a Parquet dataset: a folder for each table, partitioned by date, link and topic."""

from __future__ import annotations

import errno
import os
import shutil
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.addons.archive.tables import TABLES
from edoras_tools.errors import ConfigError, os_errors
from edoras_tools.io.outputs import check_folder, check_links, lock_older, name_that_fits

if TYPE_CHECKING:
    from pathlib import Path

    from edoras_tools.addons.archive.index import Index

_LONGEST: Final = 80
"""Longest topic in a folder's name, bytes: each takes up to three of 255; a longer one ends in its hash."""
_DATE: Final = "coalesce(strftime(c.began, '%Y-%m-%d'), 'unknown')"


def export_dataset(index: Index, folder: Path, *, force: bool) -> dict[str, int]:
    """Write every table of an index; afterwards a folder is complete, or absent.

    It is written in another folder beside it. Remains of a killed export there are removed, and an export
    that was about to be replaced then gets its name again.

    Args:
        folder: target; new, or empty.
        force: whether to replace an earlier export.

    Returns:
        Rows by table.

    Raises:
        ConfigError: the folder is not empty.
        CaptureError: the folder cannot be written.
    """
    check_folder(folder)
    beside = folder.with_name(name_that_fits(f".{folder.name}", ".part"))
    new, old = beside / "new", beside / "old"
    with os_errors(f"{folder}: cannot be written"):
        check_links(folder)
        folder.parent.mkdir(parents=True, exist_ok=True)
        check_links(beside)
        beside.mkdir(mode=0o700, exist_ok=True)
        if beside.stat().st_uid != os.geteuid():
            raise OSError(errno.EPERM, f"{beside} is another user's; name another output")
        lock = lock_older(beside)
    try:
        with os_errors(f"{folder}: cannot be written"):
            _put_back(old, folder)
            shutil.rmtree(new, ignore_errors=True)  # both are remains of a killed export
            shutil.rmtree(old, ignore_errors=True)
            _check_earlier(folder, force=force)
            new.mkdir()
            written = {name: _write(index, name, new / name) for name in TABLES}
            if folder.exists():
                folder.rename(old)
            new.rename(folder)
    finally:
        _put_back(old, folder)
        shutil.rmtree(beside, ignore_errors=True)
        if lock >= 0:
            os.close(lock)
    return written


def _put_back(old: Path, folder: Path) -> None:
    """Give an earlier export its name again, unless a new one has it."""
    if old.exists() and not folder.exists():
        old.rename(folder)


def _check_earlier(folder: Path, *, force: bool) -> None:
    if not folder.exists():
        return
    existing = {item.name for item in folder.iterdir()} if folder.is_dir() else {""}
    if existing and not force:
        raise ConfigError(f"{folder} exists; name another folder, or replace it with --force")
    if foreign := sorted(existing - {*TABLES}):
        subject = f"{foreign[0]} in it is" if foreign[0] else "it is"
        raise ConfigError(f"{folder}: {subject} of no earlier export; name another folder")


def _write(index: Index, name: str, folder: Path) -> int:
    """Write a table; a message without a topic is in the folder of its packet's name, else of its MsgId."""
    columns = TABLES[name].names
    keys: dict[str, Any] = {"date": _DATE}
    if "link" in columns:
        keys["link"] = "coalesce(t.link, 'none')"
    if "topic" in columns:
        names = [f"t.{item}" for item in ("topic", "name", "msg_id") if item in columns]
        topic = f"coalesce({', '.join(names)}, 'none')"
        keys["topic"] = f"if(strlen({topic}) > {_LONGEST}, {topic}[:16] || '~' || md5({topic}), {topic})"
    data_columns = ", ".join(f't."{item}"' for item in columns if item not in keys)
    key_columns = ", ".join(f"{value} AS {key}" for key, value in keys.items())
    more = ', t.topic AS "configured_topic"' if "topic" in keys else ""
    source = f"SELECT {data_columns}{more}, {key_columns} FROM {name} t JOIN captures c USING (capture)"
    if name == "captures":
        source = f"SELECT {data_columns.replace('t.', 'c.')}, {_DATE} AS date FROM captures c"
    ((count,),) = index.ask(f"SELECT count(*) FROM {name}")
    if count:
        index.run(
            f"COPY ({source} ORDER BY {', '.join(keys)}, capture) TO '{_quoted(folder)}' "
            f"(FORMAT parquet, COMPRESSION zstd, PARTITION_BY ({', '.join(keys)}))"
        )
    return int(count)


def _quoted(path: Path) -> str:
    return str(path).replace("'", "''")
