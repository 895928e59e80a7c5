"""An index of many recordings: made in parallel, brought up to date, asked, reported on, exported."""

from __future__ import annotations

from importlib.util import find_spec

from edoras_tools.errors import ConfigError


def check_installed() -> None:
    """Check that the libraries of the extra are there, without importing them.

    Raises:
        ConfigError: one is not.
    """
    missing = [name for name in ("duckdb", "distributed", "fsspec", "pyarrow") if find_spec(name) is None]
    if missing:
        raise ConfigError(
            f"edoras archive needs {', '.join(missing)}, not installed here: "
            "pip install 'edoras-tools[archive]'"
        )
