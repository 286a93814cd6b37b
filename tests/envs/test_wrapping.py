"""Worlds that the project did not make, behind its keys."""

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import TransformedEnv, check_env_specs

from envs.dial import MARKS, PRESS, Dial
from ifo_grounding.data import collect_transitions
from ifo_grounding.envs import from_gymnasium
from ifo_grounding.errors import UserError
from ifo_grounding.evaluation import record_episodes, return_audit, success_rate
from ifo_grounding.tasks import VOCABULARY, Vocabulary
from ifo_grounding.transforms import GoalReward, InstructionSampler

WORDS = Vocabulary.from_sentences([f"turn the dial to {mark}" for mark in MARKS], length=6)
DIAL = {"vocabulary": WORDS, "image": "view", "instruction": "task"}


def dials(num_envs=3, **options):
    return from_gymnasium(Dial, num_envs=num_envs, **{"seed": 0, **DIAL, **options})


@pytest.mark.parametrize("instructed", [True, False])
def test_specs_hold(instructed):
    env = dials(instructed=instructed)
    check_env_specs(env)
    assert ("instruction" in env.observation_spec) == instructed
    assert env.observation_spec["pixels"].shape == (3, 3, 20, 28)
    assert env.action_spec.space.n == 3


def test_an_id_is_made_with_its_options():
    env = from_gymnasium(
        "ifo_grounding/Move-v0",
        vocabulary=VOCABULARY,
        image="pixels",
        instruction="instruction_text",
        num_envs=2,
        tile_size=16,
    )
    td = env.reset()
    assert td["pixels"].shape == (2, 3, 96, 96)
    assert all(sentence for sentence in VOCABULARY.decode(td["instruction"]))


def shown(pixels):
    """Where each dial [N, 3, 20, 28] stands."""
    return (pixels[:, 0, 10, 2::4] > 100).int().argmax(-1)


def wanted(td):
    return torch.tensor([MARKS.index(text.split()[-1]) for text in WORDS.decode(td["instruction"])])


def test_instructions_and_rewards_are_the_world_s():
    env = dials(6)
    td = env.reset()
    asked = wanted(td)
    assert (shown(td["pixels"]) != asked).all()
    earned = torch.zeros(6)
    for _ in range(6):
        way = asked - shown(td["pixels"])
        action = torch.where(way == 0, PRESS, (way > 0).long())
        td = env.step(td.set("action", action))
        assert torch.equal(td["next", "terminated"].squeeze(-1), way == 0)
        earned += td["next", "reward"].squeeze(-1)
        td = env.step_mdp(td)
    assert earned.tolist() == [1.0] * 6  # what has ended stays as it is, and pays no more


def test_scenes_have_numbers_and_streams_do_not_meet():
    env, other = dials(4), dials(4)
    numbers = TensorDict({"scene": torch.tensor([[7], [3], [7], [9]])}, [4])
    first = env.reset(numbers)
    assert torch.equal(first["pixels"][0], first["pixels"][2])
    assert torch.equal(first["instruction"], other.reset(numbers)["instruction"])
    assert env.scene_numbers.tolist() == [7, 3, 7, 9]
    many = TensorDict({"scene": torch.arange(30).unsqueeze(-1)}, [30])
    trained = dials(30).reset(many)["instruction"]
    evaluated = dials(30, stream="evaluation").reset(many)["instruction"]
    assert not torch.equal(trained, evaluated)


def test_partial_resets_touch_only_their_rows():
    env = dials(4)
    td = env.reset()
    td = env.step_mdp(env.step(td.set("action", torch.tensor([0, 1, 0, 1]))))
    mask = torch.tensor([[False], [True], [False], [True]])
    after = env.reset(td.clone().set("_reset", mask))
    kept = ~mask.squeeze(-1)
    assert torch.equal(after["pixels"][kept], td["pixels"][kept])
    assert torch.equal(after["instruction"][kept], td["instruction"][kept])
    assert env.scene_numbers.tolist() == [0, 4, 2, 5]
    again = env.step(after.set("action", torch.full((4,), PRESS)))
    assert torch.equal(again["next", "pixels"], after["pixels"])  # pressing moves nothing


@pytest.mark.parametrize("scene", [-1, 0.5])
def test_what_is_no_number_of_a_scene_is_refused(scene):
    env = dials(2)
    with pytest.raises(UserError, match="scene"):
        env.reset(TensorDict({"scene": torch.tensor([[0], [scene]])}, [2]))


