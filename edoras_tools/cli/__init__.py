"""The command lines: one file for each command, which parses, calls a pipeline and renders.

There is no logic here.

Options that go together are a ``NamedTuple``, and a command takes it as one value: ``declare.grouped`` makes
an option from each field. A group has a method that returns what pipelines take: ``decoding.settings()``. It
is not a dataclass because creating a dataclass takes three times as long, at every start.

Imports stand at the top of a file, with two exceptions, so that ``edoras --help`` and the first line of
``edoras sniff -r`` come at once. A command imports what it needs when it runs. Elsewhere a function imports
only a library that may be absent, or a module that is slow to import and seldom needed:
``tests/test_imports.py`` names these modules, what each imports later, and why.
"""
