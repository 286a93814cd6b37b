"""Whether the instruction classifier chooses instructions that suit a state (paper, Table 3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import scipy
import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from ifo_grounding.errors import UserError, at_least_one, whole
from ifo_grounding.modules import device_of
from ifo_grounding.seeding import generator
from ifo_grounding.stats import Described, Estimate, Rate, auc, reliability, wilson
from ifo_grounding.tasks.goals import MAX_STEPS, REASONS, Goal, verdict
from ifo_grounding.tasks.grammar import FIELDS, grammar
from ifo_grounding.tasks.scenes import SceneOptions, draw_scenes
from ifo_grounding.tasks.vocabulary import VOCABULARY
from ifo_grounding.transforms.base import check_pool
from ifo_grounding.transforms.choosing import PoolScorer
from ifo_grounding.world import WorldState, render


@dataclass(frozen=True)
class SuitabilityResult(Described):
    """How good the chosen instructions are, and how good the threshold is."""

    rate: Rate
    """Share of suitable instructions among the chosen ones (the paper's suitable rate)."""
    served: Rate
    """Share of states for which any instruction was chosen."""
    servable: Rate
    """Share of states that some instruction of the pool suits, over the first 500 at most: no
    module can rightly serve more."""
    errors: dict[str, int]
    """Chosen instructions by what is wrong with them."""
    entropy: float
    """Entropy of the chosen goals in bits; wordings of one goal count together."""
    most_entropy: float
    """Entropy if every goal of the pool were chosen equally often, in bits."""
    precision: Rate
    """Share of suitable pairs among random pairs above the threshold."""
    recall: Rate
    """Share of random suitable pairs that are above the threshold."""
    auc: Estimate
    """Probability that a suitable pair scores above an unsuitable one."""
    reliability: list[tuple[float, Rate]]
    """Of random pairs, by bins of the probability that they are said to have: its mean, and the
    share that is suitable. Equal where the module is calibrated."""
    state: WorldState
    """The states, [N], on the CPU as what follows."""
    chosen: Tensor
    """Index of the instruction that was chosen for each, int64 [N]; -1 where none was."""
    score: Tensor
    """Its probability of being suitable, float32 [N]."""
    verdict: Tensor
    """Index into :data:`~ifo_grounding.tasks.REASONS`, int64 [N]; -1 where none was chosen."""


def suitable_rate(
    classifier: TensorDictModuleBase,
    task: str,
    pool: Tensor | Sequence[str],
    *,
    states: int = 20_000,
    threshold: float = 0.8,
    candidates: int = 64,
    choose: str = "random",
    pairs_per_state: int = 4,
    seed: int = 0,
    stream: str = "evaluation",
    tile_size: int = 8,
    batch_size: int = 1024,
    max_steps: int = MAX_STEPS,
    **scene_options: Any,
) -> SuitabilityResult:
    """Let the instruction classifier choose for fresh simulator states, and ask the oracle.

    Choices are made by :meth:`~ifo_grounding.transforms.PoolScorer.choose`, as in
    self-examination, except that each state is asked once: states that it does not serve count in
    ``served`` and nowhere else.

    Args:
        classifier: TensorDictModule from (pixels, instruction) to the logit of suitability.
        task: name of the task, whose grammar reads the pool.
        pool: the instructions to choose from, token ids [N, 16] or sentences.
        pairs_per_state: random pairs of each state for precision and recall; 0 for none.
        stream: ``evaluation`` for results, ``validation`` for choices.
        tile_size: pixels along one side of a cell.
        max_steps: a goal that needs more actions is unachievable.
        scene_options: of :class:`~ifo_grounding.tasks.SceneOptions`, such as ``layout``.

    Raises:
        UserError: on impossible options, or a pool that the task's grammar cannot read.

    >>> from tensordict.nn import TensorDictModule
    >>> yes = TensorDictModule(lambda pixels, instruction: torch.full((len(pixels), 1), 9.0),
    ...                        ["pixels", "instruction"], ["suitability"])
    >>> result = suitable_rate(yes, "move", ["move to the red circle"], states=100)
    >>> print(result.served, result.entropy, result.errors["missing"] > 50)
    100.0% [96.3, 100.0] (n=100) 0.0 True
    """
    if whole("pairs_per_state", pairs_per_state) < 0:
        raise UserError(f"pairs_per_state must not be negative, got {pairs_per_state}")
    states, batch_size = at_least_one("states", states), at_least_one("batch_size", batch_size)
    device = device_of(classifier) or torch.device("cpu")
    given = pool if isinstance(pool, Tensor) else VOCABULARY.encode(list(pool))
    tokens = check_pool(given).cpu()
    of_pool = grammar(task).parse_tokens(tokens)
    goals = of_pool.to(device)
    scorer = PoolScorer(classifier, tokens.to(device))
    draw = generator(seed, "suitability", stream)
    options = SceneOptions(
        task, instructed=False, stream=stream, max_steps=max_steps, **scene_options
    )
    how: dict[str, Any] = {"threshold": threshold, "candidates": candidates, "choose": choose}
    found, pairs = [], []
    for numbers in torch.arange(states, device=device).split(batch_size):
        state = draw_scenes(options, seed, numbers).state
        pixels = render(state, tile_size)
        chosen, score = scorer.choose(pixels, generator=draw, **how)
        reason = verdict(state, goals[chosen.clamp_min(0)], max_steps)
        reason = reason.where(chosen >= 0, -1)
        found.append([part.cpu() for part in (state, chosen, score, reason)])
        if pairs_per_state:
            index = torch.randint(len(goals), (len(pixels), pairs_per_state), generator=draw)
            index = index.to(device)
            suits = [verdict(state, goals[each], max_steps) == 0 for each in index.unbind(1)]
            logits = scorer.score(scorer.encode(pixels), index)
            pairs.append((logits.cpu(), torch.stack(suits, 1).cpu()))
    columns: Any = [torch.cat(column) for column in zip(*found, strict=True)]
    state, chosen, score, reason = columns
    # Equal goals of the pool share a number, int64 [pool].
    fields = torch.stack([getattr(of_pool, name) for name in FIELDS], dim=-1)
    goal_numbers = fields.unique(dim=0, return_inverse=True)[1]
    counts = reason[reason >= 0].bincount(minlength=len(REASONS)).tolist()
    return SuitabilityResult(
        rate=wilson(counts[0], sum(counts)),
        served=wilson(sum(counts), states),
        servable=_servable(state[:500].to(device), goals, goal_numbers, max_steps),
        errors=dict(zip(REASONS[1:], counts[1:], strict=True)),
        entropy=_entropy_bits(goal_numbers[chosen[chosen >= 0]]),
        most_entropy=_entropy_bits(goal_numbers.unique()),
        **_threshold_quality(pairs, threshold),
        state=state,
        chosen=chosen,
        score=score,
        verdict=reason,
    )


def _servable(state: WorldState, goals: Goal, goal_numbers: Tensor, max_steps: int) -> Rate:
    """Return the share of states [B] that any goal of a pool suits."""
    rows = {number: row for row, number in enumerate(goal_numbers.tolist())}
    suits = torch.zeros(len(state), dtype=torch.bool, device=goals.side.device)
    for row in rows.values():
        suits |= verdict(state, goals[row : row + 1].expand(len(state)), max_steps) == 0
    return wilson(int(suits.sum()), len(state))


def _entropy_bits(values: Tensor) -> float:
    """Return the entropy of the distribution of values, in bits."""
    counts = values.unique(return_counts=True)[1]
    return float(scipy.stats.entropy(counts, base=2)) if len(counts) else 0.0


def _threshold_quality(pairs: list[tuple[Tensor, Tensor]], threshold: float) -> dict[str, Any]:
    logits = torch.cat([logit for logit, _ in pairs]) if pairs else torch.zeros(0, 1)
    truth = torch.cat([suits for _, suits in pairs]) if pairs else torch.zeros(0, 1).bool()
    above = logits.sigmoid() > threshold
    hits = int((above & truth).sum())
    group = torch.arange(len(logits)).unsqueeze(1).expand_as(logits)
    return {
        "precision": wilson(hits, int(above.sum())),
        "recall": wilson(hits, int(truth.sum())),
        "auc": auc(logits, truth, group),
        "reliability": reliability(logits.sigmoid(), truth),
    }
