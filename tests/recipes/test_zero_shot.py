"""Variants of the preset `strong`, each trained on the same labels."""

import pytest
import torch
from hydra import compose, initialize_config_dir
from tensordict import TensorDict

from ifo_grounding.errors import UserError
from ifo_grounding.files import read_json

TINY = (
    "budget=tiny",
    "progress=false",
    "demonstrations.n=60",
    "imitate.steps=20",
    "imitate.trials=2",
    "imitate.trial_steps=10",
    "evaluate.episodes=30",
)


@pytest.fixture
def options(recipes, tmp_path, monkeypatch):
    monkeypatch.setenv("IFO_GROUNDING_HOME", str(tmp_path))

    def composed(*overrides):
        with initialize_config_dir(version_base=None, config_dir=str(recipes / "conf")):
            return compose("zero_shot", [*TINY, "run=one", f"results={tmp_path}", *overrides])

    return composed


def test_variants_leave_a_file_each_and_are_made_once(options, tmp_path):
    from zero_shot import compare

    found = compare(options("variants=[whole,cells-whole]"))
    file = tmp_path / "move-60-strong-cells-whole-seed0.json"
    assert read_json(file)["results"] == found["cells-whole"]
    assert sum(found["whole"]["held-out"]["counts"].values()) == 30
    trained = set(found["whole"]["trained"]["by_object"])
    held_out = {"blue circle", "blue triangle", "red rectangle"}
    assert not trained & held_out
    assert compare(options("variants=[whole]"))["whole"] == found["whole"]
    compare(options("variants=[sentence]", "run=two", "world.holdout_visible=false"))
    absent = read_json(tmp_path / "move-60-strong-sentence-absent-seed0.json")
    assert set(absent["results"]["held-out"]["by_object"]) <= held_out
    with pytest.raises(UserError, match="is of the run one, not three"):
        compare(options("variants=[whole]", "run=three"))
    assert absent["options"]["network"] == "film"  # which the sentence is of
    with pytest.raises(UserError, match="unknown variant 'hole'"):
        compare(options("variants=[hole]"))
    with pytest.raises(UserError, match="variants are of preset strong"):
        compare(options("preset=paper"))
    elsewhere = f"results={tmp_path / 'larger'}"
    larger = ("run=three", elsewhere, "world.tile_size=16", "imitate.held_out=0.2")
    assert compare(options("variants=[whole]", *larger))["whole"]["probes"]


def test_each_variant_changes_what_it_says(options):
    from zero_shot import CHANGES, WHOLE, beginning

    from ifo_grounding.networks.warm_start import trunk_of

    given = options()
    image = torch.randint(256, (4, 3, 48, 48), dtype=torch.uint8)
    tokens = torch.randint(1, 20, (4, 16))

    def answers(name):
        loss = beginning(name, given, 0)
        torch.manual_seed(0)
        trunk = trunk_of(loss.network)
        played = trunk.eval()(image, tokens)
        return trunk.train()(image, tokens), played, loss.charge

    trained, played, charge = answers(WHOLE)
    for name in CHANGES:
        training, playing, cost = answers(name)
        same = training.equal(trained), playing.equal(played), cost == charge
        expected = {
            "cells-whole": (False, False, True),
            "silent-whole": (False, False, True),
            "one-way": (False, False, True),
            "no-swaps": (False, True, True),
            "no-noise": (False, True, True),
            "no-charge": (True, True, False),
        }
        assert same == expected[name], name
    assert answers("sentence")[0].shape != trained.shape


def test_remedies_of_the_sentence_network_change_it_or_how_it_learns(options, tmp_path):
    from zero_shot import SENTENCES, beginning, compare

    given = options()
    sizes, dropouts = {}, {}
    for name in SENTENCES:
        policy = beginning(name, given, 0).network
        sizes[name] = sum(weight.numel() for weight in policy.parameters())
        dropouts[name] = {part.p for part in policy.modules() if isinstance(part, torch.nn.Dropout)}
    assert sizes["sentence-narrow"] < sizes["sentence"] == sizes["sentence-dropout"]
    assert dropouts["sentence-dropout"] == {0.5} != dropouts["sentence"]
    compare(options("variants=[sentence-decay]"))
    kept = read_json(tmp_path / "move-60-strong-sentence-decay-seed0.json")
    assert kept["results"]["trained"]["rate"]["count"] == 30


def test_jitter_changes_brightness_and_not_what_the_loss_is_given(options):
    from zero_shot import beginning

    batch = TensorDict(
        {
            "pixels": torch.full((4, 3, 48, 48), 100, dtype=torch.uint8),
            "instruction": torch.ones(4, 16, dtype=torch.int64),
            "action": torch.zeros(4, dtype=torch.int64),
        },
        [4],
    )
    loss = beginning("sentence-jitter", options(), 0)
    plain = beginning("sentence", options(), 0)
    assert plain(batch)["loss_imitation"] == plain(batch)["loss_imitation"]
    seen = [loss(batch)["loss_imitation"].item() for _ in range(2)]
    assert seen[0] != seen[1]
    assert (batch["pixels"] == 100).all()
