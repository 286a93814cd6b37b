import shutil

import pytest

from ifo_grounding.options import options_of
from importing import recipes_importable

TINY = (
    *("budget=tiny", "progress=false", "logger=none", "networks.features=16"),
    *("demonstrations.n=60", "transitions.n=500", "imitate.trials=1", "instruction.trials=1"),
    *("instruction.threshold=0.01", "instruction.steps=5", "goal.steps=5", "reward.steps=5"),
    *(f"{stage}.batch_size=32" for stage in ("inverse", "imitate", "instruction", "goal")),
    *("self_examine.num_envs=8", "self_examine.steps=10", "self_examine.minibatch=40"),
    *("self_examine.select_episodes=8", "evaluate.episodes=20", "evaluate.states=20"),
    *("evaluate.audit_episodes=10", "evaluate.max_steps=8", "self_examine.max_steps=8"),
)
"""Options of a run of both phases in seconds."""


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


@pytest.fixture(scope="session")
def made(tmp_path_factory):
    """The folder of a run whose phase 1 is done."""
    folder = tmp_path_factory.mktemp("made") / "run"
    with recipes_importable():
        make_stages(options_of(*TINY, f"run={folder}"), until="imitate")
    return folder


@pytest.fixture
def phase_1(made, tmp_path):
    """The folder ``run`` of a test, which has a copy of that run."""
    return shutil.copytree(made, tmp_path / "run")


def make_stages(options, until):
    """Make the stages of a run up to one of them."""
    from two_phase import stages_of

    for name, stage in stages_of(options).items():
        stage(options)
        if name == until:
            return
