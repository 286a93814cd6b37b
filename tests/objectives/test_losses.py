"""Values worked out by hand, from networks that answer what they are told."""

import copy
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
from ifo_grounding.networks import (
    Shapes,
    WordMaps,
    grounding,
    make_instruction_classifier,
    make_policy,
)
from ifo_grounding.objectives import (
    GoalLoss,
    ImitationLoss,
    InstructionLoss,
    InverseLoss,
    RewardLoss,
)
from objectives.conftest import POOL, batch, make_loss

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


def test_inverse_loss_by_hand():
    network = TensorDictModule(Answer(LOGITS), in_keys=["pixels"], out_keys=["guess"])
    out = InverseLoss(network)(labelled([1, 2]))
    assert out["loss_inverse"].item() == pytest.approx(-(math.log(0.25) + math.log(0.8)) / 2)
    assert float(out["accuracy"]) == 0.5


def test_imitation_loss_by_hand():
    out = ImitationLoss(actor(LOGITS))(labelled([1, 2]))
    assert out["loss_imitation"].item() == pytest.approx(-(math.log(0.25) + math.log(0.8)) / 2)
    assert float(out["accuracy"]) == 0.5
    first = 0.5 * math.log(2) + 0.5 * math.log(4)
    second = 0.2 * math.log(10) + 0.8 * math.log(1.25)
    assert float(out["entropy"]) == pytest.approx((first + second) / 2)


def test_one_hot_and_categorical_are_never_confused():
    one_hot = torch.tensor([[0, 1, 0], [0, 0, 1]])
    hot = actor(LOGITS, OneHotCategorical)
    out = ImitationLoss(hot)(labelled([1, 2]).set("action", one_hot))
    assert out["loss_imitation"].item() == pytest.approx(-(math.log(0.25) + math.log(0.8)) / 2)
    assert float(out["accuracy"]) == 0.5
    for loss in (ImitationLoss(actor(LOGITS)), InverseLoss(actor(LOGITS).module[0])):
        for wrong in (one_hot, torch.tensor([[1], [2]])):
            with pytest.raises(UserError, match="actions must have shape"):
                loss(labelled([1, 2]).set("action", wrong))
        with pytest.raises(UserError, match=r"action 3 is none of the network's 0\.\.2"):
            loss(labelled([1, 3]))
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
    return TensorDictModule(
        Suitability(table), in_keys=["pixels", "instruction"], out_keys=[written]
    )


def test_instruction_loss_by_hand():
    pool = torch.tensor([[1, 0], [2, 0]])
    data = TensorDict({"pixels": torch.zeros(2, 1), "instruction": pool}, [2])
    loss = InstructionLoss(suitability([0.9, 0.6]), pool, negatives=4, removal_rate=0.0)
    out = loss(data)
    # each scene's only negative is the other's instruction
    positives = -(math.log(0.9) + math.log(0.6)) / 2
    negatives = -(math.log(0.1) + math.log(0.4)) / 2
    assert out["loss_instruction"].item() == pytest.approx((positives + negatives) / 2, rel=1e-5)
    assert float(out["positive_probability"]) == pytest.approx(0.75)
    assert float(out["negative_probability"]) == pytest.approx(0.75)
    assert float(out["removed"]) == 0


def test_the_contrast_is_the_cross_entropy_of_the_own_instruction_by_hand():
    pool = torch.tensor([[1, 0], [2, 0]])
    data = TensorDict({"pixels": torch.zeros(2, 1), "instruction": pool}, [2])
    network = suitability([0.9, 0.6])
    plain = InstructionLoss(network, pool, negatives=1, removal_rate=0.0)
    contrasted = InstructionLoss(network, pool, negatives=1, removal_rate=0.0, contrast=2.0)
    odds = 9.0, 1.5  # of 0.9 and 0.6; each scene's negative is the other's instruction
    first = -math.log(odds[0] / (odds[0] + odds[1]))
    second = -math.log(odds[1] / (odds[1] + odds[0]))
    added = contrasted(data)["loss_instruction"] - plain(data)["loss_instruction"]
    assert added.item() == pytest.approx(2.0 * (first + second) / 2, rel=1e-5)
    # Negatives that are removed take no part: the first scene's own is the likeliest one.
    half = InstructionLoss(network, pool, negatives=1, removal_rate=0.5, contrast=1.0)
    rest = InstructionLoss(network, pool, negatives=1, removal_rate=0.5)
    added = half(data)["loss_instruction"] - rest(data)["loss_instruction"]
    assert added.item() == pytest.approx(first / 2, rel=1e-5)


