"""The commands ``sim``, ``demo`` and ``sweep``."""
