"""What became of the messages: losses and fates (``losses``), from which ``diagnosis.ledger`` makes its rows.

To read first: ``losses``, then ``commands``, which runs all steps in order. Each step has a file:

- ``ingest``: what was lost before CI, by its counts.
- ``closed``: what nobody could receive: ways out, peers, ports and applications that were closed or stopped.
- ``bus``: the gaps in sequence counts of telemetry, as claims on the counters of the software bus.
- ``pipes``: commands that did not come out, as such claims; and counts that no claim explains.
- ``claims``: shares the counts out to the claims.

Apart from these: ``content`` compares values that went in and came out, ``budget`` needs no capture.
"""
