"""Every recipe on every world: BabyAI, any of Gymnasium, and a class of one's own."""

import shutil
import sys
from functools import partial

import pytest
import torch
from torchrl.envs import ExcludeTransform, ToTensorImage, TransformedEnv, UnaryTransform

from envs import dial as dial_module
from ifo_grounding import networks
from ifo_grounding.data import Demonstrations, labelled_buffer, show_codes
from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.errors import UserError
from ifo_grounding.files import read_json
from ifo_grounding.options import options_of
from ifo_grounding.playground import Lesson
from ifo_grounding.training import Run
from ifo_grounding.worlds import BabyAI, Grid, OpenGrid, World


class Seedless(dial_module.Dial):
    """A world that takes no notice of seeds."""

    def reset(self, *, seed=None, options=None):
        return super().reset()


LARGER = partial(Grid.demonstrate, Grid("move", tile_size=16))
TURN = ["imitate.context=0", "task=dial", "self_examine.iterations=1"]


@pytest.fixture
def dial(tmp_path, monkeypatch):
    """A module ``own_dial`` outside of the package, and a folder of its demonstrations."""
    shutil.copy(dial_module.__file__, tmp_path / "own_dial.py")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    import own_dial

    own_dial.demonstrations(60).save(tmp_path / "shown")
    yield f"recorded={tmp_path / 'shown'}"
    sys.modules.pop("own_dial", None)


@pytest.mark.parametrize(
    "world",
    [
        ["world=own", "world._target_=own_dial.DialWorld", "+world.max_steps=9"],
        [
            *("world=gymnasium", "world.factory=own_dial.Dial", "world.image=view"),
            *("world.instruction=task", "world.stop=2", "world.names=[left,right,press]"),
        ],
    ],
)
def test_both_phases_run_on_ones_own_world(options, dial, tmp_path, world):
    from two_phase import two_phase

    from report import report

    given = options(dial, *world, *TURN)
    results = two_phase(given)
    assert results["phase2"]["rate"]["count"] == 20
    assert "goal_return" in results and "suitability" not in results and "labels" not in results
    policy = networks.load(tmp_path / "run" / "policy-phase2.safetensors")
    assert policy.network_config.shapes.n_actions == 3 and "dial" in policy.vocabulary.words
    assert world[0] == "world=gymnasium" or "dial" in report(given).read_text()


@pytest.mark.parametrize(
    ("wrong", "error"),
    [
        (["world.instruction=sentence"], "there is no instruction 'sentence'"),
        (["world.instruction=task", "world.names=[left,right]"], "3 actions and 2 names"),
        (["world.instruction=task", f"world.factory={__name__}.Seedless"], "other scenes each"),
    ],
)
def test_what_is_wrong_with_a_world_is_said_before_anything_is_kept(options, dial, wrong, error):
    from record_demonstrations import record

    world = ["world=gymnasium", "world.factory=own_dial.Dial", "world.image=view", "world.stop=2"]
    given = options(dial, *world, *TURN, *wrong)
    with pytest.raises(UserError, match=error):
        record(given)
    assert not (Run(given.run) / "demonstrations").exists()


