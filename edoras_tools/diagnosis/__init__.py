"""What is wrong on a link, where and why: accounting, matching across hops, and rules that give verdicts.

No sockets, no clocks, no files: batches and their columns in, verdicts out. Each rule is a file in ``rules``
with its own id; ``docs/rules`` describes them.
"""
