"""Texts, options and arguments of the wrong kind: shown as they are, taken rightly or refused."""

import concurrent.futures
import itertools
import multiprocessing
import os
import random
import re

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from ifo_grounding import report
from ifo_grounding.cli import main
from ifo_grounding.data import Demonstrations, collect_transitions
from ifo_grounding.data.transitions import RandomActions
from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.errors import UserError
from ifo_grounding.evaluation import Episode, Trace
from ifo_grounding.networks import Shapes, make_policy, make_reward_model, save_pretrained
from ifo_grounding.options import options_of, plain
from ifo_grounding.report.drawing import Captioned
from ifo_grounding.training.checkpoint import leaves
from outline import read

TEXTS = (
    *("<script>alert(1)</script>", "</td></table><h1>x", "<!-- x", "a<b>c", "<svg/onload=x>"),
    *("a|b", "a\r\n---\nb", "\n\n# head", "[a](javascript:x)", "![x](http://e/x.png)", "`x`"),
    *("{{7*7}}", "{% raw %}", "$\\frac$", "\\", "\x00", "\ud800", "\x1b[31m", "\u202e", "é" * 300),
    *("", "---\nlicense: evil\n---", "x' onmouseover='y", 'x" onmouseover="y', "\u2028", "\t"),
)
SHAPES = Shapes((3, 16, 16), 60, tile_size=8)


def page(text, folder):
    text = f"x{text}"
    shown = [Captioned(np.zeros((3, 16, 16), np.uint8), text, text, text)]
    results = {text: 0.5, "Table": {text: text}, "Rows": [{text: text, "b": 1}], "Text": text}
    return report.write_report(folder, results, {text: shown}, title=text, summary=text)


def test_pages_cards_tables_and_pictures_show_any_text(tmp_path):
    policy = make_policy(SHAPES, features=16)
    elements = read(page("", tmp_path)).elements
    for text in TEXTS:
        assert read(page(text, tmp_path)).elements == elements, text
        card = save_pretrained(policy, tmp_path / "n", facts={"A" + text: text}) / "README.md"
        lines = card.read_text(encoding="utf-8").split("| --- | --- |\n")[1].split("\n\n")[0]
        tables = lines.split("\n"), report.markdown_table([{"A" + text: text, "b": 1}]).split("\n")
        assert [*map(len, tables)] == [6, 3], text
        for line in (*tables[0], *tables[1]):
            assert len(re.split(r"(?<!\\)\|", line)) == 4, line
            assert not re.search(r"<[A-Za-z/!?]|\]\(", line), line
        plainly = report.text_table([{"A" + text: text, "b": 1}])
        assert plainly.count("\n") == 2 and "\x1b" not in plainly, text
        plainly.encode()


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 12])
def test_any_world_and_any_text_can_be_animated(channels):
    frames = np.zeros((3, channels, 48, 48), np.uint8)
    frames[:, -3:] = 200
    text = "a\r\n<b> \ud800 $x_"
    episode = Episode(frames, np.array([1, 5]), text, True, True, 0)
    maps = np.full((2, 2, 6, 6), 1 / 36, np.float32)
    trace = Trace(episode, np.full((2, 6), 1 / 6, np.float32), maps, {})
    for drawn in (
        report.animation([episode], titles=[text], actions=[text] * 6),
        report.trace_animation(trace, actions=[text] * 6),
    ):
        assert drawn.startswith(b"GIF")


VALUES = (
    *("-1", "1.5", "1e400", "nan", "-inf", "null", "", "''", "abc", "[1,2]", "{a:1}", "9" * 20),
    *("${nope}", "${task", "a,b", "\x00", "../x", "?", "???", "'1'", "[", "\\", "~", "💥", "0x10"),
    *("-0.0", "1e-320", "!!python/object:os.system", "&a", "*a", "9" * 5000),
)
FORMS = ("~{}", "+{}=1", "{}", "{}=={}", "--{}=1", "{}.x=1", "{}[0]=1", "{}@x=1", " {}=1", "={}")


