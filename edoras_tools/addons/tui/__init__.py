"""``edoras sniff --tui``: packet list, layers and bytes in the terminal, linked both ways (extra ``tui``)."""
