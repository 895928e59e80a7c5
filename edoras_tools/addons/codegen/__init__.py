"""C99 for flight software without ROS, generated from ROS message definitions.

``bounds`` says how long sequences and strings may be, ``plan`` what types look like in C (``sizes``: how long
their longest CDR is), ``header``, ``codec``, ``tables`` and ``mission`` write one kind of file each,
``generation`` puts the files of a library together with those of ``runtime/``, which are C as it is;
``summary`` says what they are. ``generator`` is a whole cFS app, for ``edoras sweep``.
"""
