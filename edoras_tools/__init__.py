"""edoras-tools: capture, decode, record and replay ROS 2 traffic of EDORAS bridges through NASA's cFS.

One pipeline: datagrams come from a *source* in batches, are *dissected* into columns, and go to *sinks*.
``docs/architecture.md`` draws it; each folder's docstring says what belongs in it.
"""

from __future__ import annotations

__all__ = ["__version__"]

__version__ = "0.1.0"