def given(some):
    """Return every option with so many of the values, and one of the forms each."""
    names, draw = sorted(leaves(plain(options_of("task=pick")))), random.Random(some)
    for name in names if some > 1 else draw.sample(names, 12):
        yield from (f"{name}={value}" for value in draw.sample(VALUES, some))
        yield draw.choice(FORMS).replace("{}", name)


@pytest.mark.parametrize("some", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_options_are_taken_or_refused_in_one_line(some):
    for word in given(some):
        try:
            options_of("task=pick", "budget=tiny", word)
        except UserError as error:
            assert len(str(error)) > 10, word  # noqa: PT017


def test_a_command_line_of_bytes_that_are_no_text(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["demo", "task=mo\udcffve", "world=grid"])
    assert ended.value.code == 2
    capsys.readouterr().err.encode()


PIXELS = torch.zeros(2, 3, 16, 16, dtype=torch.uint8)
TOKENS = torch.ones(2, 16, dtype=torch.int64)
NUMBERS = (None, "x", float("nan"), -1, 2, [], {}, torch.zeros(2), object())


@pytest.mark.parametrize("make", [make_policy, make_reward_model])
@pytest.mark.parametrize("preset", ["strong", "paper"])
def test_tokens_are_whole_numbers(make, preset):
    network = make(SHAPES, preset, seed=0)

    def said(tokens):
        given = TensorDict({"pixels": PIXELS, "instruction": tokens, "action": TOKENS[:, 0]}, [2])
        return network(given)[network.out_keys[0]]

    expected = said(TOKENS)
    for dtype in (torch.uint8, torch.int16, torch.int32):
        assert torch.equal(said(TOKENS.to(dtype).t().contiguous().t()), expected)
    for dtype in (torch.bool, torch.float32, torch.bfloat16, torch.complex64):
        with pytest.raises(UserError, match="whole token ids, got torch"):
            said(TOKENS.to(dtype))


def test_arguments_of_another_kind_are_named():
    with pytest.raises(UserError, match="every row of a history has its 'step'"):
        report.training_curves([{"step": 0, "loss": 1.0}, {"loss": 0.5}])
    frames = [np.zeros((2, 3, 16, 16), np.uint8)] * 2
    world = PickAndPlaceEnv("move", num_envs=2, seed=0)
    for value in NUMBERS:
        if value is not None:
            with pytest.raises(UserError, match=r"stop_probability must be within 0\.\.1"):
                collect_transitions(world, 4, stop_probability=value)
    for words in (["go", "on"], -1, "go on"):
        for instructions in (["go on", "stop"], torch.ones(2, 2, dtype=torch.int64)):
            with pytest.raises(UserError, match="vocabulary is a Vocabulary, such as"):
                Demonstrations.from_arrays(frames, instructions, vocabulary=words)
    for length in ("x", 0, 1.5, []):
        with pytest.raises(UserError, match="length must be"):
            Demonstrations.from_arrays(frames, ["go on", "stop"], length=length)
    again = PickAndPlaceEnv("move", num_envs=np.array(2), max_steps=np.array(3), seed=0)
    assert again.rollout(5, RandomActions(again, stop_probability=0.0)).shape == (2, 3)


def test_signals_for_all_are_left_to_the_parent():
    from ifo_grounding.data.babyai import ENDINGS, _heed_the_parent

    fork = multiprocessing.get_context("fork")
    with concurrent.futures.ProcessPoolExecutor(1, fork, _heed_the_parent) as pool:
        number = pool.submit(os.getpid).result()
        for ending in ENDINGS:
            os.kill(number, ending)
        assert pool.submit(os.getpid).result() == number


@pytest.mark.slow
def test_memory_stays_over_thousands_of_steps_and_hundreds_of_resets():
    def memory():
        with open("/proc/self/statm") as file:  # noqa: PTH123
            return int(file.read().split()[1]) * os.sysconf("SC_PAGESIZE") >> 20

    world = PickAndPlaceEnv("move", num_envs=8, seed=0)
    state, before = world.reset(), 0
    for step in itertools.count():
        state = world.step_mdp(world.step(world.rand_action(state)))
        state = world.maybe_reset(state) if step % 10 else world.reset()
        if step == 500:
            before = memory()
        if step == 3500:
            break
    assert memory() - before < 16
