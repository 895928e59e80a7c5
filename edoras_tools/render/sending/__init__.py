"""Views of the commands that send: replay, sweep, proxy."""
