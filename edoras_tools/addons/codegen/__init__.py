"""C99 for flight software without ROS, generated from ROS message definitions.

``plan`` has the C form of types, the maximum lengths of their sequences and strings, and the size of their
longest CDR. ``generation`` writes the files, and adds those of ``runtime/``, which are plain C; also a whole
cFS app, for ``edoras sweep``. ``writing`` describes the result.
"""
