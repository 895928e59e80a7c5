"""Two runs of one system held against each other."""
