"""cFS's own C structs: where their members lie, and their bytes as named values."""

from edoras_tools.structs.table import Structs, shipped_structs

__all__ = ["Structs", "shipped_structs"]
