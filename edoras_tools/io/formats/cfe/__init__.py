"""Files that cFE wrote: event logs and stored packets as captures, and the contents of others."""

from typing import Final

CFE_MAGIC: Final = b"cFE1"
"""The first field of every such file."""
