"""Policy gradient on TorchRL's losses: estimates advantages, updates."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from torchrl.objectives import ClipPPOLoss, LossModule, ReinforceLoss
from torchrl.objectives.value import GAE

from ifo_grounding import keys
from ifo_grounding.modules import output_key
from ifo_grounding.training.auxiliary import AuxiliaryImitation
from ifo_grounding.training.loop import Metrics
from ifo_grounding.training.updates import make_optimizer, means, update

if TYPE_CHECKING:
    from ifo_grounding.training.self_examination import SelfExaminationConfig

AT_ONCE = 2048
"""Steps whose values are estimated together, to bound memory."""


class Learner:
    """Holds the losses and the optimizer of one run."""

    def __init__(
        self,
        policy: ProbabilisticTensorDictSequential,
        value: TensorDictModuleBase,
        config: SelfExaminationConfig,
        imitation: AuxiliaryImitation | None = None,
    ) -> None:
        self.config, self.imitation = config, imitation
        self.advantage = GAE(
            gamma=config.gamma,
            lmbda=config.lmbda,
            value_network=value,
            deactivate_vmap=True,  # networks compute what repeats once, in shapes that vmap lacks
            value_chunk_size=max(1, AT_ONCE // config.steps),
        )
        self.loss: LossModule
        if config.algorithm == "ppo":
            self.loss = ClipPPOLoss(
                policy,
                value,
                clip_epsilon=config.clip,
                entropy_bonus=config.entropy > 0,
                entropy_coeff=config.entropy,
                normalize_advantage=True,
            )
        else:
            self.loss = ReinforceLoss(policy, value)
        worth = output_key(value, keys.STATE_VALUE)
        for part in (self.advantage, self.loss):
            part.set_keys(reward=keys.LEARNED_REWARD, value=worth)
        critic = {id(p) for p in value.parameters()}
        actor = [p for p in policy.parameters() if id(p) not in critic]
        self.optimizer = make_optimizer(actor, config.lr)
        self.optimizer.add_param_group({"params": list(value.parameters())})

    def improve(self, batch: TensorDictBase, iteration: int) -> Metrics:
        """Update policy and value on collected steps."""
        config = self.config
        with torch.no_grad():
            self.advantage(batch)
        scale = 1 - iteration / config.iterations if config.anneal else 1.0
        trained = iteration >= config.value_warmup
        self.optimizer.param_groups[0]["lr"] = scale * config.lr if trained else 0.0
        self.optimizer.param_groups[1]["lr"] = scale * config.value_lr
        # What comes next is in the advantage already; copying its images would cost a tenth.
        steps = batch.exclude(keys.NEXT, keys.INITIAL_PIXELS).reshape(-1)
        epochs = config.epochs if config.algorithm == "ppo" else 1
        updates = []
        for _ in range(epochs):
            for rows in torch.randperm(len(steps)).split(config.minibatch):
                losses = self.loss(steps[rows])
                if self.imitation:
                    losses["loss_imitation"] = self.imitation()
                updates.append(update(losses, self.optimizer, config.grad_clip))
        return means(updates)
