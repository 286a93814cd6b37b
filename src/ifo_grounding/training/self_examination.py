"""Phase 2: improve a policy on chosen instructions under a learned reward (paper, Algorithm 1)."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.objectives import ClipPPOLoss, LossModule, ReinforceLoss
from torchrl.objectives.value import GAE

from ifo_grounding import keys
from ifo_grounding.allocation import release_freed_memory
from ifo_grounding.errors import UserError, check_choice
from ifo_grounding.seeding import derive
from ifo_grounding.training.adversary import Adversary
from ifo_grounding.training.checkpoint import Checkpoint, fingerprint
from ifo_grounding.training.environment import (
    check_env,
    make_collector,
    reseed,
    sampler_stats,
    summary,
    transforms_of,
)
from ifo_grounding.training.guard import Guard
from ifo_grounding.training.rehearsal import Rehearsal
from ifo_grounding.training.selection import Selection, SelectionSchedule
from ifo_grounding.training.supervised import Callback, Log, Metrics, make_optimizer, update

ALGORITHMS = ("ppo", "reinforce")
NAME = "self-examination"
AT_ONCE = 2048
"""Steps whose values are estimated at once: as fast as all of them, in a fraction of the memory."""


@dataclass(frozen=True)
class SelfExaminationConfig:
    """How the policy is improved."""

    algorithm: str = "ppo"
    """``ppo`` (clipped, several epochs) or ``reinforce`` (one epoch, as in the paper)."""
    iterations: int = 30
    """Rounds of collecting and updating."""
    steps: int = 20
    """Environment steps of each world per iteration."""
    lr: float = 2e-4
    """Learning rate of the policy (paper: 3e-5)."""
    value_lr: float = 8e-4
    """Learning rate of the value head."""
    anneal: bool = False
    """Lower both learning rates linearly, to nothing after the last iteration."""
    gamma: float = 0.99
    """Discount; 0 credits each action with its own reward alone."""
    lmbda: float = 0.95
    """Trade-off of generalised advantage estimation."""
    epochs: int = 3
    """Passes over the collected steps, with ``ppo``."""
    minibatch: int = 1024
    """Steps per gradient step."""
    clip: float = 0.2
    """Clipping range of the probability ratio."""
    entropy: float = 0.01
    """Weight of the entropy bonus."""
    kl: float = 0.0
    """Reward that each nat away from the phase-1 policy costs."""
    value_warmup: int = 2
    """First iterations that train the value head alone."""
    grad_clip: float = 1.0
    """Largest norm of the gradient."""
    select_every: int = 0
    """Iterations between two looks at the greedy policy's learned return or, beside an adversary,
    its agreement with the guard's demonstrations. In the end the best policy is kept, which may be
    phase 1's; 0 keeps the last one."""
    select_margin: float = 2.0
    """Standard errors by which a policy has to be better than the best one to be kept: 2 keeps
    clear gains alone, -1 keeps all practice that does no clear harm."""
    select_episodes: int = 512
    """Episodes of each look, always from the same starts."""
    max_steps: int = 40
    """Most actions of an episode of such a look."""
    evaluate_every: int = 0
    """Iterations between two calls of the callback; 0 calls it at the end only."""
    checkpoint_every: int = 1
    """Iterations between two checkpoints."""

    def __post_init__(self) -> None:
        """Refuse unknown algorithms and empty budgets."""
        check_choice("algorithm", self.algorithm, ALGORITHMS)
        for name in ("iterations", "steps", "epochs", "minibatch", "checkpoint_every"):
            if getattr(self, name) < 1:
                raise UserError(f"{name} must be at least 1, got {getattr(self, name)}")

    @property
    def selection(self) -> SelectionSchedule:
        """When and how the best policy is chosen."""
        return SelectionSchedule(
            self.select_every,
            self.iterations,
            self.select_episodes,
            self.max_steps,
            self.select_margin,
        )


