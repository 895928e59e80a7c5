"""A plain Zenoh router in a process of its own, which knows nothing of this package: what it sees is so.

It tells on standard output, a JSON object a line, each sample and each token that comes or goes; it obeys
orders on standard input, likewise.
"""

import json
import sys
import threading

import zenoh
from zenoh import ext

OUTPUT = threading.Lock()


def tell(**what):
    with OUTPUT:
        print(json.dumps(what), flush=True)


def sample(seen):
    attachment = None if seen.attachment is None else seen.attachment.to_bytes().hex()
    tell(
        key=str(seen.key_expr),
        cdr=seen.payload.to_bytes().hex(),
        attachment=attachment,
        blocks=seen.congestion_control == zenoh.CongestionControl.BLOCK,
    )


def token(seen):
    tell(token=str(seen.key_expr), alive=seen.kind == zenoh.SampleKind.PUT)


def main():
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", json.dumps([f"tcp/127.0.0.1:{sys.argv[1]}"]))
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("scouting/delay", "0")
    config.insert_json5("timestamping/enabled", "true")
    kept = []
    with zenoh.open(config) as session:
        kept.append(session.declare_subscriber("**", sample))
        kept.append(session.liveliness().declare_subscriber("@ros2_lv/**", token, history=True))
        tell(ready=True)
        for line in sys.stdin:
            order = json.loads(line)
            key, cdr = order["key"], bytes.fromhex(order.get("cdr", ""))
            if order["do"] == "put":
                session.put(key, cdr, attachment=bytes.fromhex(order["attachment"]) or None)
            elif order["do"] == "keep":
                cache = ext.declare_advanced_publisher(
                    session, key, cache=ext.CacheConfig(3), publisher_detection=True
                )
                for number in range(5):
                    cache.put(b"%d" % number, attachment=bytes(33))
                kept.append(cache)
            elif order["do"] == "late":
                history = ext.HistoryConfig(detect_late_publishers=True, max_samples=10)
                late = ext.declare_advanced_subscriber(
                    session, key, lambda seen: tell(late=seen.payload.to_bytes().hex()), history=history
                )
                kept.append(late)
            tell(done=order["do"])


main()
