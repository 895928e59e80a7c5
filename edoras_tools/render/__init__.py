"""Views for people: the packet list, the tree, the hex dump, tables, live counters and pictures of them.

Views of one packet are plain strings with ANSI styles, because they are made thousands of times a second;
views of a whole run are rich renderables. Text from packets is always escaped before it reaches the terminal.
"""
