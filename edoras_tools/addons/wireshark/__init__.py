"""The dissector for Wireshark, and our links as its capture interfaces."""
