"""The demos of the EDORAS paper."""
