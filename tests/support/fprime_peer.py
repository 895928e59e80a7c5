"""F Prime's ground data system, run by the Python that has it: it encodes, frames and decodes for the tests.

    python fprime_peer.py DICTIONARY

From its standard input it reads one JSON object: ``send``, a list of packets, and ``receive``, frames as hex
that flight software sends, by framing. It prints for each packet its bytes, both frames around them, and what
its own decoder reads from them; for the frames the packets that it finds in them. It needs no library but
fprime-gds.
"""

import json
import sys

from fprime_gds.common.communication.ccsds.chain import SpacePacketSpaceDataLinkFramerDeframer
from fprime_gds.common.communication.framing import FpFramerDeframer
from fprime_gds.common.data_types.ch_data import ChData
from fprime_gds.common.data_types.cmd_data import CmdData
from fprime_gds.common.data_types.event_data import EventData
from fprime_gds.common.data_types.pkt_data import PktData
from fprime_gds.common.decoders.ch_decoder import ChDecoder
from fprime_gds.common.decoders.event_decoder import EventDecoder
from fprime_gds.common.decoders.pkt_decoder import PktDecoder
from fprime_gds.common.encoders.ch_encoder import ChEncoder
from fprime_gds.common.encoders.cmd_encoder import CmdEncoder
from fprime_gds.common.encoders.event_encoder import EventEncoder
from fprime_gds.common.encoders.pkt_encoder import PktEncoder
from fprime_gds.common.models.dictionaries import Dictionaries
from fprime_gds.common.models.serialize.time_type import TimeType

LENGTH_BYTES = 4
COMMAND_BYTES = 8
TYPE_BYTES = 2


def value(kind, raw):
    """Return a value of one of its types."""
    made = kind()
    made.val = raw
    return made


def channel(known, name, raw, when):
    template = known.channel_name[name]
    return ChData(value(template.get_type_obj(), raw), when, template)


def encoded(known, item):
    """Return the packet of an item, and what is in it as the ground system reads it."""
    when = TimeType(*item.get("time", (2, 0, 0, 0)))
    if "command" in item:
        words = [json.dumps(raw) if isinstance(raw, (list, dict)) else raw for raw in item["args"]]
        command = CmdData(tuple(words), known.command_name[item["command"]])
        return CmdEncoder().encode_api(command)[COMMAND_BYTES:], []
    if "event" in item:
        template = known.event_name[item["event"]]
        arguments = [
            value(kind, raw) for (_, _, kind), raw in zip(template.get_args(), item["args"], strict=True)
        ]
        data = EventEncoder().encode_api(EventData(tuple(arguments), when, template))[LENGTH_BYTES:]
        (read,) = EventDecoder(known.event_id).decode_api(data[TYPE_BYTES:])
        return data, [
            [read.get_template().get_full_name(), [arg.val for arg in read.get_args()], read.display_text]
        ]
    if "packet" in item:
        template = next(one for one in known.packet.values() if one.get_name() == item["packet"])
        names = [one.get_full_name() for one in template.get_ch_list()]
        values = [channel(known, *pair, when) for pair in zip(names, item["values"], strict=True)]
        # Its encoder writes texts at their own length; flight software, and its decoder, at the longest.
        head = PktEncoder().encode_api(PktData([], when, template))[LENGTH_BYTES:]
        parts = [one.get_val_obj() for one in values]
        data = head + b"".join(one.serialize().ljust(one.getMaxSize(), b"\0") for one in parts)
        read = PktDecoder(known.packet, known.channel_id).decode_api(data[TYPE_BYTES:])
        return data, [[one.get_template().get_full_name(), one.get_val()] for one in read]
    packets = [
        ChEncoder().encode_api(channel(known, *pair, when))[LENGTH_BYTES:] for pair in item["channels"]
    ]
    data = packets[0][:TYPE_BYTES] + b"".join(one[TYPE_BYTES:] for one in packets)
    read = ChDecoder(known.channel_id).decode_api(data[TYPE_BYTES:])
    return data, [[one.get_template().get_full_name(), one.get_val()] for one in read]


def main():
    known = Dictionaries.load_dictionaries_into_config(sys.argv[1])
    asked = json.load(sys.stdin)
    own, ccsds = (
        FpFramerDeframer(),
        SpacePacketSpaceDataLinkFramerDeframer(scid=None, vcid=1, frame_size=None),
    )
    answers = []
    for item in asked["send"]:
        data, read = encoded(known, item)
        frames = {"own": own.frame(data).hex(), "ccsds": ccsds.frame(data).hex()}
        answers.append({"packet": data.hex(), "read": read, "frames": frames})
    found = {}
    for name, framer in (("own", own), ("ccsds", ccsds)):
        stream = bytes.fromhex("".join(asked["receive"].get(name, [])))
        found[name] = [packet.hex() for packet in framer.deframe_all(stream, no_copy=True)[0]]
    json.dump({"send": answers, "receive": found}, sys.stdout)


if __name__ == "__main__":
    main()
