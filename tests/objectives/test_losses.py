"""Values worked out by hand, from networks that answer what they are told."""

import math
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torch.distributions import Categorical
from torchrl.modules import OneHotCategorical, ProbabilisticActor

from ifo_grounding.errors import UserError
from ifo_grounding.networks import grounding
from ifo_grounding.objectives import (
    GoalLoss,
    ImitationLoss,
    InstructionLoss,
    InverseLoss,
    RewardLoss,
)
from objectives.conftest import POOL, batch, make_loss, seeded, total

LOGITS = torch.log(torch.tensor([[0.5, 0.25, 0.25], [0.1, 0.1, 0.8]]))


def logit(probability: float) -> float:
    return math.log(probability / (1 - probability))


class Answer(nn.Module):
    """Says what it was built with, whatever it is asked."""

    def __init__(self, answer: torch.Tensor) -> None:
        super().__init__()
        self.answer = nn.Parameter(answer)

    def forward(self, *inputs: torch.Tensor) -> torch.Tensor:
        return self.answer


def actor(logits, distribution=Categorical):
    return ProbabilisticActor(
        TensorDictModule(Answer(logits), in_keys=["pixels"], out_keys=["logits"]),
        in_keys=["logits"],
        distribution_class=distribution,
        return_log_prob=True,
    )


def labelled(actions) -> TensorDict:
    return TensorDict({"pixels": torch.zeros(2, 1), "action": torch.tensor(actions)}, [2])


TWO = torch.tensor([[1, 0], [2, 0]])
"""A pool of two instructions: each is the other's only negative."""
BOTH = TensorDict({"pixels": torch.zeros(2, 1), "instruction": TWO}, [2])
"""A scene of each."""
POSITIVES = -(math.log(0.9) + math.log(0.6)) / 2
"""Their cross entropy, where one is suitable with probability 0.9, the other with 0.6."""
NEGATIVES = -(math.log(0.1) + math.log(0.4)) / 2
ODDS = 9.0, 1.5
"""Of 0.9 and 0.6."""


def test_inverse_and_imitation_loss_by_hand_and_one_hot_is_never_confused_with_categorical():
    network = TensorDictModule(Answer(LOGITS), in_keys=["pixels"], out_keys=["guess"])
    one_hot, hot = torch.tensor([[0, 1, 0], [0, 0, 1]]), actor(LOGITS, OneHotCategorical)
    first = 0.5 * math.log(2) + 0.5 * math.log(4)
    second = 0.2 * math.log(10) + 0.8 * math.log(1.25)
    inverse = InverseLoss(network)(labelled([1, 2]))
    imitation = ImitationLoss(actor(LOGITS))(labelled([1, 2]))
    assert float(imitation["entropy"]) == pytest.approx((first + second) / 2)
    of_hot = ImitationLoss(hot)(labelled([1, 2]).set("action", one_hot))
    for out, name in ((inverse, "inverse"), (imitation, "imitation"), (of_hot, "imitation")):
        expected = -(math.log(0.25) + math.log(0.8)) / 2
        assert out[f"loss_{name}"].item() == pytest.approx(expected)
        assert float(out["accuracy"]) == 0.5
    for loss in (ImitationLoss(actor(LOGITS)), InverseLoss(actor(LOGITS).module[0])):
        for wrong in (one_hot, torch.tensor([[1], [2]])):
            with pytest.raises(UserError, match="actions must have shape"):
                loss(labelled([1, 2]).set("action", wrong))
    with pytest.raises(UserError, match="actions must have shape"):
        ImitationLoss(hot)(labelled([1, 2]))


class Suitability(nn.Module):
    """The logit of an instruction is a table's entry for its first word."""

    def __init__(self, table: torch.Tensor) -> None:
        super().__init__()
        self.table = nn.Parameter(table)

    def forward(self, pixels: torch.Tensor, instruction: torch.Tensor) -> torch.Tensor:
        return self.table[instruction[..., :1]]


def suitability(probabilities, written="suitability") -> TensorDictModule:
    table = torch.tensor([0.0, *map(logit, probabilities)])
    return TensorDictModule(Suitability(table), ["pixels", "instruction"], [written])


def suitable(**options):
    """Losses of suitable pairs, and its metrics, where instructions are as likely as above."""
    options = {"negatives": 1, "removal_rate": 0.0, **options}
    return InstructionLoss(suitability([0.9, 0.6]), TWO, **options)(BOTH)


def test_instruction_loss_by_hand():
    out = suitable(negatives=4)
    assert out["loss_instruction"].item() == pytest.approx((POSITIVES + NEGATIVES) / 2, rel=1e-5)
    assert float(out["positive_probability"]) == pytest.approx(0.75)
    assert float(out["negative_probability"]) == pytest.approx(0.75)
    assert float(out["removed"]) == 0


