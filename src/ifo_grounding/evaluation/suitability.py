"""Whether the instruction module chooses instructions that suit a state (paper, Table 3)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from ifo_grounding.errors import UserError, at_least_one, whole
from ifo_grounding.evaluation.scenes import MAX_STEPS, device_of
from ifo_grounding.seeding import generator
from ifo_grounding.stats import Estimate, Rate, auc, reliability, wilson
from ifo_grounding.tasks.goals import REASONS, Goal, verdict
from ifo_grounding.tasks.grammar import FIELDS, grammar
from ifo_grounding.tasks.scenes import SceneOptions
from ifo_grounding.tasks.streams import SceneStream
from ifo_grounding.tasks.vocabulary import VOCABULARY
from ifo_grounding.transforms.choosing import PoolScorer, choose_instructions
from ifo_grounding.world import WorldState, render

NOT_SERVED = -1
SERVABLE_STATES = 500
"""States whose whole pool the oracle judges."""


class Judged(NamedTuple):
    """What was chosen for some states, and the oracle's verdict."""

    state: WorldState
    """The states, [B]."""
    chosen: Tensor
    """Index of the chosen instruction in the pool, int64 [B]; -1 where none was above threshold."""
    score: Tensor
    """Its probability of being suitable, float32 [B]."""
    verdict: Tensor
    """Index into :data:`~ifo_grounding.tasks.REASONS`, int64 [B]; -1 where none was chosen."""


