import pytest
import torch

from ifo_grounding.errors import UserError
from ifo_grounding.tasks import N_TEMPLATES, TASKS, VOCABULARY, grammar
from ifo_grounding.tasks.grammar import FIELDS, HOLDOUTS, PHRASINGS, SPLITS, holdout_kinds, in_split
from ifo_grounding.world import COLOURS, SHAPES, kind

# Goals that a sentence can express: kinds, sides, boxes, ordered pairs of boxes or of kinds.
FILLERS = {
    "move": 12,
    "move-udlr": 12 * 4,
    "pick": 12 * 7,
    "pick-out": 12 * 7 * 6,
    "pick-udlr": 12 * 11 * 4,
}
WORDINGS = {"move": 1, "move-udlr": 2, "pick": 12, "pick-out": 36, "pick-udlr": 6}


def test_numbers_of_templates_are_those_of_the_paper():
    assert list(N_TEMPLATES.values()) == [1, 8, 12, 36, 24]
    assert tuple(N_TEMPLATES) == TASKS
    assert {task: len(wordings) for task, wordings in PHRASINGS.items()} == WORDINGS


def test_no_sentence_is_said_twice_by_any_task():
    said = [sentence for task in TASKS for sentence in grammar(task).sentences]
    assert len(said) == len(set(said)) == sum(WORDINGS[task] * FILLERS[task] for task in TASKS)


def test_the_vocabulary_holds_every_word_and_no_other():
    used = {word for task in TASKS for s in grammar(task).sentences for word in s.split()}
    assert used == set(VOCABULARY.words)


@pytest.mark.parametrize("task", TASKS)
def test_every_sentence_goes_to_its_goal_and_back(task):
    known = grammar(task)
    goals = known.parse(list(known.sentences))
    rows = torch.arange(len(known.sentences))
    tokens = known.encode(goals, rows % WORDINGS[task])
    assert VOCABULARY.decode(tokens) == list(known.sentences)
    assert (goals.task == TASKS.index(task)).all()
    # As many goals as fillers, each with every wording.
    fields = torch.stack([getattr(goals, name) for name in FIELDS], -1)
    distinct, counts = fields.unique(dim=0, return_counts=True)
    assert len(distinct) == FILLERS[task]
    assert (counts == WORDINGS[task]).all()


@pytest.mark.parametrize(
    ("sentence", "task", "fields"),
    [
        ("move to the blue triangle", "move", (12, 0, 0, 0, 0)),
        ("move the arm to the right of the red rectangle", "move-udlr", (2, 0, 0, 0, 1)),
        ("go to the cell below the yellow diamond", "move-udlr", (7, 0, 0, 0, 2)),
        ("put the red circle into the cyan box", "pick", (1, 0, 0, 7, 0)),
        ("pick up the blue circle and drop it in the pink box", "pick", (9, 0, 0, 4, 0)),
        ("take the red circle from the orange box to the gray box", "pick-out", (1, 0, 1, 6, 0)),
        ("place the yellow circle to the left of the blue diamond", "pick-udlr", (5, 11, 0, 0, 3)),
        ("put the red triangle above the red circle", "pick-udlr", (4, 1, 0, 0, 0)),
    ],
)
def test_sentences_by_hand(sentence, task, fields):
    goal = grammar(task).parse(sentence)
    assert tuple(int(getattr(goal, name)) for name in FIELDS) == fields


def test_the_parser_forgives_capitals_spaces_and_punctuation():
    assert int(grammar("move").parse("  Move to the RED   circle. ").object) == 1


@pytest.mark.parametrize("sentence", ["fly to the red circle", "move to the red", "", "move"])
def test_what_is_no_sentence_is_refused(sentence):
    with pytest.raises(UserError, match="is no sentence of move; it says such as 'move to the"):
        grammar("move").parse(sentence)


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("holdout", HOLDOUTS)
def test_the_splits_divide_the_sentences(task, holdout):
    known = grammar(task)
    train, zero_shot, everything = (
        in_split(known.goals, split, holdout) for split in ("train", "zero-shot", "all")
    )
    assert everything.all()
    assert (train ^ zero_shot).all()
    mentions = [any(name in sentence for name in HOLDOUTS[holdout]) for sentence in known.sentences]
    assert zero_shot.tolist() == mentions
    assert holdout_kinds(holdout) == tuple(kind(*pair.split()) for pair in HOLDOUTS[holdout])
    words = {
        w
        for s, kept in zip(known.sentences, train.tolist(), strict=True)
        if kept
        for w in s.split()
    }
    assert {*COLOURS, *SHAPES} <= words


def test_unknown_splits_are_refused():
    assert SPLITS == ("all", "train", "zero-shot")
    goals = grammar("move").goals
    with pytest.raises(UserError, match="unknown split 'test'"):
        in_split(goals, "test", "pairs-3")
    with pytest.raises(UserError, match="unknown holdout 'pairs-9'"):
        in_split(goals, "train", "pairs-9")
    with pytest.raises(UserError, match="unknown task"):
        grammar("fly")
