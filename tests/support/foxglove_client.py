"""A client of the Foxglove WebSocket protocol, by hand over ``websockets``: it knows nothing of the package.

Text frames are JSON with an ``op``; binary frames start with an operation.
Server: 1 message (u32 subscription, u64 ns, data), 2 time (u64 ns), 5 playback state (u8 status, u64 ns,
f32 speed, u8 seeked, u32 length, request id). Client: 1 message (u32 channel, data), 3 playback control
(u8 command: 0 play, 1 pause; f32 speed, u8 seeks, u64 ns, u32 length, request id). All little-endian.
"""

from __future__ import annotations

import json
import struct
import time
from typing import NamedTuple

from waiting import PATIENCE_S, until
from websockets.sync.client import connect

wait = until


class Message(NamedTuple):
    topic: str
    time_ns: int
    data: bytes


class State(NamedTuple):
    status: str
    time_ns: int
    speed: float
    seeked: bool
    request: str


class Client:
    """Connected, and told of all topics that there are at first."""

    def __init__(self, url, topics=1, **options):
        usual = {
            "subprotocols": ["foxglove.sdk.v1"],
            "max_size": None,
            "max_queue": None,
            "open_timeout": PATIENCE_S,
            "close_timeout": 1,
        }
        self.socket = connect(url, **usual | options)
        self.messages, self.times, self.states, self.statuses = [], [], [], []
        self.info, self.channels, self._subscribed = None, {}, {}
        self._topics = topics

    def __enter__(self):
        self.socket = self.socket.__enter__()
        self.until(lambda: self.info is not None and len(self.channels) >= self._topics)
        return self

    def __exit__(self, *error):
        self.socket.__exit__(*error)

    def take(self, timeout=PATIENCE_S):
        """Take one frame; tell whether there was one in time."""
        try:
            frame = self.socket.recv(timeout=timeout)
        except TimeoutError:
            return False
        if isinstance(frame, str):
            self._text(json.loads(frame))
        elif frame[0] == 1:
            number, time_ns = struct.unpack_from("<IQ", frame, 1)
            self.messages.append(Message(self._subscribed[number], time_ns, frame[13:]))
        elif frame[0] == 2:
            self.times.append(struct.unpack_from("<Q", frame, 1)[0])
        elif frame[0] == 5:
            status, time_ns, speed, seeked, length = struct.unpack_from("<BQf?I", frame, 1)
            assert len(frame) == 19 + length
            words = ("playing", "paused", "buffering", "ended")
            self.states.append(State(words[status], time_ns, speed, seeked, frame[19:].decode()))
        else:
            raise AssertionError(frame[:20])
        return True

    def until(self, done):
        """Take frames until something is so."""
        end = time.monotonic() + PATIENCE_S
        while not done():
            assert time.monotonic() < end, (self.statuses, self.states[-2:], len(self.messages))
            self.take(0.05)

    def drain(self, quiet_s=0.3):
        """Take frames until none comes for a while."""
        while self.take(quiet_s):
            pass

    def subscribe(self, *topics):
        """Subscribe; numbers are the topics' places in ``channels``."""
        wanted = []
        for topic in topics or list(self.channels):
            number = 100 + list(self.channels).index(topic)
            self._subscribed[number] = topic
            wanted.append({"id": number, "channelId": self.channels[topic]["id"]})
        self.say(op="subscribe", subscriptions=wanted)

    def unsubscribe(self, topic):
        number = next(key for key, value in self._subscribed.items() if value == topic)
        self.say(op="unsubscribe", subscriptionIds=[number])

    def advertise(self, number, topic, type_name, encoding="cdr"):
        channel = {"id": number, "topic": topic, "encoding": encoding, "schemaName": type_name}
        self.say(op="advertise", channels=[channel])

    def publish(self, number, data):
        self.socket.send(b"\x01" + struct.pack("<I", number) + data)

    def control(self, *, play, speed=1.0, seek_ns=None, request="r"):
        """Steer playback; return the answer."""
        head = struct.pack("<BBf?QI", 3, not play, speed, seek_ns is not None, seek_ns or 0, len(request))
        self.socket.send(head + request.encode())
        self.until(lambda: any(item.request == request for item in self.states))
        return next(item for item in self.states if item.request == request)

    def say(self, **words):
        self.socket.send(json.dumps(words))

    def on(self, topic):
        """What has come on a topic."""
        return [item for item in self.messages if item.topic == topic]

    def _text(self, told):
        match told["op"]:
            case "serverInfo":
                self.info = told
            case "advertise":
                self.channels |= {item["topic"]: item for item in told["channels"]}
            case "unadvertise":
                gone = set(told["channelIds"])
                self.channels = {key: item for key, item in self.channels.items() if item["id"] not in gone}
            case "status":
                self.statuses.append(told)
            case _:
                raise AssertionError(told)
