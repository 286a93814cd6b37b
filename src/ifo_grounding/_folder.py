"""Where the recipes are."""

from __future__ import annotations

from pathlib import Path

from ifo_grounding.errors import UserError


def recipes_folder() -> Path:
    """Folder of the recipes: inside an installed wheel, or at the top of a source checkout.

    >>> (recipes_folder() / "conf" / "_hydra.yaml").is_file()
    True
    """
    package = Path(__file__).resolve().parent
    for folder in (package / "recipes", package.parents[1] / "recipes"):
        if (folder / "conf").is_dir():
            return folder
    raise UserError("this installation has no recipes: install ifo-grounding again")


def recipe_names() -> list[str]:
    """Names of all recipes, sorted."""
    return sorted(path.stem for path in recipes_folder().glob("[!_]*.py"))
