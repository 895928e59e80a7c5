"""One datagram while it is read: its bytes, and its layers and findings so far."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from edoras_tools.errors import TruncatedError
from edoras_tools.model import Datagram, Finding, Layer, LayerField, RosMessage

if TYPE_CHECKING:
    from edoras_tools.wire.layout import Layout


class Reading:
    """The results of reading a datagram so far; a later error does not remove them.

    Attributes:
        data: payload.
        layers: layers, outermost first.
        findings: findings, including those of the capture.
        detail: whether every value of a message gets its own bytes.
    """

    detail = True

    def __init__(self, datagram: Datagram) -> None:
        self.datagram = datagram
        self.data = datagram.payload
        self.findings = datagram.findings
        self.layers: list[Layer] = []

    def read(self, layout: Layout, at: int, *, extra: tuple[LayerField, ...] = ()) -> dict[str, Any]:
        """Read a header, add its layer and return its values.

        Args:
            at: first byte, from the start of the payload.
            extra: fields to put before its own.

        Raises:
            TruncatedError: it is incomplete; ``TRUNCATED`` is set.
        """
        if len(self.data) - at < layout.size:
            self.truncated(layout.name, at, layout.size)
        values = layout.parse(self.data, at)
        fields = tuple(
            LayerField(
                slot.field.name,
                values[slot.field.name],
                at + slot.start,
                at + slot.end,
                slot.field.text(values[slot.field.name]),
                slot.field.doc,
            )
            for slot in layout.slots
        )
        self.layers.append(Layer(layout.name, layout.title, at, at + layout.size, extra + fields))
        return values

    def extend(self, field: LayerField) -> None:
        """Add a field to the last layer, and extend the layer to the end of the field."""
        layer = self.layers[-1]
        end = max(layer.end, field.end)
        self.layers[-1] = Layer(layer.name, layer.title, layer.start, end, (*layer.fields, field))

    def described(self, kind: int, at: int, end: int) -> bool:
        """Read the content of a packet by a dictionary of the link; return whether there is one for it.

        Args:
            kind: kind of the content, as a number of the link.
            at: first byte after that number.
            end: end of the packet.
        """
        return False

    def add(self, message: RosMessage, *layers: Layer) -> None:
        """Add a message that was read, and the layers of its values."""
        del message, layers

    def sample(self, topic: str, type_name: str, at: int, end: int) -> None:
        """Read a sample of DDS, if the reader knows its type.

        Args:
            topic: ROS name of its topic.
            type_name: ROS name of its type.
            at: first byte of its encapsulation.
            end: end of the sample.
        """
        del topic, type_name, at, end

    def truncated(self, layer: str, at: int, need: int) -> None:
        """Set ``TRUNCATED`` for a layer that is cut, and stop.

        Raises:
            TruncatedError: always.
        """
        self.findings |= Finding.TRUNCATED
        raise TruncatedError(layer, at, need, max(0, len(self.data) - at))
