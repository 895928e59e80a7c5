"""From bytes to meaning: ``stack`` reads one datagram through every layer, ``columns`` a whole batch.

Both are driven by the tables in ``edoras_tools.wire`` and by one
:class:`~edoras_tools.decode.context.Context`; a test checks that they agree on every packet.
"""

from typing import TYPE_CHECKING

from edoras_tools.doors import later

if TYPE_CHECKING:
    from edoras_tools.decode.columns import ColumnDecoder
    from edoras_tools.decode.context import Context, Options
    from edoras_tools.decode.stack import Dissector

__all__ = ["ColumnDecoder", "Context", "Dissector", "Options"]

__getattr__ = later(__name__, columns="ColumnDecoder", context="Context Options", stack="Dissector")
