"""The packets behind the panes: blocks of columns, and the threads that fill and filter them."""
