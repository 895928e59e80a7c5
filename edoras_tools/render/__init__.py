"""Views for people: the packet list, the tree, the hex dump, tables, live counters and pictures of them.

Views of one packet are plain strings with ANSI styles, for they are made thousands of times a second; views
of a whole run are rich renderables. Nothing that came off the wire reaches the terminal unescaped.
"""
