"""The diagnosis of a link: which messages were lost, where and why. Batches and columns in, verdicts out.

No sockets, no clocks, no files. The path of a capture, folder by folder:

1. ``evidence``: one row for each datagram (``table``), in order of time and without copies (``preparation``,
   ``copies``), with set clocks corrected (``clocks``). It also has the senders of packets (``instances``,
   ``peers``), the reports of cFS itself (``payloads``, ``loss_reports``), and the states of all parts over
   time (``timeline``). ``quality`` bounds the number of datagrams that the capture missed.
2. ``matching``: rows become streams. A pair of streams with the same messages in and out of cFS is a hop
   (``crossing``).
3. ``accounting``: ``losses`` has its two values: a ``Loss``, and the ``Fate`` of each message of a stream
   into cFS. Messages that CI did not count were lost in front of it (``ingest``). Stopped, closed or silent
   parts took no messages (``closed``). Gaps in sequence counts (``bus``) and commands that did not come out
   (``pipes``) share the counts of 0x803 (``claims``). ``commands`` runs these steps in order. ``content``
   compares the values of what came out.
4. ``ledger``: every arrival ends at one hop in one way. All figures are sums of its rows (``balance``,
   ``summary``), all lists of messages are selections of its entries (``missing``).
5. ``rules``: each rule yields verdicts from the ``case``, which has all of the above. ``docs/rules``
   describes them. ``advice`` asks the queue model for a remedy.

``examination`` goes through a capture of any length, and returns a diagnosis. ``case`` is one capture: all of
the above from step 2 on is an attribute of it, found when it is first asked for, and asks it for the others.
"""
