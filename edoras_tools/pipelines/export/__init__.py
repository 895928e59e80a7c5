"""Topics into tables: files of other programs' formats, and arrays for Python."""
