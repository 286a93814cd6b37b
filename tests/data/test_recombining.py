"""Instructions made of other instructions' words."""

import pytest
import torch

from ifo_grounding.data import recombined, record_demonstrations
from ifo_grounding.tasks import TASKS, VOCABULARY
from ifo_grounding.tasks.grammar import HOLDOUTS


@pytest.mark.parametrize("task", TASKS)
def test_words_of_demonstrations_name_the_pairs_that_no_demonstration_names(task):
    options = {"split": "train", "holdout": "validation-3"}
    pool = record_demonstrations(task, 300, seed=0, **options).pool()
    found = recombined(pool)
    known, made = ({tuple(row) for row in rows.tolist()} for rows in (pool, found))
    assert len(found) == len(made) and not known & made
    sentences = VOCABULARY.decode(found)
    for pair in HOLDOUTS["validation-3"]:
        assert not any(pair in sentence for sentence in VOCABULARY.decode(pool))
        assert any(pair in sentence for sentence in sentences)
    lengths = {len(sentence.split()) for sentence in VOCABULARY.decode(pool)}
    assert {len(sentence.split()) for sentence in sentences} <= lengths
    places = [set(column) for column in zip(*pool.tolist(), strict=True)]
    assert all(set(column) <= place for column, place in zip(found.T.tolist(), places, strict=True))


def test_each_differs_from_two_known_ones_in_one_word():
    pool = record_demonstrations("pick", 200, seed=0).pool()
    differing = (recombined(pool).unsqueeze(1) != pool).sum(-1)
    assert ((differing == 1).sum(1) >= 2).all()


@pytest.mark.parametrize("pool", [[[1, 2, 0]], [[1, 2, 0], [1, 3, 0]], [[1, 2, 0], [1, 2, 3]]])
def test_where_nothing_new_can_be_made(pool):
    found = recombined(torch.tensor(pool))
    assert found.shape == (0, 3) and found.dtype == torch.int64
