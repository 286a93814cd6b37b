"""Policies that know the truth, to measure the measuring."""

import pytest
import torch
from tensordict import TensorDictBase

from ifo_grounding.tasks import SceneOptions, draw_scenes, expert
from ifo_grounding.world import WorldState


class Expert:
    """Follows shortest paths; needs an env with ``expose_state=True``."""

    def __init__(self, task: str, seed: int = 0, stream: str = "evaluation") -> None:
        self.seeded = SceneOptions(task, stream=stream), seed

    def __call__(self, td: TensorDictBase) -> TensorDictBase:
        state = WorldState(**dict(td["state"].items()), batch_size=td.batch_size)
        wanted = draw_scenes(*self.seeded, td["scene"].squeeze(-1)).wanted
        return td.set("action", expert.act(state, wanted))

    def on_even_scenes(self, td: TensorDictBase) -> TensorDictBase:
        """Solve even scenes; stop at once in odd ones."""
        action = self(td)["action"]
        return td.set("action", torch.where(td["scene"].squeeze(-1) % 2 == 0, action, 5))

    def steps(self, episodes: int) -> torch.Tensor:
        """Lengths of the shortest solutions."""
        return draw_scenes(*self.seeded, torch.arange(episodes)).wanted.steps


@pytest.fixture
def make_expert():
    return Expert


@pytest.fixture
def random_policy():
    """Draw actions uniformly."""
    return lambda td: td.set("action", torch.randint(6, td.shape))


@pytest.fixture
def up():
    """Always walk up."""
    return lambda td: td.set("action", torch.zeros(td.shape, dtype=torch.int64))
