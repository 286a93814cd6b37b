"""Phase 2: improve a policy on chosen instructions under a learned reward (paper, Algorithm 1)."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from torchrl.envs import EnvBase

from ifo_grounding.allocation import release_freed_memory
from ifo_grounding.errors import UserError, at_least_one, check_choice, check_numbers
from ifo_grounding.seeding import derive
from ifo_grounding.training.adversary import Adversary
from ifo_grounding.training.checkpoint import Checkpoint
from ifo_grounding.training.environment import (
    check_env,
    fixes_scenes,
    reseed,
    sampler_stats,
    summary,
    transforms_of,
    workers_fix_scenes,
)
from ifo_grounding.training.guard import Guard
from ifo_grounding.training.policy_gradient import Learner
from ifo_grounding.training.rehearsal import Rehearsal
from ifo_grounding.training.selection import Selection, SelectionSchedule
from ifo_grounding.training.supervised import Callback, Log, Metrics, plain_numbers

ALGORITHMS = ("ppo", "reinforce")
NAME = "self-examination"


@dataclass
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
    """Weight of the entropy bonus, with ``ppo``."""
    kl: float = 0.0
    """Reward that each nat away from the phase-1 policy costs."""
    value_warmup: int = 2
    """First iterations, of more, that train the value head alone."""
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
        check_numbers(self, unbounded=["grad_clip", "select_margin"])
        check_choice("algorithm", self.algorithm, ALGORITHMS)
        counts = ("iterations", "steps", "epochs", "minibatch", "select_episodes", "max_steps")
        for name in (*counts, "checkpoint_every"):
            at_least_one(name, getattr(self, name))
        for name in ("lr", "value_lr", "clip", "grad_clip"):
            if getattr(self, name) <= 0:
                raise UserError(f"{name} must be above 0, got {getattr(self, name)}")
        for name in ("gamma", "lmbda"):
            if not 0 <= getattr(self, name) <= 1:
                raise UserError(f"{name} must be within 0..1, got {getattr(self, name)}")
        for name in ("entropy", "kl", "value_warmup", "select_every", "evaluate_every"):
            if getattr(self, name) < 0:
                raise UserError(f"{name} must not be negative, got {getattr(self, name)}")
        if self.value_warmup >= self.iterations:
            raise UserError(
                f"value_warmup={self.value_warmup} of {self.iterations} iterations: the policy "
                "would never learn; lower it, or raise iterations"
            )

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
) -> list[Metrics]:
    """Improve ``policy`` in place by policy gradient on learned rewards.

    Args:
        env: batched, without true instructions and rewards; its transforms choose instructions
            and write ``("next", "learned_reward")``. Those around the workers of a ``SerialEnv`` or
            ``ParallelEnv`` are seeded anew each iteration, those inside of a worker are not.
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

    Returns:
        Metrics of each iteration.

    Raises:
        UserError: where the env exposes its true state, or has no learned reward, or where the best
            policy is to be selected beside an adversary, without a guard, or with starts inside of
            workers.
    """
    check_env(env)
    if config.select_every and workers_fix_scenes(env):
        raise UserError(
            "policies are compared on the same starts, and those inside of workers cannot be gone "
            "back to: set select_every=0 to keep the last one, or do without workers"
        )
    by_agreement = adversary is not None and config.select_every > 0
    if by_agreement and guard is None:
        raise UserError(
            "an adversary trains the judge on, whose returns cannot then be compared from one look "
            "to the next: give a guard, by whose demonstrations the best policy is selected, or "
            "set select_every=0 to keep the last"
        )
    policy.eval()
    value.eval()
    # Before a collector resets the env, so that it remembers the first starts.
    selection = Selection(env, policy, config.selection, seed, guard, by_agreement)
    learner = Learner(env, policy, value, config, rehearsal)
    sampler_stats(env)  # forgets the reset that a collector begins with
    parts: dict[str, Any] = {
        "loss": learner.loss,
        "optimizer": learner.optimizer,
        "best": selection,
    }
    if learner.reference is not None:
        parts["reference"] = learner.reference
    if adversary:
        parts["adversary"] = adversary
    parts |= {
        f"starts {place}": transform
        for place, transform in enumerate(transforms_of(env))
        if fixes_scenes(transform)
    }
    settings = {**asdict(config), "seed": seed, "worlds": env.batch_size.numel()}
    saved = Checkpoint(checkpoint, settings, **parts) if checkpoint else None
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
            metrics |= learner.charge(batch)
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
                metrics |= plain_numbers(callback(done))
            history.append(metrics)
            if log:
                log(metrics, done)
            if saved and (done % config.checkpoint_every == 0 or done == config.iterations):
                saved.save({"iteration": done, "history": history})
            bar.set_postfix(reward=f"{metrics['learned_return']:.3f}", refresh=False)
            bar.update()
    learner.close()
    return history
