import pytest

from importing import recipes_importable


@pytest.fixture
def recipes():
    """The folder of the recipes, importable."""
    with recipes_importable() as folder:
        yield folder


@pytest.fixture
def compose(recipes, tmp_path):
    """Return a function that composes a recipe's options for a tiny run in a temporary folder."""
    import _shared  # noqa: F401  (what options are computed by)
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