def test_an_instruction_is_told_apart_from_itself_in_fresh_states_by_hand():
    pool = torch.tensor([[1, 0], [2, 0]])
    data = TensorDict({"pixels": torch.zeros(2, 1), "instruction": pool}, [2])
    states = torch.zeros(3, 1, 1, 1, dtype=torch.uint8)
    options = {"negatives": 1, "removal_rate": 0.0, "states": states, "fresh": 2}
    network = suitability([0.9, 0.6])  # whatever the image
    out = InstructionLoss(network, pool, **options)(data)
    positives = -(math.log(0.9) + math.log(0.6)) / 2
    # Each has three negatives: the other instruction here, and itself elsewhere, twice.
    negatives = -(math.log(0.1) * 3 + math.log(0.4) * 3) / 6
    assert out["loss_instruction"].item() == pytest.approx((positives + negatives) / 2, rel=1e-5)
    contrasted = InstructionLoss(network, pool, contrast=1.0, **options)(data)
    odds = 9.0, 1.5
    here = (math.log(1 + odds[1] / odds[0]) + math.log(1 + odds[0] / odds[1])) / 2
    added = contrasted["loss_instruction"] - out["loss_instruction"]
    assert added.item() == pytest.approx(here + math.log(3), rel=1e-5)


@pytest.mark.parametrize("preset", ["strong", "paper"])
def test_pairs_with_fresh_states_are_scored_as_any_pairs(preset):
    states = torch.randint(256, (5, 3, 24, 24), dtype=torch.uint8)
    source = torch.Generator().manual_seed(1)
    loss = make_loss("instruction", preset, states=states, fresh=4, generator=source).eval()
    data = batch()
    scores = loss._elsewhere(data)
    drawn = torch.randint(5, (4,), generator=torch.Generator().manual_seed(1))
    rows = torch.cartesian_prod(torch.arange(12), drawn)
    pairs = {"pixels": states[rows[:, 1]], "instruction": data["instruction"][rows[:, 0]]}
    expected = loss.network(TensorDict(pairs, [48]))["suitability"].view(12, 4)
    torch.testing.assert_close(scores, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("swap", [False, True])
def test_words_are_swapped_only_where_the_instruction_classifier_asks_for_it(swap, monkeypatch):
    monkeypatch.setattr(grounding, "NOISE", 0.0)
    loss = make_loss("instruction", "strong", swap_words=swap)
    words = next(part for part in loss.modules() if isinstance(part, WordMaps)).train()
    tokens = POOL[torch.arange(8) % 4]
    with torch.no_grad():
        heard = [words.roles(tokens)[0] for _ in range(2)]
    assert torch.equal(*heard) != swap


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"states": torch.zeros(3, 24, 24)}, r"states must be images \[S, C, H, W\]"),
        ({"states": torch.zeros(0, 3, 24, 24)}, r"states must be images"),
        ({"fresh": 0}, "fresh must be at least 1, got 0"),
    ],
)
def test_impossible_fresh_states_are_refused(options, message):
    with pytest.raises(UserError, match=message):
        make_loss("instruction", **options)


def test_the_likeliest_negatives_are_removed_after_the_warm_up():
    pool = torch.tensor([[1, 0], [2, 0]])
    data = TensorDict({"pixels": torch.zeros(2, 1), "instruction": pool}, [2])
    loss = InstructionLoss(suitability([0.9, 0.6]), pool, negatives=4, removal_rate=0.5)
    loss.set_progress(0.3)
    assert float(loss(data)["removed"]) == 0
    loss.set_progress(1 / 3)
    out = loss(data)
    # the half that scores 0.9 goes: what is left is 0.6 against scene 1
    positives = -(math.log(0.9) + math.log(0.6)) / 2
    expected = (positives - math.log(0.4)) / 2
    assert float(out["removed"]) == 0.5
    assert out["loss_instruction"].item() == pytest.approx(expected, rel=1e-5)
    out["loss_instruction"].backward()
    grad = loss.network.module.table.grad
    # 0.9 is pulled up as a positive alone; 0.6 up as a positive and down as a negative
    assert float(grad[1]) == pytest.approx(-(1 - 0.9) / 4, rel=1e-4)
    assert float(grad[2]) == pytest.approx(-(1 - 0.6) / 4 + 0.6 / 2, rel=1e-4)


