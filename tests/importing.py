"""Recipes as modules, for tests that call them from Python."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ifo_grounding.cli import recipes_folder


@contextmanager
def recipes_importable() -> Iterator[Path]:
    """Make the recipes importable for a while; yields their folder."""
    folder = recipes_folder()
    sys.path.insert(0, str(folder))
    try:
        yield folder
    finally:
        sys.path.remove(str(folder))
        for name in [path.stem for path in folder.glob("*.py")]:
            sys.modules.pop(name, None)