class Dimmed(Grid):
    """A grid whose simulator shows other pictures than the library's."""

    def simulator(self, num_envs, *, seed, device="cpu"):
        shown = super().simulator(num_envs, seed=seed, device=device)
        return TransformedEnv(shown, UnaryTransform(["pixels"], ["pixels"], fn=lambda x: x // 2))


class Larger(BabyAI):
    """Rooms of a subclass, whose pictures may be other ones."""

    def simulator(self, num_envs, **options):
        return super().simulator(num_envs, **options)


class Tiled(Grid):
    """One that shows pixels, of which it names the tiles."""

    tiles, coded = PickAndPlaceEnv(codes=True).tiles, World.coded


def test_own_grids_show_pixels_or_the_codes_that_they_say(options):
    from _shared import build, world_of

    dimmed, plain = (kind("move").coded(2, seed=0).reset()["pixels"] for kind in (Dimmed, Grid))
    assert dimmed.dtype == torch.uint8 and plain.dtype == torch.int16
    assert Dimmed("move").tiles is None and Grid("move").tiles is not None
    given = options("world=own", f"world._target_={__name__}.Tiled", "+world.task=move")
    policy = build(networks.make_policy, given)
    shown = [each.coded(2, seed=0).reset() for each in (world_of(given), Grid("move"))]
    assert [seen["pixels"].dtype for seen in shown] == [torch.uint8, torch.int16]
    read = [policy(seen.set("instruction", torch.ones(2, 16).long()))["logits"] for seen in shown]
    torch.testing.assert_close(*read)


def test_a_world_without_a_stop_is_imitated_in(options, dial, capsys):
    from two_phase import two_phase

    world = ("world.factory=own_dial.Dial", "world.image=view", "world.instruction=task")
    results = two_phase(options(dial, "world=gymnasium", *world, *TURN))
    assert "the world has no stop" in capsys.readouterr().out
    assert results["phase1"]["rate"]["count"] == 20 and "phase2" not in results


def test_what_nobody_judges_is_trained_and_then_played(options, tmp_path, monkeypatch):
    monkeypatch.setenv("IFO_GROUNDING_HOME", str(tmp_path / "home"))
    from evaluate import evaluate
    from play import load
    from two_phase import two_phase

    lesson = Lesson(OpenGrid(), seed=0)
    for said, moves in (("go home", (0, 3)), ("walk away", (2, 1))) * 4:
        for action in (*moves, *moves, OpenGrid().stop_action):
            lesson.act(action, said)
    lesson.save("demonstrations").rename(tmp_path / "shown")
    own = ("world=own", "world._target_=ifo_grounding.worlds.OpenGrid", "task=mine")
    given = options(*own, f"recorded={tmp_path / 'shown'}")
    assert two_phase(given) == {}
    with pytest.raises(UserError, match="nobody knows success in this world"):
        evaluate(given)
    agent = load(str(tmp_path / "run"))
    assert sorted(agent.sentences) == ["go home", "walk away"]
    for played in agent.play(0, 0, "walk away").values():
        assert played.success is None and len(played.values) == len(played.states) - 1
    frame = torch.from_numpy(played.trace.episode.frames[0])
    assert agent.suits("go home", frame, 0, 0).truth is None


@pytest.mark.parametrize(
    ("said", "refused"),
    [
        (["world=own", "world._target_=own_dial.Dial"], "is no ifo_grounding.worlds.World"),
        (["world=own", "world._target_=nowhere.Dial"], "world._target_=nowhere.Dial cannot be"),
        (["world=own", "world._target_=own_dial.DialWorld", "+world.x=1"], "cannot be made: "),
        (["world=own"], "world._target_"),
        (["+world.rewarded=perhaps"], "unknown world.rewarded 'perhaps'"),
        (["world._target_=own_dial.DialWorld"], "cannot be made: "),
        (["world=gymnasium"], "one of world.id=... and world.factory=..."),
        (["world=gymnasium", "world.factory=own_dial.Nothing"], "cannot be imported"),
        (["world.size=2"], "size must be 3..16"),
        (["world.objects=[1]"], "objects must be .fewest, most. within 0..36"),
        (["task=mov"], "unknown task 'mov'"),
        (["world=babyai", "task=GoToMoon"], "unknown level 'GoToMoon'"),
    ],
)
def test_a_world_that_cannot_be_is_refused_first(options, dial, tmp_path, said, refused):
    from record_demonstrations import record

    with pytest.raises(UserError, match=refused):
        record(options(dial, *said))
    assert not (tmp_path / "run" / "config.yaml").exists()


@pytest.mark.parametrize("method", ["simulator", "instructed"])
@pytest.mark.parametrize(
    ("returned", "said"),
    [
        (lambda env: None, "NoneType with no pixels"),
        (lambda env: TransformedEnv(env, ExcludeTransform("pixels")), "with no pixels"),
        (lambda env: TransformedEnv(env, ToTensorImage(in_keys=["pixels"])), "torch.float32"),
        (lambda env: PickAndPlaceEnv("move", num_envs=1), r"uint8\[1, 3, 48, 48\]"),
    ],
)
def test_a_world_that_shows_no_pixels_is_refused_first(
    options, monkeypatch, method, returned, said
):
    from record_demonstrations import record

    made = getattr(Grid, method)
    monkeypatch.setattr(Grid, method, lambda self, *n, **how: returned(made(self, *n, **how)))
    with pytest.raises(UserError, match=rf"Grid.{method}\(2, ...\) returned .*{said}"):
        record(options())


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("stop_action", 0, r"stop_action is 0, that of Grid.simulator\(...\) 5"),
        ("actions", (), "6 actions and 0 names"),
        ("simulator", lambda self, n: None, r"Grid.simulator\(num_envs, seed=\) cannot be called"),
        ("demonstrate", lambda self, n, **how: None, "demonstrate returned NoneType"),
        ("demonstrate", lambda self, n, **how: (4, 2), "demonstrate returned tuple"),
        ("demonstrate", lambda self, n, **how: LARGER(n, **how), "3, 96, 96.*3, 48, 48"),
    ],
)
def test_a_world_that_contradicts_itself_is_refused_first(options, monkeypatch, name, value, said):
    from record_demonstrations import record

    monkeypatch.setattr(Grid, name, value)
    with pytest.raises(UserError, match=said):
        record(options())


