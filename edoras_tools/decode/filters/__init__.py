"""The ``--where`` language: text to a tree, the tree to columns."""
