import sys

import pytest
import torch
from torch import nn

from ifo_grounding.errors import UserError
from ifo_grounding.networks import (
    Shapes,
    from_pretrained,
    make_inverse,
    make_policy,
    save_pretrained,
)
from ifo_grounding.tasks import VOCABULARY
from networks.conftest import MAKERS

SHAPES = Shapes(image_shape=(3, 16, 16), vocabulary_size=len(VOCABULARY))


@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)
def test_a_shared_network_comes_back_with_its_words(make, tmp_path):
    network = make(SHAPES, seed=0)
    folder = save_pretrained(network, tmp_path / "mine", vocabulary=VOCABULARY)
    again = from_pretrained(folder)
    for name, weight in network.state_dict().items():
        assert torch.equal(weight, again.state_dict()[name])
    assert again.vocabulary == VOCABULARY
    assert not again.training


def test_the_card_says_what_the_network_is(tmp_path):
    facts = {"Task": "move", "phase 2 success": "99.7% [99.5, 99.8]", "Command": "`make demo`"}
    save_pretrained(make_policy(SHAPES), tmp_path / "mine", facts=facts)
    card = (tmp_path / "mine" / "README.md").read_text()
    assert card.startswith("---\nlibrary_name: ifo-grounding\n")
    for shown in ("chooses an action", "| Preset | strong |", "3x16x16", *facts.values()):
        assert shown in card
    assert from_pretrained(tmp_path / "mine").vocabulary is None


def test_a_folder_is_replaced_as_a_whole(tmp_path):
    save_pretrained(make_policy(SHAPES), tmp_path / "mine", vocabulary=VOCABULARY)
    save_pretrained(make_inverse(SHAPES), tmp_path / "mine")
    assert sorted(p.name for p in (tmp_path / "mine").iterdir()) == [
        "README.md",
        "network.safetensors",
    ]
    with pytest.raises(UserError, match="'inverse', not 'policy'"):
        from_pretrained(tmp_path / "mine", kind="policy")


def test_what_cannot_be_shared_or_found_is_said(tmp_path, monkeypatch):
    with pytest.raises(UserError, match="only what a make_"):
        save_pretrained(nn.Linear(1, 1), tmp_path / "mine")
    assert not list(tmp_path.iterdir())
    with pytest.raises(UserError, match=r"no folder.*user/name"):
        from_pretrained(tmp_path / "missing")
    with pytest.raises(UserError, match=r"no folder.*user/name"):
        from_pretrained("missing")
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(UserError, match=r"ifo-grounding\[hub\]"):
        from_pretrained("someone/something")
