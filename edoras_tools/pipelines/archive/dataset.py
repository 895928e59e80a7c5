"""An index as a Parquet dataset: a folder for each table, partitioned by date, link and topic."""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.errors import CaptureError, ConfigError
from edoras_tools.pipelines.archive.tables import TABLES

if TYPE_CHECKING:
    from pathlib import Path

    from edoras_tools.pipelines.archive.index import Index

_DATE: Final = "coalesce(strftime(c.began, '%Y-%m-%d'), 'unknown')"
_MADE: Final = "{}.partly"


def export_dataset(index: Index, folder: Path, *, force: bool) -> dict[str, int]:
    """Write every table of an index; a folder is complete, or not there.

    Args:
        index: open.
        folder: where; new, or empty.
        force: replace what is there.

    Returns:
        Rows by table.

    Raises:
        ConfigError: something is there.
        CaptureError: it cannot be written.
    """
    if folder.exists() and not (folder.is_dir() and (force or not any(folder.iterdir()))):
        raise ConfigError(f"{folder} exists; name another folder, or replace it with --force")
    partly = folder.with_name(_MADE.format(folder.name))
    try:
        shutil.rmtree(partly, ignore_errors=True)
        partly.mkdir(parents=True)
        written = {name: _write(index, name, partly / name) for name in TABLES}
        if folder.exists():
            shutil.rmtree(folder)
        partly.rename(folder)
    except OSError as error:
        raise CaptureError(f"{folder}: cannot be written: {error.strerror or error}") from error
    finally:
        shutil.rmtree(partly, ignore_errors=True)
    return written


def _write(index: Index, name: str, folder: Path) -> int:
    """Write a table; a message without a topic is in the folder of its packet's name, else of its MsgId."""
    columns = TABLES[name].names
    keys: dict[str, Any] = {"date": _DATE}
    if "link" in columns:
        keys["link"] = "coalesce(t.link, 'none')"
    if "topic" in columns:
        names = [f"t.{item}" for item in ("topic", "name", "msg_id") if item in columns]
        keys["topic"] = f"coalesce({', '.join(names)}, 'none')"
    kept = ", ".join(f't."{item}"' for item in columns if item not in keys)
    made = ", ".join(f"{value} AS {key}" for key, value in keys.items())
    more = ', t.topic AS "configured_topic"' if "topic" in keys else ""
    source = f"SELECT {kept}{more}, {made} FROM {name} t JOIN captures c USING (capture)"
    if name == "captures":
        source = f"SELECT {kept.replace('t.', 'c.')}, {_DATE} AS date FROM captures c"
    ((count,),) = index.ask(f"SELECT count(*) FROM {name}")
    if count:
        index.run(
            f"COPY ({source} ORDER BY {', '.join(keys)}, capture) TO '{_quoted(folder)}' "
            f"(FORMAT parquet, COMPRESSION zstd, PARTITION_BY ({', '.join(keys)}))"
        )
    return int(count)


def _quoted(path: Path) -> str:
    return str(path).replace("'", "''")
