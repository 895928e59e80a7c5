"""F Prime's ground data system as a receiver: its own server, deframer and decoders take what comes.

    python fprime_ground.py DICTIONARY PORT own|ccsds

It prints a line once it listens, takes what one connection sends until nothing came for a second after
something did, and prints a JSON object: events and channels as its decoders read them, in order.
"""

import json
import sys
import time

from fprime_gds.common.communication.adapters.ip import IpAdapter
from fprime_gds.common.communication.ccsds.chain import SpacePacketSpaceDataLinkFramerDeframer
from fprime_gds.common.communication.framing import FpFramerDeframer
from fprime_gds.common.decoders.ch_decoder import ChDecoder
from fprime_gds.common.decoders.event_decoder import EventDecoder
from fprime_gds.common.decoders.pkt_decoder import PktDecoder
from fprime_gds.common.models.dictionaries import Dictionaries

CHANNEL, EVENT, PACKET = 1, 2, 4
QUIET_S = 1.0
TYPE_BYTES = 2


def main():
    known = Dictionaries.load_dictionaries_into_config(sys.argv[1])
    framer = (
        FpFramerDeframer()
        if sys.argv[3] == "own"
        else SpacePacketSpaceDataLinkFramerDeframer(scid=None, vcid=1, frame_size=None)
    )
    server = IpAdapter("127.0.0.1", int(sys.argv[2]))
    server.open()
    print("listening", flush=True)
    data, heard, until = b"", None, time.monotonic() + 60
    while time.monotonic() < (heard + QUIET_S if heard else until):
        more = server.read(0.1)
        data, heard = data + more, time.monotonic() if more else heard
    events, channels = [], []
    for packet in framer.deframe_all(data, no_copy=True)[0]:
        kind, body = int.from_bytes(packet[:TYPE_BYTES], "big"), packet[TYPE_BYTES:]
        if kind == EVENT:
            (read,) = EventDecoder(known.event_id).decode_api(body)
            events.append([read.get_template().get_full_name(), [arg.val for arg in read.get_args()]])
        elif kind in {CHANNEL, PACKET}:
            decoder = (
                ChDecoder(known.channel_id) if kind == CHANNEL else PktDecoder(known.packet, known.channel_id)
            )
            channels += [
                [one.get_template().get_full_name(), one.get_val()] for one in decoder.decode_api(body)
            ]
    print(json.dumps({"events": events, "channels": channels}), flush=True)
    server.close()


if __name__ == "__main__":
    main()
