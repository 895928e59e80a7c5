"""pcapng files."""

from typing import Final

LISTENED: Final = "edoras record --listen "
"""A comment of a section that begins so names the ports that a recorder was told to receive on."""
