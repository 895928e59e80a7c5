"""pcapng files."""

from typing import Final

LISTENED: Final = "edoras record --listen "
"""Beginning of a section comment with the ports on which our recorder was set to listen."""
