"""The command `play`: one scene, one sentence, and what a trained policy makes of it."""

import socket

import pytest
from PIL import Image

from ifo_grounding.cli import main
from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.errors import UserError
from ifo_grounding.evaluation import record_episodes
from ifo_grounding.networks import from_pretrained
from ifo_grounding.options import options_of_jobs


@pytest.fixture
def played(recipes, tmp_path):
    import play

    def found(*words):
        words = [*words, f"to={tmp_path / 'own.gif'}"]
        return play.play(options_of_jobs(recipes / "play.py", words)[0])

    return found


def test_a_sentence_of_ones_own_is_followed(played, tmp_path):
    own = played("task=move", "scene=7")
    assert own["asked"] == "move to the yellow diamond" and own["fulfilled, in truth"] == "yes"
    assert own["suits, in truth"] == "it suits this scene" and own["done"].endswith("S")
    with Image.open(tmp_path / "own.gif") as shown:
        assert shown.n_frames == len(own["done"].split())
    other = played("scene=7", "sentence='Move to the red diamond!'")
    assert other["asked"] == "move to the red diamond" and other["done"] == "D L S"


def test_a_sentence_that_does_not_suit_says_why(played):
    found = played("scene=7", "sentence='move to the red circle'")
    assert found["suits, in truth"] == "something that it names is not here"
    assert found["fulfilled, in truth"] == "no"
    assert found["suits, by the instruction classifier"] < 0.5


def test_the_networks_of_a_run_are_played(played, phase_1):
    found = played(f"run={phase_1}", "scene=2")
    assert found["fulfilled, in truth"] in ("yes", "no")
    assert "suits, by the instruction classifier" not in found  # phase 1 alone has none


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["sentence='fly to the moon'"], "never heard 'fly', 'moon'"),
        (["sentence=''"], "0 words"),
        (["sentence='move to " + 40 * "the " + "red circle'"], "an instruction has 1 to 16"),
        (["run=never-made"], "there is no run never-made"),
        (["to=x.png"], "names a GIF, not x.png"),
        (["scene=-1"], "scene must be at least 0"),
        (["seed=-1"], "seed must be at least 0"),
        (["sentence=<b>move</b>, to: #1 (it's)"], "never heard"),
        (["port=70000"], "port must be at most 65535"),
        (["task=fly"], "unknown task 'fly'"),
        (["level=3"], "level"),
        (["+level=3"], "option level cannot be added"),
        (["+worldly=3"], "option worldly cannot be added"),
        (["task="], "unknown task"),
        (["task=pick", "run=mine"], "not both"),
    ],
)
def test_what_cannot_be_played_is_said_in_one_line(words, said, capsys):
    to = [] if any(word.startswith("to=") for word in words) else ["to=x.gif"]
    with pytest.raises(SystemExit) as left:
        main(["play", *words, *to])
    assert left.value.code == 2
    printed = capsys.readouterr().err
    assert said in printed and printed.count("\n") == 1


def test_a_page_is_not_opened_where_it_cannot_be(capsys):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        for words, said in (
            ([f"port={taken.getsockname()[1]}"], "give another port="),
            (["host=10.255.255.1"], "host=10.255.255.1"),
            (["scene=7"], "give to=play.gif, too"),
        ):
            with pytest.raises(SystemExit) as left:
                main(["play", *words])
            printed = capsys.readouterr().err
            assert left.value.code == 2 and said in printed and printed.count("\n") == 1


def test_record_episodes_takes_a_sentence():
    policy = from_pretrained("ifo-grounding/move", kind="policy")
    asked = "move to the red diamond"
    episodes = record_episodes(policy, "move", [7, 8], sentence=asked)
    assert [episode.sentence for episode in episodes] == [asked] * 2
    env = PickAndPlaceEnv("move", num_envs=1)
    own = record_episodes(policy, env, [7])[0]
    assert (own.frames[0] == episodes[0].frames[0]).all()  # the same scene
    with pytest.raises(UserError, match="unknown word 'fly'"):
        record_episodes(policy, "move", [7], sentence="fly")
