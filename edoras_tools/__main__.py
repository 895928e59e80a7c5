"""``python -m edoras_tools``: the same as ``edoras``."""

from edoras_tools.cli.programs import main

if __name__ == "__main__":
    main()
