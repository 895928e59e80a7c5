"""Bytes to values and back, one file a layer; the standard library, numpy and a checksum library only.

``layout`` is the description of a header from which every reader is made. ``ccsds``, ``cfe``, ``sbn``,
``envelope`` and ``cdr`` hold the tables of their layer and the strict functions that emit it.
"""
