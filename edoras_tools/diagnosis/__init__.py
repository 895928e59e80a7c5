"""What became of each message on a link, where it was lost and why: batches and columns in, verdicts out.

No sockets, no clocks, no files. The walk of a capture, folder by folder:

1. ``evidence``: a row a datagram (``table``), each once and in order of time (``preparation``, ``copies``),
   as if no clock had been set (``clocks``); who made what (``instances``, ``peers``), what cFS itself says
   (``payloads``, ``loss_reports``), and in which state everything was (``timeline``). ``quality`` bounds what
   the capture missed.
2. ``matching``: rows become streams, and a stream that comes out again as another is a hop (``crossing``).
3. ``accounting``: ``losses`` has its two values: a ``Loss``, and the ``Fate`` of what goes into cFS, message
   by message. What CI did not count was lost before it (``ingest``); what was stopped, closed or silent took
   nothing (``closed``); what is missing from sequence counts (``bus``) and what did not come out (``pipes``)
   claim the counts of 0x803 together (``claims``). ``commands`` is the order in which all that is asked.
4. ``ledger``: every arrival ends at one hop in one way. All figures are sums of its rows (``balance``,
   ``summary``), all messages selections of its entries (``missing``, ``trace``, ``rounds``).
5. ``rules``: each yields verdicts with its own id, by ``case``, which holds all of the above; ``docs/rules``
   describes them. ``advice`` asks the model of queues what helps.

``examination`` goes through a capture of any length, and returns a diagnosis.
"""
