"""Behavioural cloning of the package imitation, with our network, data and batch size.

The network is the paper's, once as its users would write it, with PyTorch's own layers, and once
with the layers of this package, which compute what repeats in a batch once.
"""

import itertools
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
from torch import nn
from torch.nn.utils.rnn import pack_padded_sequence

from ifo_grounding import networks

BATCH, BATCHES = int(sys.argv[2]), int(sys.argv[3])


class GatedAttentionPolicy(nn.Module):
    """The paper's policy in plain PyTorch."""

    def __init__(self) -> None:
        super().__init__()
        sizes = [3, 32, 32, 32, 32]
        self.image = nn.Sequential(
            *(
                part
                for before, after in itertools.pairwise(sizes)
                for part in (nn.Conv2d(before, after, 3, stride=2, padding=1), nn.ReLU())
            )
        )
        self.words = nn.Embedding(48, 8, padding_idx=0)
        self.sentence = nn.GRU(8, 64, batch_first=True, bidirectional=True)
        self.gate = nn.Linear(128, 32)
        self.head = nn.Sequential(
            *(nn.Dropout(0.25), nn.Linear(288, 128), nn.ReLU()),
            *(nn.Dropout(0.25), nn.Linear(128, 64), nn.ReLU()),
            *(nn.Dropout(0.25), nn.Linear(64, 6)),
        )

    def forward(self, pixels, tokens):
        lengths = (tokens != 0).sum(1).cpu()
        packed = pack_padded_sequence(
            self.words(tokens), lengths, batch_first=True, enforce_sorted=False
        )
        _, state = self.sentence(packed)
        gate = torch.sigmoid(self.gate(torch.cat([state[0], state[1]], -1)))
        return self.head((self.image(pixels / 255) * gate[..., None, None]).relu().flatten(1))


class Policy(ActorCriticPolicy):
    """A network behind the interface of Stable Baselines."""

    def __init__(self, observation_space, action_space, network) -> None:
        self.given = [network]  # no module may be set before the next line
        super().__init__(observation_space, action_space, lambda _: 8e-4)

    def _build(self, lr_schedule) -> None:
        self.network = self.given[0]
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
    shapes = networks.Shapes(image_shape=(3, 48, 48), vocabulary_size=48)
    ours = networks.make_policy(shapes, "paper", seed=0)[0].module

    def training(network):
        trainer = bc.BC(
            observation_space=space,
            action_space=spaces.Discrete(6),
            rng=np.random.default_rng(0),
            policy=Policy(space, spaces.Discrete(6), network),
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

        return work

    serve({"train": training(GatedAttentionPolicy()), "train ours": training(ours)})


if __name__ == "__main__":
    main()
