"""Bytes to values and back, layer by layer; the standard library, numpy and a checksum library only.

``layout`` is the description of a header from which every reader is made. ``ccsds``, ``cfe``, ``sbn`` and
``envelope`` (with CDR's header) hold the tables of their layer and the strict functions that emit it.
"""
