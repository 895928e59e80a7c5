"""What all tests share."""

from hypothesis import settings

# Machines differ and are shared: an example may take as long as it takes.
settings.register_profile("edoras", deadline=None)
settings.load_profile("edoras")