def test_a_mixture_drops_nothing_however_many_are_suitable():
    pool = torch.tensor([[1, 0], [2, 0]])
    data = TensorDict({"pixels": torch.zeros(2, 1), "instruction": pool}, [2])
    network, losses = suitability([0.9, 0.6]), []
    for options in ({"removal_rate": 0.0}, {"removal_rate": 0.5, "unlabelled": "mixture"}):
        losses.append(InstructionLoss(network, pool, **options)(data))
    assert torch.equal(*(each["loss_instruction"] for each in losses))
    assert float(losses[1]["removed"]) == 0


def test_images_are_encoded_once_whatever_the_number_of_negatives():
    loss = make_loss("instruction", negatives=11)
    rows = []
    loss.network.module.trunk.image.register_forward_hook(
        lambda _, args, out: rows.append(len(out))
    )
    loss(batch((7,)))
    assert rows == [7]


@pytest.mark.parametrize("given", ["all_actions", "whole"])
def test_reward_loss_by_hand(given):
    right, wrong = 0.8, 0.3
    scores = torch.tensor([[logit(right), logit(wrong)], [logit(wrong), logit(right)]])

    class Scores(nn.Module):
        def forward(self, pixels, action):
            return scores.gather(-1, action.unsqueeze(-1))

    scored = Scores()
    if given == "all_actions":
        scored.all_actions = lambda pixels: scores
    network = TensorDictModule(scored, in_keys=["pixels", "action"], out_keys=["score"])
    out = RewardLoss(network, n_actions=2)(labelled([0, 1]))
    expected = -(math.log(0.8) + math.log(0.7)) / 2
    assert out["loss_reward"].item() == pytest.approx(expected, rel=1e-5)
    assert float(out["positive_probability"]) == pytest.approx(right)
    assert float(out["negative_probability"]) == pytest.approx(wrong)


def test_adversarial_reward_loss_by_hand():
    table = torch.tensor([[logit(0.8), logit(0.3)]]).expand(2, -1)

    class Scores(nn.Module):
        def all_actions(self, pixels):
            return table[: len(pixels)]

    network = TensorDictModule(Scores(), in_keys=["pixels", "action"], out_keys=["score"])
    demonstrations = labelled([0, 1])
    policy = TensorDict({"pixels": torch.zeros(1, 1), "action": torch.tensor([0])}, [1])
    out = RewardLoss(network, n_actions=2).adversarial(demonstrations, policy, smoothing=0.1)
    positives = -(0.9 * math.log(0.8) + 0.1 * math.log(0.2) + 0.9 * math.log(0.3)) / 2
    positives -= 0.1 * math.log(0.7) / 2
    negatives = -(0.1 * math.log(0.8) + 0.9 * math.log(0.2))
    assert out["loss_reward"].item() == pytest.approx((positives + negatives) / 2, rel=1e-5)
    assert float(out["positive_probability"]) == pytest.approx(0.55)
    assert float(out["negative_probability"]) == pytest.approx(0.8)


@pytest.mark.parametrize("action", [-1, 6])
def test_other_actions_than_the_networks_are_refused(action):
    for kind in ("reward", "imitation", "inverse"):
        data = batch().set("action", torch.full((12,), action))
        with pytest.raises(UserError, match=f"action {action} is none of the network's 0..5"):
            make_loss(kind)(data)


def test_goal_loss_by_hand():
    pool = torch.tensor([[1, 0], [2, 0]])
    data = TensorDict(
        {
            "pixels": torch.zeros(3, 1),
            "instruction": pool[[0, 0, 1]],
            "final": torch.tensor([[True], [False], [False]]),
        },
        [3],
    )
    out = GoalLoss(suitability([0.9, 0.6], "goal_score"), pool, removal_rate=0.0)(data)
    finished, elsewhere = -math.log(0.9), -math.log(0.4)
    unfinished = -(math.log(0.1) + math.log(0.4)) / 2
    expected = (finished + (unfinished + elsewhere) / 2) / 2
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


def test_what_is_no_policy_is_refused():
    logits = TensorDictModule(Answer(LOGITS), in_keys=["pixels"], out_keys=["logits"])
    for network in (logits, TensorDictSequential(logits)):
        with pytest.raises(UserError, match=r"policies with get_dist, .* got TensorDict"):
            ImitationLoss(network)


