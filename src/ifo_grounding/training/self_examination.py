"""Phase 2: improve a policy on chosen instructions under a learned reward (paper, Algorithm 1)."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from torchrl.envs import EnvBase
from torchrl.envs.batched_envs import BatchedEnvBase

from ifo_grounding import keys
from ifo_grounding.attributes import first_worker, untransformed
from ifo_grounding.errors import UserError, check_choice, check_numbers, check_range
from ifo_grounding.machine import release_freed_memory
from ifo_grounding.seeding import derive
from ifo_grounding.training.auxiliary import AdversarialUpdates, AuxiliaryImitation
from ifo_grounding.training.checkpoint import Checkpoint
from ifo_grounding.training.collection import Here, OnRay
from ifo_grounding.training.loop import Log, Loop, Metrics
from ifo_grounding.training.policy_gradient import Learner
from ifo_grounding.training.reseeding import stored_starts
from ifo_grounding.training.selection import BestCheckpoint, HeldOutAccuracy
from ifo_grounding.transforms.base import exposes_state, instructs

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
    """Learning rate of the critic."""
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
    value_warmup: int = 2
    """First iterations, of more, that train the critic alone."""
    grad_clip: float = 1.0
    """Largest norm of the gradient."""
    select_every: int = 0
    """Iterations between two measures of the greedy policy: its learned return or, with adversarial
    updates, its accuracy on held-out demonstrations. In the end the best policy is kept, which may
    be phase 1's; 0 keeps the last one."""
    select_margin: float = 2.0
    """Standard errors by which a policy has to be better than the best one to be kept: 2 keeps
    clear gains alone, -1 whatever is not clearly worse."""
    select_episodes: int = 512
    """Episodes of each such measure, always from the same starts."""
    max_steps: int = 40
    """Most actions of each of these episodes."""
    evaluate_every: int = 0
    """Iterations between two calls of the callback; 0 calls it at the end only."""

    @property
    def passes(self) -> int:
        """Passes over the collected steps."""
        return self.epochs if self.algorithm == "ppo" else 1

    def __post_init__(self) -> None:
        check_numbers(self, unbounded=["grad_clip", "select_margin"])
        check_choice("algorithm", self.algorithm, ALGORITHMS)
        check_range(self, "iterations", "steps", "epochs", "minibatch", least=1)
        check_range(self, "select_episodes", "max_steps", least=1)
        check_range(self, "lr", "value_lr", "clip", "grad_clip", above=0)
        check_range(self, "gamma", "lmbda", least=0, most=1)
        check_range(self, "entropy", "value_warmup", least=0)
        check_range(self, "select_every", "evaluate_every", least=0)
        if self.value_warmup >= self.iterations:
            raise UserError(
                f"value_warmup={self.value_warmup} of {self.iterations} iterations: the policy "
                "would never learn; lower it, or raise iterations"
            )


def self_examine(
    env: EnvBase,
    policy: ProbabilisticTensorDictSequential,
    value: TensorDictModuleBase,
    config: SelfExaminationConfig,
    **options: Any,
) -> list[Metrics]:
    """Improve the phase-1 policy in place by policy gradient on learned rewards.

    Returns the metrics of each iteration.

    Args:
        env: without true instructions and rewards, otherwise as :func:`improve_policy` has it, and
            so are all other arguments.

    Raises:
        UserError: where the env exposes its true state or its own instructions, and as of
            :func:`improve_policy`.
    """
    if exposes_state(env):
        raise UserError("self-examination never sees the true state: use expose_state=False")
    if instructs(env):
        raise UserError("self-examination never sees true instructions: use instructed=False")
    return improve_policy(env, policy, value, config, **options)


