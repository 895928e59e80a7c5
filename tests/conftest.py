"""What all tests share."""

import os

from hypothesis import settings

# Machines differ and are shared: an example may take as long as it takes. The examples are the same in every
# run, so that a change is judged by what it changes; `make explore` draws new ones.
settings.register_profile("edoras", deadline=None, derandomize=True)
settings.register_profile("explore", deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "edoras"))
