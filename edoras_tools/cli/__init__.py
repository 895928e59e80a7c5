"""The command lines: one file a command, which parses, calls a pipeline and renders. No logic lives here.

Heavy imports are inside the commands, so that ``edoras --help`` stays quick.
"""
