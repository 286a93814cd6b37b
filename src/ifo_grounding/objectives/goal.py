"""Learning whether an instruction is fulfilled: an extension of the paper."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor

from ifo_grounding import keys
from ifo_grounding.errors import at_least_one
from ifo_grounding.objectives.base import SupervisedLoss
from ifo_grounding.objectives.pairs import NegativeInstructions, masked_mean, pair_scores


class GoalLoss(SupervisedLoss):
    """Binary cross entropy of final frames against earlier ones and other instructions.

    An extension, which assumes that demonstrations end in success. Positives are final frames with
    their instructions. Negatives are, with half the weight each, earlier frames with their
    instructions, and final frames with others of the pool. Positives and negatives weigh the same;
    a class that a batch lacks counts 0. Writes ``loss_goal``, ``final_probability``,
    ``unfinished_probability`` and ``negative_probability``.

    Args:
        network: first image, image and instruction to a logit, as ``make_goal_classifier`` builds.
        pool: token ids [P, L] of the instructions of the demonstrations.
        negatives: how many other instructions each final frame is scored with.

    >>> from ifo_grounding.networks import Shapes, make_goal_classifier
    >>> pool = torch.arange(1, 13).unsqueeze(1).expand(12, 16)
    >>> network = make_goal_classifier(Shapes(image_shape=(3, 48, 48), vocabulary_size=40))
    >>> frames = torch.zeros(4, 3, 48, 48, dtype=torch.uint8)
    >>> losses = GoalLoss(network, pool)(TensorDict({
    ...     "initial_pixels": frames, "pixels": frames, "instruction": pool[:4],
    ...     "final": torch.tensor([[True], [False], [False], [True]]),
    ... }, [4]))
    >>> losses["loss_goal"].backward()
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that ``set_keys`` changes; the inputs' keys are the network's."""

        final: NestedKey = keys.FINAL
        """Whether a frame is the last of its demonstration, bool [*B, 1]."""

    written = keys.GOAL_SCORE
    out_keys = [  # noqa: RUF012
        "loss_goal",
        "final_probability",
        "unfinished_probability",
        "negative_probability",
    ]

    def __init__(self, network: TensorDictModule, pool: Tensor, *, negatives: int = 8) -> None:
        super().__init__(network)
        self.count = at_least_one("negatives", negatives)
        self.negatives = NegativeInstructions(pool, removal_rate=0.0)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Compute the loss of a batch of frames, some final."""
        self._require(tensordict)
        batch = tensordict.select(*self.in_keys).reshape(-1)
        final = batch.get(self.tensor_keys.final).reshape(-1).bool()
        others = self.negatives.draw(batch.get(self.network.in_keys[-1]), self.count)
        with self._mode():
            if final.is_cuda and self.capturable:  # score all: counting them would wait for the GPU
                own, other = pair_scores(self.network, batch, others, self.output)
                early, last, before = own, final, ~final
                told = final.unsqueeze(1).expand_as(other)
            else:
                own, other = pair_scores(self.network, batch[final], others[final], self.output)
                early, _ = pair_scores(self.network, batch[~final], others[~final, :0], self.output)
                last, before, told = (
                    torch.ones_like(each, dtype=torch.bool) for each in (own, early, other)
                )
        finished = masked_mean(F.softplus(-own), last)
        unfinished = masked_mean(F.softplus(early), before)
        elsewhere = masked_mean(F.softplus(other), told)
        return TensorDict(
            {
                "loss_goal": (finished + (unfinished + elsewhere) / 2) / 2,
                "final_probability": masked_mean(own.detach().sigmoid(), last),
                "unfinished_probability": masked_mean(early.detach().sigmoid(), before),
                "negative_probability": masked_mean(other.detach().sigmoid(), told),
            }
        )
