"""An index of many recordings: made in parallel, brought up to date, asked, reported on, exported."""

from __future__ import annotations

from importlib.util import find_spec

from edoras_tools.errors import ConfigError

# What imports a part of it without the libraries of the extra is told so in one line.
_MISSING = [name for name in ("duckdb", "distributed", "fsspec", "pyarrow") if find_spec(name) is None]
if _MISSING:
    raise ConfigError(
        f"edoras archive needs {', '.join(_MISSING)}, not installed here: pip install 'edoras-tools[archive]'"
    )