def test_a_world_that_makes_no_demonstrations_says_what_to_give(options, dial):
    from record_demonstrations import record

    with pytest.raises(UserError, match="makes no demonstrations: give recorded=FOLDER"):
        record(options("world=own", "world._target_=own_dial.DialWorld", *TURN))


def test_both_phases_run_in_babyai(options, tmp_path):
    pytest.importorskip("minigrid")
    from two_phase import two_phase

    given = options(
        *("world=babyai", "task=GoToObj", "world.processes=1", "references=true"),
        *("imitate.lr=1e-4", "self_examine.iterations=1", "controls.run=true"),
        f"results={tmp_path / 'results'}",
    )
    results = two_phase(given)
    names = ("phase1", "phase2", "continued", "true_actions")
    assert len({results[name]["scenes"] for name in names}) == 1
    assert all(results[name]["rate"]["count"] == 20 for name in (*names, "demonstrator"))
    assert results["demonstrator"]["rate"]["rate"] == 1.0
    assert set(results["labels"]["per_action"]) >= {"left", "forward", "done"}
    assert "goal_return" in results and "suitability" not in results and "endings" not in results
    audit = read_json(tmp_path / "run" / "metrics" / "self_examine.json")
    assert "success" in audit[-1] and "suitable" not in audit[-1]
    # The words are those of the demonstrations.
    demos = Demonstrations.load(tmp_path / "run" / "demonstrations")
    policy = networks.load(tmp_path / "run" / "policy-phase2.safetensors")
    assert demos.vocabulary.decode(demos.pool()[:1])[0].startswith("go to")
    assert policy.vocabulary == demos.vocabulary
    [path] = (tmp_path / "results").glob("*.json")
    assert path.name == "GoToObj-60-strong-seed0.json"
    # True actions reached the reference alone: phase 1 does without the truth.
    run = tmp_path / "run"
    files = ("policy-phase1.safetensors", "reference-true-actions.safetensors")
    assert (run / files[0]).read_bytes() != (run / files[1]).read_bytes()


def test_babyai_is_practised_in_codes_where_tiles_allow():
    pytest.importorskip("minigrid")
    demos, _ = BabyAI("GoToObj", processes=1).demonstrate(4, seed=0)
    found = {}
    for kind, tile_size in ((BabyAI, 8), (BabyAI, 10), (Larger, 8)):
        world = kind("GoToObj", tile_size=tile_size)
        world.vocabulary = demos.vocabulary
        found[kind, tile_size] = world.coded(2, seed=0)
        assert (world.tiles is None) == (found[kind, tile_size].tiles is None)
    shown = {key: env.reset()["pixels"] for key, env in found.items()}
    assert [each.dtype for each in shown.values()] == [torch.int16, torch.uint8, torch.uint8]
    buffer = labelled_buffer(demos, torch.zeros(demos.transitions, dtype=torch.uint8))
    show_codes(buffer, found[BabyAI, 8].tiles)
    assert buffer[:]["pixels"].dtype == torch.int16  # the bot's frames are made of them


def test_babyai_knows_no_splits(recipes):
    pytest.importorskip("minigrid")
    from _shared import world_of

    world = world_of(options_of("world=babyai"))
    with pytest.raises(UserError, match="split"):
        world.instructed(5, seed=0, stream="evaluation", split="zero-shot")
