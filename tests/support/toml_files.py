"""The reader of TOML: Python's own, from 3.11 on."""

import importlib
import sys

TOML = importlib.import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")
