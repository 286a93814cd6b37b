"""A tiny world that is no grid, as a user would write it: a dial with six marks, and ten words.

The image is 20 x 28 pixels, there are three actions, and an episode ends when the dial is pressed.
"""

import gymnasium
import numpy as np

MARKS = ("one", "two", "three", "four", "five", "six")
LEFT, RIGHT, PRESS = range(3)


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