def test_calibration_turns_balanced_odds_into_those_of_random_pairs():
    torch.manual_seed(0)
    shapes = Shapes(image_shape=(3, 48, 48), vocabulary_size=40)
    classifier = make_instruction_classifier(shapes, "paper", seed=0)
    pool = torch.arange(1, 13).unsqueeze(1).expand(12, 16)
    loss = InstructionLoss(classifier, pool, removal_rate=None)
    image, words = torch.zeros(2, 3, 48, 48, dtype=torch.uint8), pool[:2]
    before = classifier(pixels=image, instruction=words)
    loss.negatives.watch(torch.ones(1000), torch.cat([torch.ones(250), -torch.ones(750)]))
    assert loss.calibrate() == pytest.approx(0.25)
    after = classifier(pixels=image, instruction=words)
    torch.testing.assert_close(after, before - math.log(3))
    with pytest.raises(UserError, match="removal_rate=None"):
        InstructionLoss(classifier, pool, removal_rate=0.3).calibrate()


@pytest.mark.parametrize("preset", ["paper", "strong"])
def test_negatives_that_were_not_removed_count_as_the_mixture_that_they_are(preset):
    torch.manual_seed(0)
    shapes = Shapes(image_shape=(3, 48, 48), vocabulary_size=40)
    classifier = make_instruction_classifier(shapes, preset, seed=0)
    pool = torch.cartesian_prod(*[torch.arange(1, 11)] * 2).repeat(1, 8)
    loss = InstructionLoss(classifier, pool, removal_rate=None)
    loss.negatives.watch(torch.ones(1000), torch.cat([torch.ones(20), -torch.ones(980)]))
    image, words = torch.zeros(100, 3, 48, 48, dtype=torch.uint8), pool
    before = classifier(pixels=image, instruction=words)
    assert loss.calibrate() == pytest.approx(0.02)
    after = classifier(pixels=image, instruction=words).sigmoid()
    torch.testing.assert_close(after, 0.02 * before.exp())
    # What is 50 times as frequent among positives as in the mixture is surely suitable, and what
    # is estimated to be even more frequent comes after it.
    network = classifier.module
    odds = torch.tensor([0.0, 25.0, 49.0, 50.0, 100.0, 1000.0]).log()
    sure = network._expected(odds).sigmoid()
    assert sure[:3].tolist() == pytest.approx([0.0, 0.5, 0.98], abs=1e-4)
    assert (sure.diff() > 0).all() and sure[-1] < 1


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_training_goes_on_after_calibration_as_if_there_had_been_none(share):
    """Otherwise the loss would undo it, and a second calibration say it once more."""
    loss = make_loss("instruction", removal_rate=None)
    ones = int(1000 * share)
    loss.negatives.watch(torch.ones(1000), torch.cat([torch.ones(ones), -torch.ones(1000 - ones)]))
    data, network = batch(), loss.network
    torch.manual_seed(0)
    before = loss.eval()(data)
    likely = network(data.copy())["suitability"]
    loss.calibrate()
    calibrated = network(data.copy())["suitability"]
    assert (calibrated - likely).abs().min() > 0.1
    torch.manual_seed(0)
    torch.testing.assert_close(loss(data).to_dict(), before.to_dict(), atol=0, rtol=0)
    assert torch.equal(network(data.copy())["suitability"], calibrated)


def test_a_network_that_cannot_be_told_how_rare_suitable_pairs_are_is_named():
    loss = InstructionLoss(suitability([0.9, 0.6]), torch.tensor([[1, 0], [2, 0]]))
    loss.negatives.watch(torch.ones(1000), torch.cat([torch.ones(300), -torch.ones(700)]))
    with pytest.raises(UserError, match=r"Suitability has no method expect\(share, mixed\)"):
        loss.calibrate()


def test_a_pool_of_another_length_is_refused():
    loss = make_loss("instruction", pool=POOL[:, :-1])
    with pytest.raises(UserError, match="one vocabulary"):
        loss(batch())


