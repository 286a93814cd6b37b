"""Behavioural cloning of the package imitation, with our network, data and batch size."""

import sys
from pathlib import Path

import numpy as np
import torch
from gymnasium import spaces
from imitation.algorithms import bc
from imitation.data.types import DictObs, Transitions
from imitation.util.logger import HierarchicalLogger
from serving import serve
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import ActorCriticPolicy

from ifo_grounding import networks

BATCH, BATCHES = int(sys.argv[2]), int(sys.argv[3])


class Policy(ActorCriticPolicy):
    """Our gated-attention network behind the interface of Stable Baselines."""

    def _build(self, lr_schedule) -> None:
        shapes = networks.Shapes(image_shape=(3, 48, 48), vocabulary_size=48)
        self.network = networks.make_policy(shapes, "paper", seed=0)[0].module
        self.optimizer = self.optimizer_class(
            self.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs
        )

    def evaluate_actions(self, obs, actions):
        logits = self.network(obs["pixels"].byte(), obs["instruction"].long())
        distribution = torch.distributions.Categorical(logits=logits)
        return None, distribution.log_prob(actions.flatten()), distribution.entropy()


def main() -> None:
    torch.set_num_threads(int(sys.argv[4]))
    arrays = np.load(Path(sys.argv[1]))
    count = len(arrays["action"])
    seen = DictObs({"pixels": arrays["pixels"], "instruction": arrays["instruction"]})
    space = spaces.Dict(
        {
            "pixels": spaces.Box(0, 255, (3, 48, 48), np.uint8),
            "instruction": spaces.Box(0, 47, (16,), np.int64),
        }
    )
    trainer = bc.BC(
        observation_space=space,
        action_space=spaces.Discrete(6),
        rng=np.random.default_rng(0),
        policy=Policy(space, spaces.Discrete(6), lambda _: 8e-4),
        demonstrations=Transitions(
            obs=seen,
            acts=arrays["action"],
            infos=np.array([{}] * count),
            next_obs=seen,
            dones=np.zeros(count, bool),
        ),
        batch_size=BATCH,
        device="cpu",
        custom_logger=HierarchicalLogger(Logger(None, [])),
    )

    def work() -> float:
        trainer.train(n_batches=BATCHES, log_interval=10**9, progress_bar=False)
        return float(BATCHES * BATCH)

    serve({"train": work})


if __name__ == "__main__":
    main()
