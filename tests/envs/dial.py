"""A tiny world that is no grid, as a user would write it: a dial with six marks, and ten words.

The image is 20 x 28 pixels, there are three actions, and an episode ends when the dial is pressed.
"""

from functools import partial

import gymnasium
import numpy as np

from ifo_grounding.data import Demonstrations
from ifo_grounding.envs import from_gymnasium
from ifo_grounding.tasks import Vocabulary
from ifo_grounding.worlds import World

MARKS = ("one", "two", "three", "four", "five", "six")
LEFT, RIGHT, PRESS = range(3)
WORDS = Vocabulary.from_sentences([f"turn the dial to {mark}" for mark in MARKS], length=6)
DIAL = {"vocabulary": WORDS, "image": "view", "instruction": "task"}


class Dial(gymnasium.Env):
    observation_space = gymnasium.spaces.Dict(
        {
            "view": gymnasium.spaces.Box(0, 255, (20, 28, 3), np.uint8),
            "task": gymnasium.spaces.Text(64),
        }
    )
    action_space = gymnasium.spaces.Discrete(3)

    def __init__(self, max_steps: int = 12) -> None:
        self.max_steps = max_steps

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at, self.wanted = self.np_random.choice(6, 2, replace=False)
        self.steps = 0
        return self._observe(), {"wanted": MARKS[self.wanted]}

    def step(self, action):
        self.steps += 1
        self.at = int(np.clip(self.at + {LEFT: -1, RIGHT: 1, PRESS: 0}[action], 0, 5))
        pressed = action == PRESS
        reward = float(pressed and self.at == self.wanted)
        return self._observe(), reward, pressed, self.steps >= self.max_steps, {}

    def _observe(self):
        view = np.full((20, 28, 3), 30, np.uint8)
        view[4:16, 2 + 4 * self.at : 5 + 4 * self.at] = (220, 180, 60)
        return {"view": view, "task": f"turn the dial to {MARKS[self.wanted]}"}


def dials(num_envs=3, make=Dial, **options):
    return from_gymnasium(make, num_envs=num_envs, **{"seed": 0, **DIAL, **options})


class DialWorld(World):
    """What the recipes need of it."""

    def __init__(self, max_steps=12):
        self.make, self.actions, self.stop_action = partial(Dial, max_steps), ("l", "r", "p"), PRESS

    def simulator(self, num_envs, **options):
        return self._dials(num_envs, instructed=False, **options)

    def instructed(self, num_envs, *, split="all", waits=False, **options):
        return self._dials(num_envs, **options)

    def _dials(self, num_envs, **options):
        return dials(num_envs, self.make, vocabulary=self.vocabulary, stop=PRESS, **options)


def demonstrations(n):
    shown, said = [], []
    for seed in range(n):
        world = Dial()
        seen = [world.reset(seed=seed)[0]]
        while world.at != world.wanted:
            seen.append(world.step(RIGHT if world.at < world.wanted else LEFT)[0])
        shown.append(np.stack([each["view"] for each in seen]).transpose(0, 3, 1, 2))
        said.append(seen[0]["task"])
    return Demonstrations.from_arrays(shown, said)
