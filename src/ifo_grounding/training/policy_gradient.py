"""Policy gradient on TorchRL's losses: collecting steps, estimating advantages, updating."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from typing import TYPE_CHECKING

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.objectives import ClipPPOLoss, LossModule, ReinforceLoss
from torchrl.objectives.value import GAE

from ifo_grounding import keys
from ifo_grounding.modules import output_key
from ifo_grounding.training.environment import make_collector
from ifo_grounding.training.rehearsal import Rehearsal
from ifo_grounding.training.supervised import Metrics, make_optimizer, update

if TYPE_CHECKING:
    from ifo_grounding.training.self_examination import SelfExaminationConfig

AT_ONCE = 2048
"""Steps whose values are estimated at once: as fast as all of them, in a fraction of the memory."""


class Learner:
    """Holds the losses, the optimizer and the collector of one run."""

    def __init__(
        self,
        env: EnvBase,
        policy: ProbabilisticTensorDictSequential,
        value: TensorDictModuleBase,
        config: SelfExaminationConfig,
        rehearsal: Rehearsal | None = None,
    ) -> None:
        self.config, self.policy, self.rehearsal = config, policy, rehearsal
        self.value = value
        self.reference = copy.deepcopy(policy).requires_grad_(False) if config.kl else None
        self.collector = make_collector(env, policy, config.steps)
        self.batches: Iterator[TensorDictBase] | None = None
        # Values are given: the estimator would look at nearly all states twice, as next ones too.
        self.advantage = GAE(gamma=config.gamma, lmbda=config.lmbda, value_network=None)
        self.loss = _make_loss(policy, value, config)
        worth = output_key(value, keys.STATE_VALUE)
        for part in (self.advantage, self.loss):
            part.set_keys(reward=keys.LEARNED_REWARD, value=worth)
        critic = {id(p) for p in value.parameters()}
        self.optimizer = make_optimizer(
            (p for p in policy.parameters() if id(p) not in critic), 1.0
        )
        self.optimizer.param_groups[0]["lr"] = config.lr
        self.optimizer.add_param_group({"params": list(value.parameters()), "lr": config.value_lr})

    def collect(self) -> TensorDictBase:
        """Roll out the policy from a reset, [N, T], without whatever the simulator judged."""
        if self.batches is None:
            self.batches = iter(self.collector)
        return next(self.batches).exclude((keys.NEXT, keys.REWARD), keys.REWARD)

    @torch.no_grad()
    def charge(self, batch: TensorDictBase) -> Metrics:
        """Let collected steps pay for being away from the phase-1 policy, where that costs."""
        if self.reference is None:
            return {}
        steps = batch.reshape(-1)
        parts = steps.select(*self.policy.in_keys, keys.ACTION).split(4096)
        reference = torch.cat([_log_prob(self.reference, part) for part in parts])
        current = torch.cat([_log_prob(self.policy, part) for part in parts])
        away = (current - reference).reshape(*batch.shape, 1)
        reward = batch[keys.NEXT, keys.LEARNED_REWARD]
        batch[keys.NEXT, keys.LEARNED_REWARD] = reward - self.config.kl * away
        return {"divergence": float(away.mean())}

    def improve(self, batch: TensorDictBase, iteration: int) -> Metrics:
        """Update policy and value on collected steps."""
        config = self.config
        self._estimate_advantages(batch)
        scale = 1 - iteration / config.iterations if config.anneal else 1.0
        trained = iteration >= config.value_warmup
        self.optimizer.param_groups[0]["lr"] = scale * config.lr if trained else 0.0
        self.optimizer.param_groups[1]["lr"] = scale * config.value_lr
        # What comes next is in the advantage already; copying its images would cost a tenth.
        steps = batch.exclude(keys.NEXT, keys.INITIAL_PIXELS).reshape(-1)
        epochs = config.epochs if config.algorithm == "ppo" else 1
        sums: dict[str, Tensor] = {}
        updates = 0
        for _ in range(epochs):
            for rows in torch.randperm(len(steps)).split(config.minibatch):
                losses = self.loss(steps[rows])
                if self.rehearsal:
                    losses["loss_rehearsal"] = self.rehearsal()
                for key, scalar in update(losses, self.optimizer, config.grad_clip).items():
                    sums[key] = sums.get(key, torch.zeros(())) + scalar.cpu()
                updates += 1
        return {key: float(total) / updates for key, total in sums.items()}

    @torch.no_grad()
    def _estimate_advantages(self, batch: TensorDictBase) -> None:
        """Write advantages and value targets of steps [*B, T]."""
        names, seen = self.advantage.tensor_keys, self.value.in_keys
        value = self._values(batch.select(*seen).reshape(-1)).view(*batch.shape, 1)
        if not self.config.gamma:  # what comes next would count nothing
            reward = batch[keys.NEXT, keys.LEARNED_REWARD]
            found = {names.advantage: reward - value, names.value_target: reward}
            batch.update({**found, names.value: value})
            return
        # The next state is the next step's own, but where an episode or the batch is cut off; where
        # one ends, it counts nothing.
        upcoming = batch[keys.NEXT]
        cut = upcoming["done"].clone()
        cut[..., -1, :] = True
        cut &= ~upcoming["terminated"]
        following = value.roll(-1, -2)
        if cut.any():
            following[cut] = self._values(upcoming.select(*seen)[cut.squeeze(-1)]).view(-1)
        batch[names.value], batch[keys.NEXT, names.value] = value, following
        self.advantage(batch)

    def _values(self, states: TensorDictBase) -> Tensor:
        """Return the values of states [M], some at a time."""
        name = self.advantage.tensor_keys.value
        return torch.cat([self.value(part)[name] for part in states.split(AT_ONCE)])

    def close(self) -> None:
        """Let go of the collector, and leave the env open for its owner."""
        self.collector.shutdown(close_env=False)


def _make_loss(
    policy: ProbabilisticTensorDictSequential,
    value: TensorDictModuleBase,
    config: SelfExaminationConfig,
) -> LossModule:
    if config.algorithm == "ppo":
        return ClipPPOLoss(
            policy,
            value,
            clip_epsilon=config.clip,
            entropy_bonus=config.entropy > 0,
            entropy_coeff=config.entropy,
            normalize_advantage=True,
        )
    return ReinforceLoss(policy, value)


def _log_prob(policy: ProbabilisticTensorDictSequential, steps: TensorDictBase) -> Tensor:
    return policy.get_dist(steps.copy()).log_prob(steps[keys.ACTION])
