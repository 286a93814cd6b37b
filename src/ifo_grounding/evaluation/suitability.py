"""Whether the instruction classifier chooses instructions that suit a state (paper, Table 3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from scipy import stats as scipy_stats
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from ifo_grounding.errors import UserError, at_least_one, whole
from ifo_grounding.evaluation.scenes import MAX_STEPS, device_of
from ifo_grounding.seeding import generator
from ifo_grounding.stats import Described, Estimate, Rate, auc, reliability, wilson
from ifo_grounding.tasks.goals import REASONS, Goal, verdict
from ifo_grounding.tasks.grammar import FIELDS, grammar
from ifo_grounding.tasks.scenes import SceneOptions
from ifo_grounding.tasks.streams import SceneStream
from ifo_grounding.tasks.vocabulary import VOCABULARY
from ifo_grounding.transforms.choosing import PoolScorer
from ifo_grounding.world import WorldState, render

NOT_SERVED = -1
SERVABLE_STATES = 500
"""States for which the oracle goes through the whole pool."""


class CheckedChoices(NamedTuple):
    """What was chosen for some states, and what is wrong with it."""

    state: WorldState
    """The states, [B]."""
    chosen: Tensor
    """Index of the chosen instruction in the pool, int64 [B]; -1 where none was above threshold."""
    score: Tensor
    """Its probability of being suitable, float32 [B]."""
    verdict: Tensor
    """Index into :data:`~ifo_grounding.tasks.REASONS`, int64 [B]; -1 where none was chosen."""


@dataclass(frozen=True)
class SuitabilityResult(Described):
    """How good the chosen instructions are, and how good the threshold is."""

    rate: Rate
    """Share of suitable instructions among the chosen ones (the paper's suitable rate)."""
    served: Rate
    """Share of states for which any instruction was chosen."""
    servable: Rate
    """Share of states that some instruction of the pool suits, over the first 500 at most: no
    module can rightly serve more. (With all instructions in the pool it is
    about 61% for ``pick``, 53% for ``pick-out``.)"""
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
    base_rate: Rate
    """Share of suitable pairs among random pairs of a state and an instruction of the pool."""
    auc: Estimate
    """Probability that a suitable pair scores above an unsuitable one."""
    reliability: list[tuple[float, Rate]]
    """Of random pairs, by bins of the probability that they are said to have: its mean, and the
    share that is suitable. Equal where the module is calibrated."""


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
        states: number of fresh states.
        threshold: least probability of a suitable pair; 0.8 in the paper.
        candidates: instructions drawn for each state.
        choose: ``random`` or ``best``.
        pairs_per_state: random pairs of each state for precision and recall; 0 for none.
        seed: of the states and the choices.
        stream: ``evaluation`` for results, ``validation`` for choices.
        tile_size: pixels along one side of a cell.
        batch_size: states examined together.
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
    examiner = _Examiner(
        classifier, task, pool, seed, stream, tile_size, max_steps, **scene_options
    )
    chosen, verdicts, pairs = [], [], []
    servable: list[bool] = []
    for numbers in torch.arange(states).split(batch_size):
        state, pixels = examiner.fresh(numbers)
        checked = examiner.choices(
            state, pixels, threshold=threshold, candidates=candidates, choose=choose
        )
        chosen.append(checked.chosen.cpu())
        verdicts.append(checked.verdict.cpu())
        if left := SERVABLE_STATES - len(servable):
            servable += examiner.servable(state[:left])
        if pairs_per_state:
            pairs.append(examiner.random_pairs(state, pixels, pairs_per_state))
    index, found = torch.cat(chosen), torch.cat(verdicts)
    served = found != NOT_SERVED
    n_served, n_suitable = int(served.sum()), int((found == 0).sum())
    return SuitabilityResult(
        rate=wilson(n_suitable, n_served),
        served=wilson(n_served, states),
        servable=wilson(sum(servable), len(servable)),
        errors={REASONS[kind]: int((found == kind).sum()) for kind in range(1, len(REASONS))},
        entropy=_entropy_bits(examiner.goal_numbers[index[served]]),
        most_entropy=_entropy_bits(examiner.goal_numbers.unique()),
        **_threshold_quality(pairs, threshold),
    )


def checked_choices(
    classifier: TensorDictModuleBase,
    task: str,
    pool: Tensor | Sequence[str],
    *,
    states: int,
    threshold: float = 0.8,
    candidates: int = 64,
    choose: str = "random",
    **options: Any,
) -> CheckedChoices:
    """Return what is chosen for a few fresh states; arguments as :func:`suitable_rate`."""
    examiner = _Examiner(classifier, task, pool, **options)
    fresh = examiner.fresh(torch.arange(at_least_one("states", states)))
    return examiner.choices(*fresh, threshold=threshold, candidates=candidates, choose=choose)


class _Examiner:
    """Lets a classifier choose for fresh states, and asks the oracle."""

    def __init__(
        self,
        classifier: TensorDictModuleBase,
        task: str,
        pool: Tensor | Sequence[str],
        seed: int = 0,
        stream: str = "evaluation",
        tile_size: int = 8,
        max_steps: int = MAX_STEPS,
        **scene_options: Any,
    ) -> None:
        self.device, self.tile_size, self.max_steps = device_of(classifier), tile_size, max_steps
        tokens, goals = read_pool(task, pool)
        self.goals = goals.to(self.device)
        fields = torch.stack([getattr(goals, name) for name in FIELDS], dim=-1)
        self.goal_numbers = fields.unique(dim=0, return_inverse=True)[1]
        """Equal goals of the pool share a number, int64 [N], on the CPU."""
        self.scorer = PoolScorer(classifier, tokens.to(self.device))
        self.draw = generator(seed, "suitability", stream)
        options = SceneOptions(
            task=task, instructed=False, stream=stream, max_steps=max_steps, **scene_options
        )
        self.scenes = SceneStream(options, seed, self.device)

    def fresh(self, numbers: Tensor) -> tuple[WorldState, Tensor]:
        """Return states without instructions, by their numbers [B], and their pictures."""
        state = self.scenes.scenes(numbers.to(self.device)).state
        return state, render(state, self.tile_size)

    def choices(self, state: WorldState, pixels: Tensor, **options: Any) -> CheckedChoices:
        """Let the classifier choose."""
        index, score = self.scorer.choose(pixels, generator=self.draw, **options)
        found = verdict(state, self.goals[index.clamp_min(0)], self.max_steps)
        return CheckedChoices(state, index, score, torch.where(index < 0, NOT_SERVED, found))

    def servable(self, state: WorldState) -> list[bool]:
        """Say for each state [B] whether any goal of the pool suits it."""
        rows = {number: row for row, number in enumerate(self.goal_numbers.tolist())}
        found = torch.zeros(len(state), dtype=torch.bool, device=self.device)
        for row in rows.values():
            goal = self.goals[row : row + 1].expand(len(state))
            found |= verdict(state, goal, self.max_steps) == 0
        return found.tolist()

    def random_pairs(
        self, state: WorldState, pixels: Tensor, per_state: int
    ) -> tuple[Tensor, Tensor]:
        """Return logits [B, K] of random pairs, and whether they are suitable, bool [B, K]."""
        index = torch.randint(len(self.goals), (len(pixels), per_state), generator=self.draw)
        index = index.to(self.device)
        truth = [
            verdict(state, self.goals[column], self.max_steps) == 0 for column in index.unbind(1)
        ]
        logits = self.scorer.score(self.scorer.encode(pixels), index)
        return logits.cpu(), torch.stack(truth, 1).cpu()


def read_pool(task: str, pool: Tensor | Sequence[str]) -> tuple[Tensor, Goal]:
    """Return the tokens, int64 [N, 16], and the goals [N] of a pool of instructions."""
    tokens = pool if isinstance(pool, Tensor) else VOCABULARY.encode(list(pool))
    if not len(tokens):
        raise UserError("pool is empty: pass at least one instruction")
    tokens = tokens.to("cpu", torch.int64)
    return tokens, grammar(task).parse_tokens(tokens)


def _entropy_bits(values: Tensor) -> float:
    """Return the entropy of the distribution of values, in bits."""
    counts = values.unique(return_counts=True)[1]
    return float(scipy_stats.entropy(counts, base=2)) if len(counts) else 0.0


def _threshold_quality(pairs: list[tuple[Tensor, Tensor]], threshold: float) -> dict[str, Any]:
    logits = torch.cat([logit for logit, _ in pairs]) if pairs else torch.zeros(0, 1)
    truth = torch.cat([suits for _, suits in pairs]) if pairs else torch.zeros(0, 1).bool()
    above = logits.sigmoid() > threshold
    hits = int((above & truth).sum())
    group = torch.arange(len(logits)).unsqueeze(1).expand_as(logits)
    return {
        "precision": wilson(hits, int(above.sum())),
        "recall": wilson(hits, int(truth.sum())),
        "base_rate": wilson(int(truth.sum()), truth.numel()),
        "auc": auc(logits.numpy(), truth.numpy(), group.numpy()),
        "reliability": reliability(logits.sigmoid().numpy(), truth.numpy()),
    }
