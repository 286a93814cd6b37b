"""Policy gradient on TorchRL's losses: estimates advantages, updates."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from torch import Tensor
from torch.distributions import Categorical
from torchrl.objectives import ClipPPOLoss, LossModule, ReinforceLoss
from torchrl.objectives.value import GAE

from ifo_grounding import keys
from ifo_grounding.modules import output_key
from ifo_grounding.training.auxiliary import AuxiliaryImitation
from ifo_grounding.training.loop import Metrics
from ifo_grounding.training.updates import make_optimizer, means, prepared, set_rates, update

if TYPE_CHECKING:
    from ifo_grounding.training.self_examination import SelfExaminationConfig

AT_ONCE = 2048
"""Steps whose values are estimated together, to bound memory."""


class _ClipPPOLoss(ClipPPOLoss):
    """TorchRL's loss without its wait for a GPU, to see whether entropies are finite.

    Those of a categorical are.
    """

    def _get_entropy(self, dist: Any, adv_shape: torch.Size) -> Any:
        if isinstance(dist, Categorical):
            return dist.entropy().unsqueeze(-1)
        return super()._get_entropy(dist, adv_shape)


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
            self.loss = _ClipPPOLoss(
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

    def prepare(self, cudagraph: bool) -> None:
        """Make updates with the optimizer as it now is, on a GPU as CUDA graphs if wanted."""
        self.captured = prepared(self.update, self.optimizer, cudagraph)

    def update(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Make one gradient step on collected and, beside them, demonstrated steps."""
        losses = self.loss(batch["collected"])
        if self.imitation:
            losses["loss_imitation"] = self.imitation(batch["demonstrated"])
        return update(losses, self.optimizer, self.config.grad_clip)

    def improve(self, batch: TensorDictBase, iteration: int) -> Metrics:
        """Update policy and value on collected steps."""
        config = self.config
        with torch.no_grad():
            self.advantage(batch)
        scale = 1 - iteration / config.iterations if config.anneal else 1.0
        trained = iteration >= config.value_warmup
        policy_lr = scale * config.lr if trained else 0.0
        set_rates(self.optimizer, policy_lr, scale * config.value_lr)
        # What comes next is in the advantage already; copying its images would cost a tenth.
        steps = batch.exclude(keys.NEXT, keys.INITIAL_PIXELS).reshape(-1)
        updates = []
        for _ in range(config.passes):
            for rows in torch.randperm(len(steps), device=steps.device).split(config.minibatch):
                parts = TensorDict({"collected": steps[rows]}, device=steps.device)
                if self.imitation:
                    parts["demonstrated"] = self.imitation.sample()
                whole = len(rows) == min(config.minibatch, len(steps))  # all that a graph takes
                updates.append(self.captured(parts) if whole else self.update(parts))
        return means(updates)