@dataclass(frozen=True)
class SuitabilityResult:
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

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        names = ("rate", "served", "servable", "precision", "recall", "base_rate", "auc")
        intervals = {name: getattr(self, name).as_dict() for name in names}
        bits = {"entropy": self.entropy, "most_entropy": self.most_entropy}
        bins = [[said, rate.as_dict()] for said, rate in self.reliability]
        return {**intervals, **bits, "reliability": bins, "errors": dict(self.errors)}

    def __str__(self) -> str:
        """Return the suitable rate with its interval."""
        return str(self.rate)


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
    """Let the instruction module choose for fresh simulator states, and judge it by the oracle.

    Choices are made by :func:`~ifo_grounding.transforms.choose_instructions`, as in
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
        batch_size: states judged together.
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
    tokens, goals = read_pool(task, pool)
    device = device_of(classifier)
    scorer = PoolScorer(classifier, tokens.to(device))
    draw = generator(seed, "suitability", stream)
    chosen, verdicts, pairs = [], [], []
    servable: list[bool] = []
    for state, pixels in _fresh_states(
        task, states, seed, stream, tile_size, batch_size, device, max_steps, scene_options
    ):
        index, score = choose_instructions(
            scorer,
            None,
            pixels,
            threshold=threshold,
            candidates=candidates,
            choose=choose,
            generator=draw,
        )
        judged = _judge(state, index, score, goals, max_steps)
        if left := SERVABLE_STATES - len(servable):
            servable += _servable(state[:left], goals, max_steps)
        chosen.append(judged.chosen.cpu())
        verdicts.append(judged.verdict.cpu())
        if pairs_per_state:
            random = torch.randint(len(tokens), (len(pixels), pairs_per_state), generator=draw)
            pairs.append(_score_pairs(scorer, state, pixels, random.to(device), goals, max_steps))
    index, found = torch.cat(chosen), torch.cat(verdicts)
    served = found != NOT_SERVED
    n_served, n_suitable = int(served.sum()), int((found == 0).sum())
    return SuitabilityResult(
        rate=wilson(n_suitable, n_served),
        served=wilson(n_served, states),
        servable=wilson(sum(servable), len(servable)),
        errors={REASONS[kind]: int((found == kind).sum()) for kind in range(1, len(REASONS))},
        entropy=entropy_bits(_goal_numbers(goals)[index[served]]),
        most_entropy=entropy_bits(_goal_numbers(goals).unique()),
        **_threshold_quality(pairs, threshold),
    )


def judged_choices(
    classifier: TensorDictModuleBase,
    task: str,
    pool: Tensor | Sequence[str],
    *,
    states: int,
    threshold: float = 0.8,
    candidates: int = 64,
    choose: str = "random",
    seed: int = 0,
    stream: str = "evaluation",
    tile_size: int = 8,
    max_steps: int = MAX_STEPS,
    **scene_options: Any,
) -> Judged:
    """Return what is chosen for a few fresh states; arguments as :func:`suitable_rate`."""
    tokens, goals = read_pool(task, pool)
    device = device_of(classifier)
    scorer = PoolScorer(classifier, tokens.to(device))
    state, pixels = next(
        _fresh_states(
            task, states, seed, stream, tile_size, states, device, max_steps, scene_options
        )
    )
    index, score = choose_instructions(
        scorer,
        None,
        pixels,
        threshold=threshold,
        candidates=candidates,
        choose=choose,
        generator=generator(seed, "suitability", stream),
    )
    return _judge(state, index, score, goals, max_steps)


def read_pool(task: str, pool: Tensor | Sequence[str]) -> tuple[Tensor, Goal]:
    """Return the tokens, int64 [N, 16], and the goals [N] of a pool of instructions."""
    tokens = pool if isinstance(pool, Tensor) else VOCABULARY.encode(list(pool))
    if not len(tokens):
        raise UserError("pool is empty: pass at least one instruction")
    tokens = tokens.to("cpu", torch.int64)
    return tokens, grammar(task).parse_tokens(tokens)


def entropy_bits(values: Tensor) -> float:
    """Return the entropy of the distribution of values, in bits.

    >>> entropy_bits(torch.tensor([3, 3, 7, 9]))
    1.5
    """
    if not len(values):
        return 0.0
    share = values.unique(return_counts=True)[1].double() / len(values)
    return abs(float(-(share * share.log2()).sum()))


def _fresh_states(
    task: str,
    states: int,
    seed: int,
    stream: str,
    tile_size: int,
    batch_size: int,
    device: torch.device,
    max_steps: int,
    scene_options: dict[str, Any],
) -> Iterator[tuple[WorldState, Tensor]]:
    """Yield states without instructions, in batches, with their pictures."""
    options = SceneOptions(
        task=task, instructed=False, stream=stream, max_steps=max_steps, **scene_options
    )
    scenes = SceneStream(options, seed, device)
    states, batch_size = at_least_one("states", states), at_least_one("batch_size", batch_size)
    for numbers in torch.arange(states, device=device).split(batch_size):
        state = scenes.scenes(numbers).state
        yield state, render(state, tile_size)


def _judge(state: WorldState, index: Tensor, score: Tensor, goals: Goal, max_steps: int) -> Judged:
    goals = goals.to(index.device)
    found = verdict(state, goals[index.clamp_min(0)], max_steps)
    return Judged(state, index, score, torch.where(index < 0, NOT_SERVED, found))


def _servable(state: WorldState, goals: Goal, max_steps: int) -> list[bool]:
    """Say for each state [B] whether any goal of the pool suits it."""
    numbers = _goal_numbers(goals)
    rows = torch.arange(len(numbers), device=numbers.device)
    distinct = rows.new_zeros(int(numbers.max()) + 1).scatter_(0, numbers, rows)
    found = torch.zeros(len(state), dtype=torch.bool, device=state.arm.device)
    for row in distinct.tolist():
        goal = goals[row : row + 1].to(found.device).expand(len(state))
        found |= verdict(state, goal, max_steps) == 0
    return found.tolist()


def _score_pairs(
    scorer: PoolScorer,
    state: WorldState,
    pixels: Tensor,
    index: Tensor,
    goals: Goal,
    max_steps: int,
) -> tuple[Tensor, Tensor]:
    """Logits [B, K] of random pairs, and whether they are suitable, bool [B, K]."""
    goals = goals.to(index.device)
    truth = [verdict(state, goals[column], max_steps) == 0 for column in index.unbind(1)]
    return scorer.score(scorer.encode(pixels), index).cpu(), torch.stack(truth, 1).cpu()


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
        "auc": auc(
            logits[truth].numpy(),
            logits[~truth].numpy(),
            positive_groups=group[truth].numpy(),
            negative_groups=group[~truth].numpy(),
        ),
        "reliability": reliability(logits.sigmoid().numpy(), truth.numpy()),
    }


def _goal_numbers(goals: Goal) -> Tensor:
    """Number goals so that equal ones share a number, int64 [N]."""
    fields = torch.stack([getattr(goals, name) for name in FIELDS], dim=-1)
    return fields.unique(dim=0, return_inverse=True)[1]
