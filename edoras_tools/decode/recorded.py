"""Messages of a recording without datagrams, as rows of a batch: no link, no MsgId, one topic each.

A message is a row whose route is its topic (``PacketBatch.recorded``). It has only a time, bytes and
values.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.decode.summary import leaves_of, short_values
from edoras_tools.errors import EdorasError, WireError
from edoras_tools.model import NO_FINDINGS, OTHER, Columns, Decoded, Finding, Layer, LayerField, RosMessage
from edoras_tools.wire.arrays import by_value
from edoras_tools.wire.envelope import ENCAPSULATION

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.decode.context import Context
    from edoras_tools.mission import RecordedTopic
    from edoras_tools.model import Datagram, PacketBatch

JSON_ENCODING: Final = "json"
RECORDED_LAYER: Final = "recorded"
"""Name of the layer with the recording's fields of a message."""


def recorded_columns(batch: PacketBatch, columns: dict[str, NDArray[Any]], context: Context) -> Columns:
    """Return the columns of messages.

    Args:
        columns: columns that hold their values for "none".
    """
    assert batch.recorded is not None, "they are messages"
    columns["route"] = batch.recorded["topic"].astype(np.int16)
    columns["sequence_count"] = batch.recorded["sequence"].astype(np.uint16)
    columns["cdr_offset"], columns["cdr_length"] = batch.offset.copy(), batch.length.copy()
    for place, rows in by_value(columns["route"]):
        topic = context.mission.recorded[place]
        if topic.unread or context.types is None:
            columns["cdr_offset"][rows], columns["cdr_length"][rows] = -1, 0
            continue
        valid = context.types.valid(topic.type, batch.data, batch.offset[rows], batch.length[rows])
        columns["findings"][rows[~valid]] |= np.uint32(Finding.CDR_INVALID)
    return Columns(**columns)


def dissect_recorded(datagram: Datagram, context: Context, *, detail: bool) -> Decoded:
    """Return the complete decoding of one message; see ``Dissector``."""
    topic, route = context.mission.recorded[datagram.topic], context.mission.routes[datagram.topic]
    data, findings = datagram.payload, NO_FINDINGS
    about = {"topic": route.topic, "type": topic.type, "encoding": topic.encoding}
    fields = tuple(LayerField(name, text, 0, 0) for name, text in about.items())
    layers: tuple[Layer, ...] = (Layer(RECORDED_LAYER, "Recorded message", 0, len(data), fields),)
    message: RosMessage | None = None
    stop: EdorasError | None = None
    if topic.encoding == JSON_ENCODING:
        message, stop = _json(topic, route.topic, data)
        if detail and message:
            leaves = tuple(LayerField(path, value, 0, len(data)) for path, value in leaves_of(message.values))
            layers += (Layer("ros", topic.type or JSON_ENCODING, 0, len(data), leaves),)
    elif topic.unread or context.types is None:
        stop = WireError(topic.unread)
    else:
        try:
            message = RosMessage(topic.type, route.topic, context.types.decode(topic.type, data), data)
            if detail:
                layers += _values(topic.type, data, context)
        except WireError as error:
            findings, stop = Finding.CDR_INVALID, error
    summary = short_values(message.values) if message else str(stop)
    return Decoded(datagram, OTHER, layers, findings, message, stop, summary)


def recorded_topic(decoded: Decoded) -> tuple[str, str]:
    """Return topic and type of a message that ``dissect_recorded`` read, or could not read."""
    layer = decoded.layer(RECORDED_LAYER)
    assert layer is not None, "it is a message of a recording"
    values = layer.values()
    return values["topic"], values["type"]


def _json(topic: RecordedTopic, name: str, data: bytes) -> tuple[RosMessage | None, EdorasError | None]:
    try:
        values = json.loads(data)
    except (ValueError, RecursionError) as error:
        return None, WireError(f"is not JSON: {str(error).partition(chr(10))[0]}")
    values = values if isinstance(values, dict) else {"value": values}
    return RosMessage(topic.type, name, values, data), None


def _values(kind: str, data: bytes, context: Context) -> tuple[Layer, ...]:
    assert context.types is not None, "the type is known"
    spans = context.types.spans(kind, data)
    values = tuple(LayerField(path, value, low, high) for path, value, low, high in spans)
    return (Layer("ros", kind, ENCAPSULATION.size, len(data), values),)
