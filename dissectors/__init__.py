"""The same layers for other tools: scapy layers, and a Wireshark dissector generated from the layouts.

Imports only ``edoras_tools.wire`` and ``edoras_tools.errors``; what a mission adds is handed in
as plain data.
"""