def test_a_learner_sees_neither_reward_nor_the_world_s_own_goal():
    env = dials(8, instructed=False, seed=1)
    rollout = env.rollout(60, break_when_any_done=False)
    assert not rollout["next", "reward"].any()
    assert not rollout["next", "terminated"].any()
    assert rollout["next", "truncated"].any()


@pytest.mark.parametrize(("stop", "actions", "action"), [("add", 4, 3), (PRESS, 3, PRESS)])
@pytest.mark.parametrize("instructed", [True, False])
def test_a_policy_can_say_that_it_is_done(stop, actions, action, instructed):
    env = dials(2, stop=stop, instructed=instructed)
    check_env_specs(env)
    assert env.action_spec.space.n == actions
    td = env.reset()
    after = env.step(td.set("action", torch.tensor([0, action])))["next"]
    assert after["terminated"].flatten().tolist() == [False, True]
    assert not after["truncated"].any()
    assert torch.equal(after["pixels"][1], td["pixels"][1])
    assert not after["reward"].any()


def test_processes_show_what_one_process_shows():
    apart, together = dials(2, processes=True), dials(2)
    for env in (apart, together):
        torch.manual_seed(0)
        env.seen = env.rollout(10, break_when_any_done=False)
    apart.close()
    for key in ("pixels", "instruction", "action", ("next", "reward")):
        assert torch.equal(apart.seen[key], together.seen[key])


def knows(td):
    """Turn the dial to the mark of the instruction, and press."""
    away = wanted(td) - shown(td["pixels"])
    return td.set("action", torch.where(away == 0, PRESS, (away > 0).long()))


def test_episodes_are_recorded_and_audited_as_they_are_counted():
    half = lambda td: knows(td).set("action", torch.where(wanted(td) < 3, td["action"], PRESS))  # noqa: E731
    result = success_rate(half, dials(7), episodes=14)
    assert 0 < result.rate.rate < 1
    episodes = record_episodes(half, dials(3), [11, 4, 12])
    assert [e.success for e in episodes] == result.outcomes[[11, 4, 12]].tolist()
    assert [len(e.actions) for e in episodes] == result.lengths[[11, 4, 12]].tolist()
    for episode in episodes:
        assert len(episode.frames) == len(episode.actions) + 1
        assert episode.actions[-1] == PRESS and episode.sentence.startswith("turn the dial to")
    with pytest.raises(UserError, match="3 rows for 2 scenes"):
        record_episodes(half, dials(3), [0, 1])

    def at_the_mark(pixels, instruction):
        td = TensorDict({"pixels": pixels, "instruction": instruction})
        return 16.0 * (shown(pixels) == wanted(td)).float().unsqueeze(-1) - 8.0

    model = TensorDictModule(at_the_mark, ["pixels", "instruction"], ["goal_score"])
    reward = GoalReward(model, stop_action=PRESS)
    audit = return_audit(half, reward, dials(7), episodes=14, mode="greedy")
    assert torch.equal(audit.outcomes, result.outcomes) and audit.auc.value == 1.0


def test_words_that_nobody_taught_can_be_left_out():
    known = Vocabulary.from_sentences(["turn the dial to one"], length=6)
    with pytest.raises(UserError, match="unknown word"):
        dials(6, vocabulary=known)
    read = known.decode(dials(6, vocabulary=known, skip_unknown=True).reset()["instruction"])
    assert "turn the dial to" in read and set(read) <= {"turn the dial to", "turn the dial to one"}


def test_instructions_can_be_chosen_for_it():
    def all_suit(pixels, instruction):
        return torch.full((len(pixels), 1), 9.0)

    classifier = TensorDictModule(all_suit, ["pixels", "instruction"], ["suitability"])
    pool = WORDS.encode([f"turn the dial to {mark}" for mark in MARKS])
    env = TransformedEnv(dials(3, instructed=False), InstructionSampler(classifier, pool))
    check_env_specs(env)
    assert all(text.startswith("turn") for text in WORDS.decode(env.reset()["instruction"]))


class Odd(Dial):
    def __init__(self, view, action_space=None):
        super().__init__()
        self.view = view
        if action_space is not None:
            self.action_space = action_space

    def _observe(self):
        return {"view": self.view, "task": "turn the dial to one"}


