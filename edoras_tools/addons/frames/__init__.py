"""CCSDS transfer frames (TM, AOS, TC): read, and the packets in them taken out."""
