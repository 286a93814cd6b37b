import pytest

from ifo_grounding.options import options_of
from importing import recipes_importable

TINY = (
    *("budget=tiny", "progress=false", "threads=1", "logger=none"),
    *("instruction.threshold=0.01", "demonstrations.n=60", "transitions.n=1000"),
)


@pytest.fixture
def recipes():
    """The folder of the recipes, importable."""
    with recipes_importable() as folder:
        yield folder


@pytest.fixture
def options(recipes, tmp_path):
    """Return a function that composes the options of a tiny run in a temporary folder."""

    def composed(*overrides, run="run"):
        return options_of(*TINY, f"run={tmp_path / run}", *overrides)

    return composed


@pytest.fixture
def phase_1(recipes):
    """Return a function that makes the stages of phase 1, or those up to one of them."""

    def make(options, until="imitate"):
        from two_phase import stages_of

        for name, stage in stages_of(options).items():
            stage(options)
            if name == until:
                return

    return make