def test_the_contrast_is_the_cross_entropy_of_the_own_instruction_by_hand():
    first, second = math.log(1 + ODDS[1] / ODDS[0]), math.log(1 + ODDS[0] / ODDS[1])
    added = suitable(contrast=2.0)["loss_instruction"] - suitable()["loss_instruction"]
    assert added.item() == pytest.approx(2.0 * (first + second) / 2, rel=1e-5)
    # Negatives that are removed take no part: the first scene's own is the likeliest one.
    half, rest = (suitable(removal_rate=0.5, contrast=weight) for weight in (1.0, 0.0))
    added = half["loss_instruction"] - rest["loss_instruction"]
    assert added.item() == pytest.approx(first / 2, rel=1e-5)


def test_an_instruction_is_told_apart_from_itself_in_fresh_states_by_hand():
    options = {"states": torch.zeros(3, 1, 1, 1, dtype=torch.uint8), "fresh": 2}
    out = suitable(**options)
    # Each has three negatives: the other instruction here, and itself elsewhere, twice.
    assert out["loss_instruction"].item() == pytest.approx((POSITIVES + NEGATIVES) / 2, rel=1e-5)
    here = (math.log(1 + ODDS[1] / ODDS[0]) + math.log(1 + ODDS[0] / ODDS[1])) / 2
    added = suitable(contrast=1.0, **options)["loss_instruction"] - out["loss_instruction"]
    assert added.item() == pytest.approx(here + math.log(3), rel=1e-5)


