"""Run by the Python of OpenC3 COSMOS: reads a target's file, then questions, a JSON object a line.

``{"read": hex}`` is answered with ``{"packet", "items", "named"}`` of the packet that it is, or ``null``;
``{"build": command, "values": {...}}`` with ``{"hex"}``. The first line out has the parser's warnings.
"""

import json
import sys

from openc3.packets.commands import Commands
from openc3.packets.packet_config import PacketConfig
from openc3.packets.telemetry import Telemetry


def plain(value):
    return value.hex() if isinstance(value, bytes | bytearray) else value


def main(path, target, out):
    config = PacketConfig()
    config.process_file(path, target)
    telemetry, commands = Telemetry(config, None), Commands(config, None)
    print(json.dumps({"warnings": config.warnings}), file=out)
    for line in sys.stdin:
        asked = json.loads(line)
        answer = None
        if "read" in asked:
            data = bytes.fromhex(asked["read"])
            if packet := telemetry.identify(data, [target]):
                packet = packet.clone()
                packet.buffer = data
                items = {name: plain(packet.read(name, "RAW")) for name in packet.items}
                named = {name: packet.read(name) for name, item in packet.items.items() if item.states}
                answer = {"packet": packet.packet_name, "items": items, "named": named}
        else:
            packet = commands.build_cmd(target, asked["build"], asked["values"])
            answer = {"hex": plain(packet.buffer)}
        print(json.dumps(answer), file=out)


if __name__ == "__main__":
    out, sys.stdout = sys.stdout, sys.stderr  # its logger prints there
    main(sys.argv[1], sys.argv[2], out)
