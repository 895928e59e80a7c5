"""edoras-tools: capture, decode, record and replay ROS 2 traffic of EDORAS bridges through NASA's cFS.

One pipeline: datagrams come from a *source* in batches, are *dissected* into columns, and go to *sinks*.
``docs/architecture.md`` draws it; each folder's docstring says what belongs in it.
"""

TYPE_CHECKING = False  # no module is loaded here: Ctrl-C is a traceback until ``programs`` heeds it
if TYPE_CHECKING:
    from edoras_tools.pipelines.export.reading import read

__all__ = ["__version__", "read"]

__version__ = "0.2.0"


def __getattr__(name: str) -> object:
    """Return ``read``, imported only when it is used: most programs of this package do not."""
    if name == "read":
        from importlib import import_module

        return import_module("edoras_tools.pipelines.export.reading").read
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