@pytest.mark.parametrize(
    ("make", "options", "said"),
    [
        (Dial, {"image": "picture"}, "no image 'picture'.*task.*view"),
        (Dial, {"image": None}, "bytes"),
        (Dial, {"instruction": "mission"}, "no instruction 'mission'.*wanted"),
        (Dial, {"vocabulary": Vocabulary(["turn", "the"])}, "unknown word 'dial'"),
        (Dial, {"num_envs": 0}, "num_envs"),
        (Dial, {"stop": 7}, "stop must be an action 0..2"),
        (Dial, {"stop": 3}, "stop must be an action 0..2 or 'add', got 3"),
        (Dial, {"stop": 2.0}, "stop must be a whole number, got 2.0"),
        (Dial, {"stop": True}, "stop must be a whole number"),
        (Dial, {"stop": "press"}, "stop"),
        (Dial, {"num_envs": 2.5}, "num_envs must be a whole number, got 2.5"),
        (Dial, {"vocabulary": ["turn"]}, "vocabulary is a Vocabulary.*got list"),
        (Dial(), {}, "its class, got Dial"),
        (lambda: "dial", {}, "a world is a gymnasium.Env, got str"),
        (Dial, {"stream": "test"}, "stream"),
        (Dial, {"max_steps": 3}, "in your function"),
        (lambda: Odd(np.zeros((20, 28, 3))), {}, "bytes .* float64"),
        (lambda: Odd(np.zeros((20, 28, 5), np.uint8)), {}, "channels"),
        (
            lambda: Odd(np.zeros((20, 28), np.uint8), gymnasium.spaces.Box(0, 1, (2,))),
            {},
            "Discrete",
        ),
    ],
)
def test_worlds_that_do_not_fit_are_refused(make, options, said):
    with pytest.raises(UserError, match=said):
        from_gymnasium(make, **{"seed": 0, **DIAL, **options})


def test_an_image_keeps_its_size():
    world = Odd(np.zeros((20, 28, 3), np.uint8))
    env = from_gymnasium(lambda: world, seed=0, **DIAL)
    world.view = np.zeros((20, 30, 3), np.uint8)
    with pytest.raises(UserError, match=r"was \[3, 20, 28\] and is now \[3, 20, 30\]"):
        env.reset()


@pytest.mark.parametrize("stop", [None, PRESS])
@pytest.mark.parametrize("action", [-1, 3])
def test_actions_that_the_world_has_not_are_refused(stop, action):
    env = dials(2, stop=stop)
    with pytest.raises(UserError, match=r"actions are 0\.\.2 here.*another world"):
        env.step(env.reset().set("action", torch.tensor([0, action])))


@pytest.mark.parametrize(("stop", "named"), [(None, None), (PRESS, PRESS), ("add", 3)])
def test_it_says_which_action_is_the_stop(stop, named):
    env = dials(20, stop=stop, instructed=False)
    assert env.stop_action == named
    buffer, report = collect_transitions(env, 300)
    sample = buffer[:]
    unchanged = (sample["pixels"] == sample["next", "pixels"]).flatten(1).all(1)
    assert set(sample["action"][unchanged].tolist()) == ({named} if stop is not None else set())
    # Pressing shows nothing: without a stop it cannot be told from a bump.
    assert (report.kept[PRESS] > 0) == (named == PRESS)

    model = TensorDictModule(lambda pixels: torch.ones(len(pixels), 1), ["pixels"], ["goal_score"])
    if stop is None:
        return
    paid = TransformedEnv(env, GoalReward(model, stop_action=env.stop_action))
    rollout = paid.rollout(20, break_when_any_done=False)
    stopped = rollout["action"] == named
    assert stopped.any() and torch.equal(rollout["next", "learned_reward"][..., 0] > 0, stopped)
    assert torch.equal(rollout["next", "terminated"][..., 0], stopped)


@pytest.mark.parametrize("shape", [(20, 28), (1, 20, 28), (20, 28, 1), (3, 20, 28)])
def test_images_come_in_every_usual_order(shape):
    env = from_gymnasium(lambda: Odd(np.zeros(shape, np.uint8)), seed=0, **DIAL)
    channels = 3 if 3 in shape else 1
    assert env.reset()["pixels"].shape == (1, channels, 20, 28)


def test_episodes_that_begin_in_inference_mode_go_on_outside():
    with torch.inference_mode():
        env = dials(3)
        env.rollout(5, break_when_any_done=False)
    assert env.rollout(20, break_when_any_done=False).shape == (3, 20)


def test_a_world_that_is_refused_is_closed():
    opened = []

    class Kept(Dial):
        closed = False

        def __init__(self):
            super().__init__()
            opened.append(self)

        def close(self):
            self.closed = True

    with pytest.raises(UserError, match="stop must be an action"):
        from_gymnasium(Kept, seed=0, stop=77, **DIAL)
    assert opened and all(world.closed for world in opened)
