"""From bytes to meaning: ``stack`` reads one datagram through every layer, ``columns`` a whole batch.

Both are driven by the tables in ``edoras_tools.wire`` and by one
:class:`~edoras_tools.decode.context.Context`; a test checks that they agree on every packet.
"""

from edoras_tools.decode.columns import ColumnDecoder
from edoras_tools.decode.context import Context, Options
from edoras_tools.decode.stack import Dissector

__all__ = ["ColumnDecoder", "Context", "Dissector", "Options"]
