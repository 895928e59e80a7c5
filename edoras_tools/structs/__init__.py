"""cFS's own C structs: where their members lie, and their bytes as named values."""

from edoras_tools.structs.bindings import Bound, Structs, shipped
from edoras_tools.structs.files import dumps, load, loads, read
from edoras_tools.structs.shapes import Key, Layout

__all__ = ["Bound", "Key", "Layout", "Structs", "dumps", "load", "loads", "read", "shipped"]
