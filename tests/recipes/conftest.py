import sys

import pytest

from ifo_grounding._recipes import recipes_folder


@pytest.fixture
def recipes(monkeypatch):
    """The folder of the recipes, importable."""
    monkeypatch.syspath_prepend(str(recipes_folder()))
    yield recipes_folder()
    for name in [path.stem for path in recipes_folder().glob("*.py")]:
        sys.modules.pop(name, None)


@pytest.fixture
def compose(recipes, tmp_path):
    """Return a function that composes a recipe's options for a tiny run in a temporary folder."""
    from hydra import compose, initialize_config_dir

    def composed(name="two_phase", *overrides):
        with initialize_config_dir(version_base=None, config_dir=str(recipes / "conf")):
            return compose(
                name,
                [
                    "budget=tiny",
                    f"run={tmp_path / 'run'}",
                    "progress=false",
                    "threads=1",
                    "instruction.threshold=0.01",
                    *overrides,
                ],
            )

    return composed
