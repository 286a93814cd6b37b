"""What a policy that reads word by word can and cannot tell apart."""

import pytest
import torch
import torch.nn.functional as F
from tensordict import TensorDict

from ifo_grounding.data import labelled_buffer, record_demonstrations
from ifo_grounding.errors import UserError
from ifo_grounding.evaluation import episode_endings
from ifo_grounding.modules import take_word_penalty
from ifo_grounding.networks import make_policy
from ifo_grounding.networks.appearance import ColourAndForm
from ifo_grounding.networks.grounding import GroundedTrunk, swap_words
from ifo_grounding.networks.trunk import instructed_network
from ifo_grounding.objectives import ImitationLoss
from ifo_grounding.tasks import VOCABULARY
from ifo_grounding.training import FitConfig, fit
from ifo_grounding.world import WorldState, kind, render


def tiles(*objects, arm=35):
    """Draw objects in the first cells of a world, its arm elsewhere: [1, 3, 48, 48]."""
    state = WorldState.empty(1)
    state.arm[0] = arm
    for cell, name in enumerate(objects):
        state.objects[0, cell] = kind(*name.split())
    return render(state, 8)


def batch(*sentences):
    """Return one image with each of some instructions, and actions."""
    count = len(sentences)
    image = tiles("red circle", "blue triangle").expand(count, -1, -1, -1)
    words = VOCABULARY.encode(list(sentences))
    action = 5 - torch.arange(count)
    return TensorDict({"pixels": image, "instruction": words, "action": action}, [count])


def seen(image):
    torch.manual_seed(0)
    cells = ColourAndForm(3, 64, 8)(image)
    return cells.colour[cells.where[0]], cells.form[cells.where[0]]


def test_colour_and_form_are_seen_apart():
    colour, form = seen(tiles("red circle", "red triangle", "blue circle", "yellow triangle"))
    red_circle, red_triangle, blue_circle, yellow_triangle = range(4)
    torch.testing.assert_close(colour[red_circle], colour[red_triangle])
    assert not torch.allclose(colour[red_circle], colour[blue_circle], atol=1e-3)
    torch.testing.assert_close(form[red_circle], form[blue_circle], atol=1e-3, rtol=1e-3)
    torch.testing.assert_close(form[red_triangle], form[yellow_triangle], atol=1e-3, rtol=1e-3)
    assert not torch.allclose(form[red_circle], form[red_triangle], atol=1e-2)


def test_each_word_adds_evidence_of_its_own(shapes):
    trunk = instructed_network(make_policy(shapes, "strong", seed=0)).trunk
    assert isinstance(trunk, GroundedTrunk)
    words = trunk.words
    with torch.no_grad():
        words.relevance.weight.zero_()  # every word counts alike for every map
        cells = trunk.appearance(tiles("red circle", "blue triangle"))
        both, red, circle = (
            words(cells, VOCABULARY.encode([text]))[0] for text in ("red circle", "red", "circle")
        )
    torch.testing.assert_close(both, red + circle)


def test_words_are_swapped_between_instructions_of_a_length():
    tokens = torch.tensor(
        [[1, 2, 3, 4], [5, 6, 7, 8], [9, 10, 0, 0], [11, 12, 0, 0], [13, 0, 0, 0]]
    )
    swapped = swap_words(tokens, 1.0)
    assert swapped.equal(tokens[[1, 0, 3, 2, 4]])
    torch.manual_seed(0)
    many = tokens[:2].repeat(500, 1)
    some = swap_words(many, 0.5)
    assert ((some == tokens[0]) | (some == tokens[1])).all()
    assert 0.15 < (some != many).float().mean() < 0.35  # half of the others are the same
    assert swap_words(tokens, 0.0).equal(tokens)
    assert swap_words(tokens[:0], 1.0).shape == (0, 4)


def test_what_words_say_is_penalised_in_training(shapes):
    policy, data = make_policy(shapes, "strong", seed=0), batch("move to the red circle")
    loss = ImitationLoss(policy, word_penalty=1.0)
    loss(data)["loss_words"].backward()
    words = instructed_network(policy).trunk.words
    said = words.about_form.weight.grad.abs().sum(1).nonzero().squeeze(1)
    assert said.tolist() == sorted(data["instruction"][data["instruction"] > 0].tolist())
    assert take_word_penalty(policy) is None  # taken, so that the policy can be copied
    assert loss.eval()(data)["loss_words"] == 0
    assert "loss_words" not in ImitationLoss(make_policy(shapes, "paper", seed=0))(data)


def test_words_are_found_before_they_are_held_to_one_meaning(shapes):
    policy = make_policy(shapes, "strong", seed=0)
    words = instructed_network(policy).trunk.words
    data = batch("move to the red circle", "move to the blue triangle")
    loss = ImitationLoss(policy, words_from=0.5)
    assert loss(data)["loss_words"] == 0
    torch.manual_seed(0)
    as_said = words.eval().roles(data["instruction"])[0]
    assert words.train().roles(data["instruction"])[0].equal(as_said)

    loss.set_progress(0.5)
    assert loss(data)["loss_words"] > 0
    assert not words.roles(data["instruction"])[0].equal(as_said)
    loss.set_progress(0.0)  # as when training begins once more
    assert loss(data)["loss_words"] == 0
    ImitationLoss(policy)  # swaps from the start, whatever came before
    assert words.swaps_words
    with pytest.raises(UserError, match=r"words_from must be within 0..1, got 2"):
        ImitationLoss(policy, words_from=2)


def test_words_outside_the_vocabulary_are_named(shapes):
    policy = make_policy(shapes, "strong", seed=0)
    with pytest.raises(UserError, match=r"hold token 99: allowed are 0\.\."):
        policy(pixels=tiles("red circle"), instruction=torch.tensor([[1, 99]]))


@pytest.mark.slow
def test_pairs_that_no_demonstration_names_are_followed():
    holdout = {"split": "train", "holdout": "validation-3"}
    demos, truth = record_demonstrations("move", 3000, seed=0, keep_truth=True, **holdout)
    buffer = labelled_buffer(demos, truth.actions)
    config = FitConfig(steps=800, batch_size=256, lr=4e-3, weight_decay=0.01)

    def begin(seed):
        loss = ImitationLoss(make_policy(demos, "strong", seed=seed))
        return loss, fit(loss, buffer, config, seed=0, until=300)[-1]["loss_imitation"]

    loss, _ = min((begin(seed) for seed in range(6)), key=lambda tried: tried[1])
    fit(loss, buffer, config, seed=0)
    scenes = {"episodes": 1000, "stream": "validation", "holdout": "validation-3"}
    found = episode_endings(loss.network, "move", split="zero-shot", **scenes)
    assert found.counts["success"] > 800


def test_padding_says_nothing(shapes, preset):
    policy = make_policy(shapes, preset, seed=0)
    data = batch("move to the red circle", "put the blue diamond in the green box")
    both = policy(data.clone())["logits"]
    torch.testing.assert_close(policy(data[:1].clone())["logits"], both[:1])
    data["instruction"] = F.pad(data["instruction"], (0, 9))
    torch.testing.assert_close(policy(data)["logits"], both)
