"""GAIL of the package imitation in `move` of two numbers.

Prints which scenes it solves as it learns, by the seed and the reward that it is given.
"""

import enum
import json
import os
import sys
import tempfile

import gymnasium.vector
import numpy as np
import torch
from gymnasium import spaces
from imitation.algorithms.adversarial.gail import GAIL
from imitation.data.types import Trajectory
from imitation.rewards.reward_nets import BasicRewardNet
from imitation.util.logger import HierarchicalLogger
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecEnv

# Gymnasium 0.29, which imitation needs, has no such name, and these worlds no need of it.
gymnasium.vector.AutoresetMode = enum.Enum("AutoresetMode", "NEXT_STEP SAME_STEP DISABLED")

import cells  # noqa: E402

from ifo_grounding import keys  # noqa: E402


def read(image: torch.Tensor) -> np.ndarray:
    return cells.numbers(image).numpy()


class Worlds(VecEnv):
    """Our worlds behind the interface of Stable Baselines."""

    def __init__(self, seed: int) -> None:
        self.env = cells.Cells(cells.WORLDS, seed=seed)
        space = spaces.Box(-1, 1, (2,), np.float32)
        super().__init__(cells.WORLDS, space, spaces.Discrete(keys.N_ACTIONS))

    def reset(self) -> np.ndarray:
        self.state = self.env.reset()
        return read(self.state[keys.PIXELS])

    def step_async(self, actions: np.ndarray) -> None:
        self.state[keys.ACTION] = torch.from_numpy(actions)

    def step_wait(self):
        before, self.state = self.env.step_and_maybe_reset(self.state)
        after = before[keys.NEXT]
        done, last = after["done"].flatten().numpy(), read(after[keys.PIXELS])
        cut = (after["truncated"] & ~after["terminated"]).flatten().numpy()
        infos: list[dict] = [{} for _ in done]
        for row in np.flatnonzero(done):
            infos[row] = {"terminal_observation": last[row], "TimeLimit.truncated": cut[row]}
        reward = after[keys.REWARD].flatten().numpy()
        return read(self.state[keys.PIXELS]), reward, done, infos

    def close(self) -> None:
        pass

    def get_attr(self, attr_name, indices=None):
        return [getattr(self, attr_name, None)] * self.num_envs

    def set_attr(self, attr_name, value, indices=None):
        raise NotImplementedError

    def env_method(self, method_name, *args, indices=None, **kwargs):
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class, indices=None):
        return [False] * self.num_envs


class PaidLogit(GAIL):
    """Pays log D - log(1 - D), as ours does; the package's own reward is -log(1 - D)."""

    @property
    def reward_train(self):
        return self._reward_net


def main() -> None:
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what a library prints must not be taken for an answer
    seed, kind = int(sys.argv[1]), {"own": GAIL, "logit": PaidLogit}[sys.argv[2]]
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    images, actions = cells.demonstrated(seed)
    shown = [
        Trajectory(read(image), action.numpy(), None, terminal=True)
        for image, action in zip(images, actions, strict=True)
    ]
    worlds, ppo, rival = Worlds(seed + 1000), cells.PPO, cells.DISCRIMINATOR
    learner = PPO(
        "MlpPolicy",
        worlds,
        learning_rate=ppo["lr"],
        n_steps=cells.STEPS,
        batch_size=ppo["minibatch"],
        n_epochs=ppo["epochs"],
        gamma=ppo["gamma"],
        gae_lambda=ppo["lmbda"],
        clip_range=ppo["clip"],
        ent_coef=ppo["entropy"],
        max_grad_norm=ppo["grad_clip"],
        policy_kwargs={"net_arch": list(cells.POLICY_SIZES), "ortho_init": False},
        seed=seed,
        device="cpu",
    )
    network = BasicRewardNet(
        worlds.observation_space,
        worlds.action_space,
        use_next_state=False,
        hid_sizes=cells.DISCRIMINATOR_SIZES,
    )
    trainer = kind(
        demonstrations=shown,
        demo_batch_size=rival["batch_size"],
        venv=worlds,
        gen_algo=learner,
        reward_net=network,
        n_disc_updates_per_round=rival["steps"],
        disc_opt_kwargs={"lr": rival["lr"]},
        allow_variable_horizon=True,
        custom_logger=HierarchicalLogger(Logger(tempfile.mkdtemp(), []), []),
    )
    solved: list[list[int]] = []

    def act(image: torch.Tensor) -> torch.Tensor:
        return torch.from_numpy(learner.predict(read(image), deterministic=True)[0])

    def measure(number: int) -> None:
        if (number + 1) % cells.EVERY == 0:
            solved.append(cells.solved_by(act).int().tolist())

    trainer.train(cells.WORLDS * cells.STEPS * cells.ROUNDS, callback=measure)
    print(json.dumps(solved), file=answers, flush=True)


if __name__ == "__main__":
    main()
