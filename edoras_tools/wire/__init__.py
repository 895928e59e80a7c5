"""Bytes to values and back, one file a layer; the standard library, numpy and a checksum library only.

``layout`` is the one description of a header that every reader is made from. ``ccsds``, ``cfe``, ``sbn``,
``envelope`` and ``cdr`` hold the tables of their layer and the strict half that emits it.
"""
