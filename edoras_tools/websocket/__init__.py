"""In front of a WebSocket server of the Foxglove SDK: who may come to it, and what went along."""

from edoras_tools.websocket.door import MOST, Door
from edoras_tools.websocket.guard import Guard
from edoras_tools.websocket.relay import Relay, secluded

__all__ = ["MOST", "Door", "Guard", "Relay", "secluded"]
