"""One datagram that is being read: its bytes, the layers and the findings so far."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from edoras_tools.errors import TruncatedError
from edoras_tools.model import Datagram, Finding, Layer, LayerField, RosMessage

if TYPE_CHECKING:
    from edoras_tools.wire.layout import Layout


class Reading:
    """What was read of a datagram so far; an error later on does not remove it.

    Attributes:
        data: its payload.
        layers: outermost first.
        findings: those of the capture among them.
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
            at: its first byte, from the start of the payload.
            extra: fields to show in front of its own.

        Raises:
            TruncatedError: it is not whole; ``TRUNCATED`` is noted.
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
        """Add a field to the last layer, which ends not before the field does."""
        layer = self.layers[-1]
        end = max(layer.end, field.end)
        self.layers[-1] = Layer(layer.name, layer.title, layer.start, end, (*layer.fields, field))

    def described(self, kind: int, at: int, end: int) -> bool:
        """Read what a packet holds by a dictionary of the link; tell whether there is one that does.

        Args:
            kind: what it is, by a number of the link.
            at: the first byte behind that number.
            end: one past the packet.
        """
        return False

    def add(self, message: RosMessage, *layers: Layer) -> None:
        """Take a message that was read, and the layers of its values."""
        del message, layers

    def sample(self, topic: str, type_name: str, at: int, end: int) -> None:
        """Read a sample of DDS, if the reader knows its type.

        Args:
            topic: ROS name of its topic.
            type_name: ROS name of its type.
            at: first byte of its encapsulation.
            end: one past the sample.
        """
        del topic, type_name, at, end

    def truncated(self, layer: str, at: int, need: int) -> None:
        """Note that a layer is cut, and stop.

        Raises:
            TruncatedError: always.
        """
        self.findings |= Finding.TRUNCATED
        raise TruncatedError(layer, at, need, max(0, len(self.data) - at))