def improve_policy(
    env: EnvBase,
    policy: ProbabilisticTensorDictSequential,
    value: TensorDictModuleBase,
    config: SelfExaminationConfig,
    *,
    seed: int,
    adversarial: AdversarialUpdates | None = None,
    imitation: AuxiliaryImitation | None = None,
    held_out: HeldOutAccuracy | None = None,
    checkpoint: str | Path | None = None,
    checkpoint_seconds: float = 15.0,
    log: Log | None = None,
    callback: Callable[[int], Metrics] | None = None,
    progress: bool = False,
    workers: Sequence[Callable[[], EnvBase]] = (),
    cudagraph: bool = False,
) -> list[Metrics]:
    """Improve ``policy`` in place by policy gradient on learned rewards, wherever it may step.

    Returns the metrics of each iteration.

    Args:
        env: batched; its transforms write ``("next", "learned_reward")`` and, where it has none,
            instructions. They are seeded anew each iteration, but for those inside the workers of a
            ``SerialEnv`` or ``ParallelEnv``. What the env itself pays is not read.
        seed: all randomness is a function of it and of the iteration, which starts from a reset.
        adversarial: trains the reward model on, with the steps of each iteration.
        held_out: policies that are clearly less accurate there than phase 1 are not selected. With
            ``adversarial`` the most accurate policy is the best.
        checkpoint: file to continue from, to the same result, and to save to.
        log: gets the metrics of each iteration and its number.
        callback: gets the iteration, returns further metrics; the place for audits.
        workers: where steps are not to be collected in ``env``: each makes, in a process of a Ray
            cluster, an environment like it that has its share of the rows.
        cudagraph: whether to capture the gradient step as a CUDA graph on a GPU, as of
            :func:`~ifo_grounding.training.fit`.

    Raises:
        UserError: where the env has no instructions or no learned reward, where ``policy`` is no
            actor, or where the best one is to be selected with ``adversarial`` but without
            ``held_out``.
    """
    if not isinstance(policy, ProbabilisticTensorDictSequential):
        raise UserError(
            f"the policy must be an actor, as make_policy gives, got {type(policy).__name__}: of "
            "others before an actor make one by ProbabilisticTensorDictSequential(*others, *actor)"
        )
    _check(env)
    if workers and stored_starts(env):
        raise UserError("stored pairs are cycled through in one process: do without workers")
    # Before a collector resets the env, so that it remembers the first starts.
    best = BestCheckpoint(
        env,
        policy,
        seed=seed,
        episodes=config.select_episodes,
        max_steps=config.max_steps,
        margin=config.select_margin,
        held_out=held_out,
        by_accuracy=adversarial is not None and config.select_every > 0,
    )
    policy.eval()
    value.eval()
    learner = Learner(policy, value, config, imitation)
    there = policy, config.steps
    where = OnRay(env, *there, workers) if workers else Here(env, *there)
    parts: dict[str, Any] = {"policy": policy, "value": value}
    parts |= {"optimizer": learner.optimizer, "best": best}
    if adversarial is not None:
        parts |= {"reward": adversarial.loss, "reward optimizer": adversarial.optimizer}
    parts |= {f"starts {number}": starts for number, starts in enumerate(stored_starts(env))}
    settings = {**asdict(config), "seed": seed, "worlds": env.batch_size.numel()}
    saved = Checkpoint(checkpoint, settings, **parts) if checkpoint else None
    loop = Loop(NAME, config.iterations, saved, checkpoint_seconds, log, progress)
    learner.prepare(cudagraph and (imitation is None or imitation.loss.capturable))
    every = config.select_every
    if every and not loop.history:
        best.measure()
    with contextlib.closing(where):
        for iteration in loop:
            batch, counted = where.collect(derive(seed, NAME, iteration))
            metrics: Metrics = {"step": float(iteration + 1), **summary(batch), **counted}
            metrics |= learner.improve(batch, iteration)
            loop.check(metrics, iteration + 1)  # before the policy is asked to act again
            release_freed_memory()  # batches of distinct pictures differ in size and would pile up
            if adversarial:
                metrics |= adversarial(batch)
            done = iteration + 1
            last = done == config.iterations
            if every and (last or done % every == 0):
                metrics |= best.measure()
            if last:
                best.restore()
            if callback and (last or (config.evaluate_every and done % config.evaluate_every == 0)):
                metrics |= {name: float(number) for name, number in callback(done).items()}
            loop.add(metrics, done)
    return loop.history


def _check(env: EnvBase) -> None:
    """Refuse an env that lacks something."""
    observed = env.observation_spec.keys(True, True)
    if keys.INSTRUCTION not in observed:
        raise UserError("the env has no instructions: add InstructionSampler or StartingPairs")
    written = [*env.full_reward_spec.keys(True, True), *observed]
    if keys.LEARNED_REWARD not in written:
        raise UserError("the env pays no learned reward: add LearnedReward or GoalReward")
    workers = untransformed(env)
    if isinstance(workers, BatchedEnvBase) and stored_starts(first_worker(workers)):
        raise UserError(
            "StartingPairs inside a worker cannot be seeded or gone back to: do without workers; "
            "more rows (num_envs) are faster"
        )


def summary(batch: TensorDictBase) -> Metrics:
    """Describe collected steps [N, T], which begin with a reset, by what the learner can see.

    Returns and lengths are those of finished episodes: the last one of a row is mostly cut, and so
    are all that take longer than T steps.
    """
    done = batch[keys.NEXT, "done"].reshape(batch.shape)
    stopped = batch[keys.NEXT, "terminated"].reshape(batch.shape)
    reward = batch[keys.NEXT, keys.LEARNED_REWARD].reshape(batch.shape)
    finished = done.flip(-1).cumsum(-1).flip(-1) > 0
    episodes = done.sum().clamp(min=1)
    cut = (~done[..., -1]).sum()
    return {
        "frames": float(batch.numel()),
        "learned_reward": float(reward.mean()),
        "learned_return": float((reward * finished).sum() / episodes),
        "episode_length": float(finished.sum() / episodes),
        "stopped": float(stopped.sum() / episodes),
        "unfinished": float(cut / (done.sum() + cut)),
    }
