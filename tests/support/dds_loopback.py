"""Cyclone DDS on loopback alone: for the middleware, and for a program of its own."""

OPTIONS = {"interface": "lo", "multicast": "false", "peers": "127.0.0.1"}
URI = (
    '<CycloneDDS><Domain><General><Interfaces><NetworkInterface name="lo"/></Interfaces>'
    "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    '<Peers><Peer Address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>'
)
