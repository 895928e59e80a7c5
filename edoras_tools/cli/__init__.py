"""The command lines: one file for each command, which parses options, calls a pipeline, and renders.

These files contain no logic.

Options that belong together are a ``NamedTuple``, and a command takes it as one value: ``options.grouped``
makes an option from each field. A method of the group returns the value that pipelines take:
``decoding.settings()``. It is not a dataclass because creating a dataclass takes three times as long, at
every start.

Imports stand at the top of a file, with two exceptions, so that ``edoras --help`` and the first line of
``edoras sniff -r`` appear at once. A command imports its pipeline when it runs. In other folders a function
imports only libraries that may be absent, and modules that are slow to import and seldom needed:
``tests/test_imports.py`` lists these modules, their late imports, and the reasons.
"""