def self_examine(
    env: EnvBase,
    policy: ProbabilisticTensorDictSequential,
    value: TensorDictModuleBase,
    config: SelfExaminationConfig,
    *,
    seed: int,
    adversary: Adversary | None = None,
    rehearsal: Rehearsal | None = None,
    guard: Guard | None = None,
    checkpoint: str | Path | None = None,
    log: Log | None = None,
    callback: Callback | None = None,
    progress: bool = False,
    settings: Any = None,
) -> list[Metrics]:
    """Improve ``policy`` in place by policy gradient on learned rewards.

    Args:
        env: batched, without true instructions and rewards; its transforms choose instructions
            and write ``("next", "learned_reward")``.
        policy: the phase-1 policy, a ``ProbabilisticActor``.
        value: estimates the learned return.
        config: algorithm and budget.
        seed: all randomness is a function of it and of the iteration, and every iteration starts
            from a reset: a run continues from its checkpoint to the same result.
        adversary: trains the reward model on, with the steps of each iteration.
        rehearsal: imitates the demonstrations on.
        guard: keeps policies from being selected that go astray of its demonstrations. With an
            adversary the best policy is the one that agrees most with them.
        checkpoint: file to continue from and to save to.
        log: gets the metrics of each iteration.
        callback: gets the iteration, returns further metrics; the place for audits.
        progress: whether to show a progress bar.
        settings: what else decides the result; a checkpoint made with other settings is refused.

    Returns:
        Metrics of each iteration.

    Raises:
        UserError: where the env exposes its true state, or has no learned reward, or where the best
            policy is to be selected beside an adversary, without a guard.
    """
    check_env(env)
    by_agreement = adversary is not None and config.select_every > 0
    if by_agreement and guard is None:
        raise UserError(
            "an adversary trains the judge on, whose returns cannot then be compared from one look "
            "to the next: give a guard, by whose demonstrations the best policy is selected, or "
            "set select_every=0 to keep the last"
        )
    policy.eval()
    value.eval()
    learner = _Learner(env, policy, value, config, rehearsal)
    sampler_stats(env)  # forgets the reset that a collector begins with
    selection = Selection(env, policy, config.selection, seed, guard, by_agreement)
    parts: dict[str, Any] = {
        "loss": learner.loss,
        "optimizer": learner.optimizer,
        "best": selection,
    }
    if adversary:
        parts["adversary"] = adversary
    parts |= {
        f"starts {place}": transform
        for place, transform in enumerate(transforms_of(env))
        if getattr(transform, "fixes_scenes", False)
    }
    identity = fingerprint(config, seed, list(env.batch_size), settings)
    saved = Checkpoint(checkpoint, identity, **parts) if checkpoint else None
    state = (saved.load() if saved else None) or {"iteration": 0, "history": []}
    history: list[Metrics] = state["history"]
    if not state["iteration"]:
        selection.after(0)
    from tqdm import tqdm

    bar = tqdm(
        total=config.iterations,
        initial=state["iteration"],
        desc=NAME,
        disable=not progress,
        leave=False,
    )
    with bar:
        for iteration in range(state["iteration"], config.iterations):
            reseed(env, derive(seed, NAME, iteration))
            batch = learner.collect()
            metrics: Metrics = {"step": float(iteration + 1), **summary(batch)}
            metrics |= sampler_stats(env)
            metrics |= learner.improve(batch, iteration)
            release_freed_memory()  # batches of distinct pictures differ in size and would pile up
            if adversary:
                metrics |= adversary(batch)
            done = iteration + 1
            metrics |= selection.after(done)
            if done == config.iterations:
                selection.restore()
            due = config.evaluate_every and done % config.evaluate_every == 0
            if callback and (due or done == config.iterations):
                metrics |= callback(done)
            history.append(metrics)
            if log:
                log(metrics, done)
            if saved and (done % config.checkpoint_every == 0 or done == config.iterations):
                saved.save({"iteration": done, "history": history})
            bar.set_postfix(reward=f"{metrics['learned_return']:.3f}", refresh=False)
            bar.update()
    learner.close()
    return history


class _Learner:
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
        self.advantage = GAE(
            gamma=config.gamma, lmbda=config.lmbda, value_network=value, deactivate_vmap=True
        )
        self.advantage.set_keys(reward=keys.LEARNED_REWARD)
        self.loss = _make_loss(policy, value, config)
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
        batch = next(self.batches).exclude((keys.NEXT, keys.REWARD), keys.REWARD)
        if self.reference is not None:
            self._charge_divergence(batch)
        return batch

    @torch.no_grad()
    def _charge_divergence(self, batch: TensorDictBase) -> None:
        steps = batch.reshape(-1)
        parts = steps.select(keys.PIXELS, keys.INSTRUCTION, keys.ACTION).split(4096)
        assert self.reference is not None
        reference = torch.cat([_log_prob(self.reference, part) for part in parts])
        current = torch.cat([_log_prob(self.policy, part) for part in parts])
        charge = self.config.kl * (current - reference).reshape(*batch.shape, 1)
        reward = batch[keys.NEXT, keys.LEARNED_REWARD]
        batch[keys.NEXT, keys.LEARNED_REWARD] = reward - charge

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
        """Write advantages and value targets of steps [N, T], some worlds at a time."""
        parts = batch.split(max(1, AT_ONCE // batch.shape[-1]))
        estimate = self.advantage if self.config.gamma else self._undiscounted
        found = self.advantage.out_keys
        batch.update(torch.cat([estimate(part).select(*found) for part in parts]))

    def _undiscounted(self, part: TensorDictBase) -> TensorDictBase:
        """Do what the estimator does where only a step's own reward counts, for half the price.

        It would estimate the value of the next state all the same, and multiply it by 0.
        """
        names = self.advantage.tensor_keys
        value = self.value(part.select(*self.value.in_keys))[names.value]
        reward = part[keys.NEXT, keys.LEARNED_REWARD]
        found = {names.advantage: reward - value, names.value_target: reward, names.value: value}
        return TensorDict(found, part.batch_size)

    def close(self) -> None:
        """Let go of the collector, and leave the env open for its owner."""
        self.collector.shutdown(close_env=False)


def _make_loss(
    policy: ProbabilisticTensorDictSequential,
    value: TensorDictModuleBase,
    config: SelfExaminationConfig,
) -> LossModule:
    loss: LossModule
    if config.algorithm == "ppo":
        loss = ClipPPOLoss(
            policy,
            value,
            clip_epsilon=config.clip,
            entropy_bonus=config.entropy > 0,
            entropy_coeff=config.entropy,
            normalize_advantage=True,
        )
    else:
        loss = ReinforceLoss(policy, value)
    loss.set_keys(reward=keys.LEARNED_REWARD)
    return loss


def _log_prob(policy: ProbabilisticTensorDictSequential, steps: TensorDictBase) -> Tensor:
    return policy.get_dist(steps.copy()).log_prob(steps[keys.ACTION])
