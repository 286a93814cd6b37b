import pytest
import torch

from ifo_grounding.errors import UserError
from ifo_grounding.tasks import Vocabulary
from ifo_grounding.tasks.vocabulary import words_of


def test_sentences_and_tokens_by_hand():
    vocabulary = Vocabulary(["go", "left", "now"], length=4)
    tokens = vocabulary.encode(["go left", "now now now now"])
    assert tokens.tolist() == [[1, 2, 0, 0], [3, 3, 3, 3]]
    assert tokens.dtype == torch.int64
    assert vocabulary.decode(tokens) == ["go left", "now now now now"]
    assert vocabulary.decode(tokens[0]) == ["go left"]
    assert vocabulary.encode("NOW go").tolist() == [[3, 1, 0, 0]]
    assert len(vocabulary) == 4


def test_words_can_be_collected():
    vocabulary = Vocabulary.from_sentences(["b a", "A c"], length=3)
    assert vocabulary.words == ("a", "b", "c")
    assert vocabulary == Vocabulary(["a", "b", "c"], 3)
    assert hash(vocabulary) == hash(Vocabulary(["a", "b", "c"], 3))
    assert vocabulary != Vocabulary(["a", "b", "c"], 4)
    assert vocabulary != "a b c"


@pytest.mark.parametrize(
    ("sentence", "said"),
    [
        ("go right", "unknown word 'right' in 'go right': the vocabulary holds go, left"),
        ("", "0 words"),
        ("go go go", "3 words: an instruction has 1 to 2"),
    ],
)
def test_bad_sentences_are_refused(sentence, said):
    with pytest.raises(UserError, match=said):
        Vocabulary(["go", "left"], length=2).encode([sentence])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["a", "a"], "twice"),
        (["A"], "lower case"),
        (["a "], "spaces"),
        ([""], "lower case"),
    ],
)
def test_bad_vocabularies_are_refused(words, said):
    with pytest.raises(UserError, match=said):
        Vocabulary(words)


def test_a_letter_and_its_accent_are_one_word_however_they_are_written():
    composed, apart = "caf\u00e9", "cafe\u0301"
    vocabulary = Vocabulary.from_sentences([composed, apart], length=2)
    assert vocabulary.words == (composed,) == Vocabulary([apart], 2).words
    assert vocabulary.encode([composed, apart]).tolist() == [[1, 0], [1, 0]]


def test_sentences_are_normalised():
    vocabulary = Vocabulary.from_sentences(
        ["Put it, please!", "\u201cPut it\u201d (now)"], length=4
    )
    assert vocabulary.words == ("it", "now", "please", "put")
    again = vocabulary.encode([" PUT  it\nnow ... ", "put it now"])
    assert torch.equal(again[0], again[1])
    assert words_of("well-known c++ don't") == ["well-known", "c++", "don't"]


def test_punctuation_is_kept_where_it_is_wanted():
    vocabulary = Vocabulary.from_sentences(["Stop!", "stop"], 2, punctuation=True)
    assert vocabulary.words == ("stop", "stop!")
    assert vocabulary.encode("STOP! stop").tolist() == [[2, 1]]


def test_what_there_is_no_place_for_is_skipped_where_that_is_wanted():
    """As of missions of an evaluation that no demonstration showed."""
    words = Vocabulary(["go", "left"], length=2)
    given = ["now go left left", "walk on"]
    with pytest.warns(UserWarning, match="no demonstration says 'walk': it is left out"):
        assert words.encode(given, skip_unknown=True).tolist() == [[1, 2], [0, 0]]
    with pytest.raises(UserError, match="0 words"):
        words.encode("...", skip_unknown=True)
    with pytest.raises(UserError, match="unknown skip_unknown 'no': choose one of True, False"):
        words.encode("go", skip_unknown="no")


@pytest.mark.parametrize("token", [-1, 3])
def test_what_is_no_token_has_no_word(token):
    with pytest.raises(UserError, match=f"the vocabulary has no token {token}: allowed are 0..2"):
        Vocabulary(["a", "b"]).decode(torch.tensor([[1, token]]))