@pytest.mark.parametrize("fresh", [0, 2])
def test_the_share_of_suitable_pairs_comes_from_random_ones_alone(fresh):
    states = torch.zeros(3, 3, 24, 24, dtype=torch.uint8) if fresh else None
    loss = make_loss("instruction", negatives=3, near=0.5, states=states, fresh=2)
    seen = []
    loss.negatives.estimate.add = lambda own, other: seen.append(other.shape[-1])
    loss.negatives.estimate.ratio = 100
    loss(batch())
    assert loss.count == 3 and loss.negatives.uniform(3) == 2
    assert seen == [2 + fresh]  # two of the three others, and itself in fresh states


def test_near_negatives_of_final_frames_say_nothing_of_the_share():
    loss = make_loss("goal", negatives=4, near=0.5, removal_rate=None)
    seen = []
    loss.negatives.estimate.add = lambda own, other: seen.append((len(own), other.shape[-1]))
    data = batch()
    loss(data)
    assert seen == [(int(data["final"].sum()), 2)]


def some_steps(action="action"):
    return TensorDict(
        {
            "pixels": torch.randint(255, (4, 3, 48, 48), dtype=torch.uint8),
            "instruction": torch.randint(1, 30, (4, 16)),
            action: torch.zeros(4, dtype=torch.int64),
        },
        [4],
    )


def test_what_words_said_to_another_loss_is_not_penalised():
    policy = make_policy(Shapes((3, 48, 48), 40), "strong", seed=0).train()
    steps = some_steps()
    policy.get_dist(steps.copy()).log_prob(steps["action"]).mean().backward()
    copy.deepcopy(policy)  # of a network, not of a graph
    losses = ImitationLoss(policy.eval()).eval()(steps)
    assert losses["loss_words"] == 0


def test_adversarial_training_leaves_out_padding():
    loss = make_loss("reward")
    steps, others = batch((4, 3)), batch((2, 3), seed=1)
    real = torch.tensor([[1, 1, 1], [1, 0, 0]]).bool()
    padded = others.clone().set(("collector", "mask"), real)
    out, expected = loss.eval().adversarial(steps, padded), loss.adversarial(steps, others[real])
    torch.testing.assert_close(out.to_dict(), expected.to_dict())
    assert out["negative_probability"] != loss.adversarial(steps, others)["negative_probability"]


class Both(nn.Module):
    """Features of images, of any other inputs too."""

    def forward(self, *inputs: torch.Tensor) -> torch.Tensor:
        return torch.stack([each.float().reshape(len(each), -1).mean(1) for each in inputs], -1)


@pytest.mark.parametrize(
    ("kind", "reads", "written", "count"),
    [
        (InverseLoss, ["pixels", ("next", "pixels")], "logits", 3),
        (partial(InstructionLoss, pool=POOL), ["pixels", "instruction"], "suitability", 1),
        (partial(RewardLoss, n_actions=3), ["pixels", "instruction", "action"], "action_score", 1),
        (partial(GoalLoss, pool=POOL), ["pixels", "instruction"], "goal_score", 1),
    ],
)
def test_the_output_learns_that_is_named_as_asked(kind, reads, written, count):
    data = TensorDict(
        {
            "pixels": torch.rand(8, 3, 4, 4),
            "next": {"pixels": torch.rand(8, 3, 4, 4)},
            "instruction": POOL[torch.arange(8) % len(POOL)],
            "action": torch.arange(8) % 3,
            "final": (torch.arange(8) % 2 == 0).unsqueeze(-1),
        },
        [8],
    )
    head = nn.Linear(len(reads), count)
    network = TensorDictSequential(
        TensorDictModule(Both(), reads, ["features"]),
        TensorDictModule(head, ["features"], [written]),
    )
    losses = kind(network)(data)
    sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
    assert head.weight.grad.abs().sum() > 0
    head_of_another_name = TensorDictModule(head, ["features"], ["answer"])
    with pytest.raises(UserError, match=f"one of them must be named '{written}'"):
        kind(TensorDictSequential(network[0], head_of_another_name))


def test_actions_are_whole_and_as_many_as_is_said():
    network = TensorDictModule(Both(), ["pixels", "action"], ["action_score"])
    with pytest.raises(UserError, match="give n_actions="):
        RewardLoss(network)
    data = batch((4,)).set("action", torch.full((4,), 0.5))
    for name in ("imitation", "inverse", "reward"):
        with pytest.raises(UserError, match="whole numbers"):
            make_loss(name)(data)


def test_a_pool_is_made_of_tokens():
    with pytest.raises(UserError, match=r"such as demos.pool\(\), got NoneType"):
        InstructionLoss(suitability([0.5]), None)
