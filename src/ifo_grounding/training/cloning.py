"""Steps of a policy that its judge accepts, to clone: a simpler way to use a learned reward."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from ifo_grounding import keys
from ifo_grounding.errors import UserError
from ifo_grounding.seeding import derive
from ifo_grounding.training.environment import check_env, make_collector, reseed


class NothingAcceptedError(UserError):
    """The judge accepted no episode of the policy's."""


@torch.no_grad()
def accepted_steps(
    env: EnvBase,
    policy: torch.nn.Module,
    *,
    iterations: int,
    steps: int,
    seed: int,
    threshold: float = 0.5,
) -> TensorDict:
    """Let a policy practise, and return the steps of the episodes that the judge accepted.

    Args:
        env: batched, without true instructions and rewards; its transforms choose instructions
            and write ``("next", "learned_reward")``.
        policy: plays; it samples its actions.
        iterations: rounds, each from a reset.
        steps: environment steps of each world per round.
        seed: of the rounds.
        threshold: least learned return of an accepted episode.

    Returns:
        ``pixels``, ``instruction`` and ``action`` of the accepted episodes' steps, [N].

    Raises:
        NothingAcceptedError: where no episode was accepted.
    """
    check_env(env)
    policy.eval()
    collector = make_collector(env, policy, steps)
    batches, kept, ended = iter(collector), [], False
    for iteration in range(iterations):
        reseed(env, derive(seed, "accepted steps", iteration))
        batch = next(batches)
        batch = batch.reshape(-1, batch.shape[-1])  # worlds may lie in workers
        mask = accepted(
            batch[keys.NEXT, keys.LEARNED_REWARD].squeeze(-1),
            batch[keys.NEXT, "done"].squeeze(-1),
            threshold,
        )
        ended |= bool(batch[keys.NEXT, "done"][:, :-1].any())  # the last step is cut for all
        kept.append(batch.select(keys.PIXELS, keys.INSTRUCTION, keys.ACTION)[mask])
    collector.shutdown(close_env=False)
    chosen: TensorDictBase = torch.cat(kept)
    if not len(chosen):
        lower = "lower the threshold (controls.accept), train policy and judge for longer"
        longer = f"none ended within {steps} steps: play for longer (self_examine.steps)"
        raise NothingAcceptedError(
            f"the judge accepted no episode of {iterations} rounds in {env.batch_size.numel()} "
            f"environments, at a learned return of {threshold:g} or more: "
            f"{lower if ended else longer}, or do without cloning (controls.clone=false)"
        )
    return chosen


def accepted(reward: Tensor, done: Tensor, threshold: float) -> Tensor:
    """Say which steps belong to an episode that ended with a return of at least ``threshold``.

    Args:
        reward: learned rewards, float32 [N, T].
        done: ends of episodes, bool [N, T]; steps after the last end are of unfinished ones.
        threshold: least learned return.

    Returns:
        bool [N, T].

    >>> reward, done = torch.tensor([[0.0, 1.0, 0.0, 0.0]]), torch.tensor([[0, 1, 1, 0]]).bool()
    >>> accepted(reward, done, 0.5).tolist()
    [[True, True, False, False]]
    """
    total = torch.zeros_like(reward[:, 0])
    returns = torch.empty_like(reward)
    for step in range(reward.shape[1]):  # the return so far, which the end of an episode resets
        total = total + reward[:, step]
        returns[:, step] = total
        total = torch.where(done[:, step], 0, total)
    verdict = torch.zeros_like(done[:, 0])
    mask = torch.empty_like(done)
    for step in reversed(range(reward.shape[1])):  # the verdict at its end, carried back
        verdict = torch.where(done[:, step], returns[:, step] >= threshold, verdict)
        mask[:, step] = verdict
    return mask
