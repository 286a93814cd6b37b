"""Which part of a policy fails on words in new combinations."""

import pytest
import torch

from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.errors import UserError
from ifo_grounding.evaluation import probe
from ifo_grounding.networks import make_policy
from ifo_grounding.networks.warm_start import trunk_of


def policy(preset):
    return make_policy(PickAndPlaceEnv("move", num_envs=1), preset, seed=0)


def test_only_edges_show_the_shape_of_new_pairs():
    apart = probe(policy("strong"), "move", scenes=200)
    assert apart.seeing_shape.held_out > 0.99 and apart.seeing_colour.held_out > 0.8
    assert apart.reading_colour is None and apart.reading_shape is None
    whole = probe(policy("film"), "move", scenes=200)
    assert whole.seeing_shape.trained > 0.8 and whole.seeing_shape.held_out < 0.2


def test_sentences_are_read_by_a_probe_that_knows_trained_pairs_alone():
    found = probe(policy("film"), "move", scenes=200)
    assert found.reading_colour.trained == found.reading_shape.trained == 1
    again = probe(policy("film"), "move", scenes=200)
    assert found == again


def test_a_map_that_prefers_no_cell_lays_the_same_weight_on_each():
    network = policy("strong")
    words = trunk_of(network).words
    with torch.no_grad():
        words.about_colour.weight.zero_()
        words.about_form.weight.zero_()
    found = probe(network, "move", scenes=50).matching
    assert found.trained == pytest.approx(1 / 36) == found.held_out


def test_cells_must_be_those_of_the_world():
    with pytest.raises(UserError, match="patches are the world's tiles"):
        probe(policy("paper"), "move", scenes=10)
