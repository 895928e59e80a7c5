"""C99 for flight software without ROS, generated from ROS message definitions.

``bounds`` has the maximum lengths of sequences and strings, ``plan`` the C form of types (and the size of
their longest CDR). ``header`` writes the headers; ``generation`` writes the other files, and adds those of
``runtime/``, which are plain C. ``summary`` describes the result. ``generator`` is a whole cFS app, for
``edoras sweep``.
"""
