"""``edoras record --snapshot``: only what is around a trigger is written, each to a file of its own."""