def test_pairs_with_fresh_states_are_scored_as_any_pairs(preset):
    states = torch.randint(256, (5, 3, 24, 24), dtype=torch.uint8)
    loss = make_loss("instruction", preset, states=states, fresh=4).eval()
    data = batch()
    torch.manual_seed(1)
    scores = loss._elsewhere(data)
    torch.manual_seed(1)
    drawn = torch.randint(5, (4,))
    rows = torch.cartesian_prod(torch.arange(12), drawn)
    pairs = {"pixels": states[rows[:, 1]], "instruction": data["instruction"][rows[:, 0]]}
    expected = loss.network(TensorDict(pairs, [48]))["suitability"].view(12, 4)
    torch.testing.assert_close(scores, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("swap", [False, True])
def test_words_are_swapped_only_where_the_instruction_classifier_asks_for_it(swap, monkeypatch):
    monkeypatch.setattr(grounding, "NOISE", 0.0)
    loss = make_loss("instruction", "strong", swap_words=swap)
    words = next(part for part in loss.modules() if isinstance(part, grounding.WordMaps)).train()
    tokens = POOL[torch.arange(8) % 4]
    with torch.no_grad():
        heard = [words.roles(tokens)[0] for _ in range(2)]
    assert torch.equal(*heard) != swap


def test_the_likeliest_negatives_are_removed_after_the_warm_up():
    loss = InstructionLoss(suitability([0.9, 0.6]), TWO, negatives=4, removal_rate=0.5)
    loss.set_progress(0.3)
    assert float(loss(BOTH)["removed"]) == 0
    loss.set_progress(1 / 3)
    out = loss(BOTH)
    # the half that scores 0.9 goes: what is left is 0.6 against scene 1
    expected = (POSITIVES - math.log(0.4)) / 2
    assert float(out["removed"]) == 0.5
    assert out["loss_instruction"].item() == pytest.approx(expected, rel=1e-5)
    out["loss_instruction"].backward()
    grad = loss.network.module.table.grad
    # 0.9 is pulled up as a positive alone; 0.6 up as a positive and down as a negative
    assert float(grad[1]) == pytest.approx(-(1 - 0.9) / 4, rel=1e-4)
    assert float(grad[2]) == pytest.approx(-(1 - 0.6) / 4 + 0.6 / 2, rel=1e-4)


def test_a_mixture_drops_nothing_however_many_are_suitable():
    mixture = suitable(removal_rate=0.5, unlabelled="mixture")
    assert torch.equal(mixture["loss_instruction"], suitable()["loss_instruction"])
    assert float(mixture["removed"]) == 0


def scores(table, all_actions=True) -> TensorDictModule:
    """A reward model that gives row by row the logits of a table, one action each or all."""

    class Scores(nn.Module):
        def forward(self, pixels, action):
            return torch.tensor(table).gather(-1, action.unsqueeze(-1))

    scored = Scores()
    if all_actions:
        scored.all_actions = lambda pixels: torch.tensor(table)[: len(pixels)]
    return TensorDictModule(scored, in_keys=["pixels", "action"], out_keys=["score"])


@pytest.mark.parametrize("given", ["all_actions", "whole"])
def test_reward_loss_by_hand(given):
    right, wrong = 0.8, 0.3
    table = [[logit(right), logit(wrong)], [logit(wrong), logit(right)]]
    out = RewardLoss(scores(table, given == "all_actions"), n_actions=2)(labelled([0, 1]))
    expected = -(math.log(0.8) + math.log(0.7)) / 2
    assert out["loss_reward"].item() == pytest.approx(expected, rel=1e-5)
    assert float(out["positive_probability"]) == pytest.approx(right)
    assert float(out["negative_probability"]) == pytest.approx(wrong)


def test_adversarial_reward_loss_by_hand():
    loss = RewardLoss(scores([[logit(0.8), logit(0.3)]] * 2), n_actions=2)
    demonstrations = labelled([0, 1])
    out = loss.adversarial(demonstrations, demonstrations[:1])
    positives = -(0.9 * math.log(0.8) + 0.1 * math.log(0.2) + 0.9 * math.log(0.3)) / 2
    positives -= 0.1 * math.log(0.7) / 2
    negatives = -(0.1 * math.log(0.8) + 0.9 * math.log(0.2))
    assert out["loss_reward"].item() == pytest.approx((positives + negatives) / 2, rel=1e-5)
    assert float(out["positive_probability"]) == pytest.approx(0.55)
    assert float(out["negative_probability"]) == pytest.approx(0.8)


@pytest.mark.parametrize("kind", ["reward", "imitation", "inverse"])
@pytest.mark.parametrize("action", [-1, 6, 0.5])
def test_other_actions_than_the_networks_are_refused(kind, action):
    data = batch().set("action", torch.full((12,), action))
    with pytest.raises(UserError, match=r"action.* (hold .*: allowed are|whole numbers) 0..5"):
        make_loss(kind)(data)


def test_goal_loss_by_hand():
    data = BOTH[[0, 0, 1]].set("final", torch.tensor([[True], [False], [False]]))
    out = GoalLoss(suitability([0.9, 0.6], "goal_score"), TWO)(data)
    finished, elsewhere = -math.log(0.9), -math.log(0.4)
    expected = (finished + (NEGATIVES + elsewhere) / 2) / 2
    assert out["loss_goal"].item() == pytest.approx(expected, rel=1e-5)
    assert float(out["final_probability"]) == pytest.approx(0.9)
    assert float(out["unfinished_probability"]) == pytest.approx(0.75)
    assert float(out["negative_probability"]) == pytest.approx(0.6)


@pytest.mark.parametrize("final", [True, False])
def test_a_batch_without_one_class_still_has_a_finite_loss(final):
    loss = make_loss("goal")
    out = loss(batch().set("final", torch.full((12, 1), final)))
    assert out["loss_goal"].isfinite()
    out["loss_goal"].backward()


@pytest.mark.parametrize("after", [False, True])
def test_policies_may_be_parts_of_a_sequence(after):
    head = actor(LOGITS)
    parts = [TensorDictModule(nn.Identity(), ["camera"], ["pixels"]), head]
    if after:
        parts.append(TensorDictModule(nn.Identity(), ["action"], ["shown"]))
    data = labelled([1, 2]).rename_key_("pixels", "camera")
    losses = ImitationLoss(TensorDictSequential(*parts))(data)
    assert losses["loss_imitation"] == ImitationLoss(head)(labelled([1, 2]))["loss_imitation"]


def watched(share, *preset, **options):
    """A loss of suitable pairs that has seen a share of the negatives score as positives do."""
    loss = make_loss("instruction", *preset, removal_rate=None, **options)
    ones = round(1000 * share)
    loss.negatives.watch(torch.ones(1000), torch.cat([torch.ones(ones), -torch.ones(1000 - ones)]))
    return loss


def test_calibration_turns_balanced_odds_into_those_of_random_pairs():
    loss, data = watched(0.25), batch().select("pixels", "instruction")
    before = loss.network(data.copy())["suitability"]
    assert loss.calibrate() == pytest.approx(0.25)
    after = loss.network(data.copy())["suitability"]
    torch.testing.assert_close(after, before - math.log(3))
    with pytest.raises(UserError, match="removal_rate=None"):
        make_loss("instruction", removal_rate=0.3).calibrate()


def test_negatives_that_were_not_removed_count_as_the_mixture_that_they_are(preset):
    pool = torch.cartesian_prod(*[torch.arange(1, 11)] * 2).repeat(1, 2)
    loss, data = watched(0.02, preset, pool=pool), batch().select("pixels", "instruction")
    before = loss.network(data.copy())["suitability"]
    assert loss.calibrate() == pytest.approx(0.02)
    after = loss.network(data.copy())["suitability"].sigmoid()
    torch.testing.assert_close(after, 0.02 * before.exp())
    # What is 50 times as frequent among positives as in the mixture is surely suitable, and what
    # is estimated to be even more frequent comes after it.
    network = loss.network.module
    odds = torch.tensor([0.0, 25.0, 49.0, 50.0, 100.0, 1000.0]).log()
    sure = network._expected(odds).sigmoid()
    assert sure[:3].tolist() == pytest.approx([0.0, 0.5, 0.98], abs=1e-4)
    assert (sure.diff() > 0).all() and sure[-1] < 1


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_training_goes_on_after_calibration_as_if_there_had_been_none(share):
    loss, data = watched(share), batch()
    network, before = loss.network, seeded(loss.eval(), data)
    likely = network(data.copy())["suitability"]
    loss.calibrate()
    calibrated = network(data.copy())["suitability"]
    assert (calibrated - likely).abs().min() > 0.1
    torch.testing.assert_close(seeded(loss, data).to_dict(), before.to_dict(), atol=0, rtol=0)
    assert torch.equal(network(data.copy())["suitability"], calibrated)


@pytest.mark.parametrize(
    ("options", "random"),
    [({}, 2), ({"states": torch.zeros(3, 3, 24, 24, dtype=torch.uint8), "fresh": 2}, 4)],
)
def test_the_share_of_suitable_pairs_comes_from_random_ones_alone(options, random):
    loss, seen = make_loss("instruction", negatives=3, near=0.5, removal_rate=None, **options), []
    loss.negatives.estimate.add = lambda own, other: seen.append((len(own), other.shape[-1]))
    loss.negatives.estimate.ratio = 100
    loss(batch())
    assert seen == [(12, random)]


def test_adversarial_training_leaves_out_padding():
    loss = make_loss("reward")
    steps, others = batch((4, 3)), batch((2, 3), seed=1)
    real = torch.tensor([[1, 1, 1], [1, 0, 0]]).bool()
    padded = others.clone().set(("collector", "mask"), real)
    out, expected = loss.eval().adversarial(steps, padded), loss.adversarial(steps, others[real])
    torch.testing.assert_close(out.to_dict(), expected.to_dict())
    assert out["negative_probability"] != loss.adversarial(steps, others)["negative_probability"]


class Both(nn.Module):
    """A feature of each input, its mean."""

    def forward(self, *inputs: torch.Tensor) -> torch.Tensor:
        return torch.stack([each.float().reshape(len(each), -1).mean(1) for each in inputs], -1)


@pytest.mark.parametrize(
    ("kind", "reads", "written", "count"),
    [
        (InverseLoss, ["pixels", ("next", "pixels")], "logits", 6),
        (partial(InstructionLoss, pool=POOL), ["pixels", "instruction"], "suitability", 1),
        (partial(RewardLoss, n_actions=6), ["pixels", "instruction", "action"], "action_score", 1),
        (partial(GoalLoss, pool=POOL), ["pixels", "instruction"], "goal_score", 1),
    ],
)
def test_the_output_learns_that_is_named_as_asked(kind, reads, written, count):
    data = batch()
    head = nn.Linear(len(reads), count)
    features = TensorDictModule(Both(), reads, ["features"])
    named, other = (TensorDictModule(head, ["features"], [name]) for name in (written, "answer"))
    total(kind(TensorDictSequential(features, named))(data)).backward()
    assert head.weight.grad.abs().sum() > 0
    with pytest.raises(UserError, match=f"one of them must be named '{written}'"):
        kind(TensorDictSequential(features, other))


def test_networks_and_pools_that_do_not_fit_are_refused():
    logits = TensorDictModule(Answer(LOGITS), in_keys=["pixels"], out_keys=["logits"])
    for network in (logits, TensorDictSequential(logits)):
        with pytest.raises(UserError, match=r"policies with get_dist, .* got TensorDict"):
            ImitationLoss(network)
    loss = InstructionLoss(suitability([0.9, 0.6]), TWO)  # cannot be told how rare they are
    with pytest.raises(UserError, match=r"Suitability has no method expect\(share, mixed\)"):
        loss.calibrate()
    loss = make_loss("instruction", pool=POOL[:, :-1])
    with pytest.raises(UserError, match="one vocabulary"):
        loss(batch())
    with pytest.raises(UserError, match="give n_actions="):
        RewardLoss(TensorDictModule(Both(), ["pixels", "action"], ["action_score"]))
