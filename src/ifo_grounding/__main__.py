"""``python -m ifo_grounding`` is the command ``ifo-grounding``."""

from ifo_grounding.cli import main

if __name__ == "__main__":
    main()
