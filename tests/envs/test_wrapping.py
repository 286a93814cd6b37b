"""Worlds that the project did not make, behind its keys."""

from functools import partial

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete, MultiBinary, MultiDiscrete
from gymnasium.wrappers import FrameStackObservation, TimeLimit
from tensordict import TensorDict
from torchrl.envs import check_env_specs

from envs.dial import DIAL, MARKS, PRESS, WORDS, Dial, dials
from ifo_grounding.envs import from_gymnasium, wrapping
from ifo_grounding.errors import UserError
from ifo_grounding.networks import make_policy
from ifo_grounding.tasks import VOCABULARY, Vocabulary


def test_an_id_is_made_with_its_options():
    keys = {"vocabulary": VOCABULARY, "image": "pixels", "instruction": "instruction_text"}
    td = from_gymnasium("ifo_grounding/Move-v0", num_envs=2, tile_size=16, **keys).reset()
    assert td["pixels"].shape == (2, 3, 96, 96)
    assert all(VOCABULARY.decode(td["instruction"]))


def shown(pixels):
    """Where each dial [N, 3, 20, 28] stands."""
    return (pixels[:, 0, 10, 2::4] > 100).int().argmax(-1)


def wanted(td):
    return torch.tensor([MARKS.index(text.split()[-1]) for text in WORDS.decode(td["instruction"])])


def knows(td):
    """Turn the dial to the mark of the instruction, and press."""
    away = wanted(td) - shown(td["pixels"])
    return td.set("action", torch.where(away == 0, PRESS, (away > 0).long()))


def test_instructions_and_rewards_are_the_world_s():
    env = dials(6)
    td = env.reset()
    asked = wanted(td)
    assert (shown(td["pixels"]) != asked).all()
    earned = torch.zeros(6)
    for _ in range(6):
        there = shown(td["pixels"]) == asked
        td = env.step(knows(td))
        assert torch.equal(td["next", "terminated"].squeeze(-1), there)
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


@pytest.mark.parametrize(("stop", "actions", "action"), [("add", 4, 3), (PRESS, 3, PRESS)])
@pytest.mark.parametrize("instructed", [True, False])
def test_a_policy_can_say_that_it_is_done(stop, actions, action, instructed):
    env = dials(2, stop=stop, instructed=instructed)
    check_env_specs(env)
    assert env.action_spec.space.n == actions
    assert env.stop_action == action and dials(2).stop_action is None
    td = env.reset()
    after = env.step(td.set("action", torch.tensor([0, action])))["next"]
    assert after["terminated"].flatten().tolist() == [False, True]
    assert not after["truncated"].any()
    assert torch.equal(after["pixels"][1], td["pixels"][1])
    assert not after["reward"].any()


def test_processes_show_what_one_process_shows(monkeypatch):
    forked = partial(wrapping.AsyncVectorEnv, context="fork")  # for speed
    monkeypatch.setattr(wrapping, "AsyncVectorEnv", forked)
    apart, together = dials(2, processes=True), dials(2)
    for env in (apart, together):
        torch.manual_seed(0)
        env.seen = env.rollout(10, break_when_any_done=False)
    apart.close()
    for key in ("pixels", "instruction", "action", ("next", "reward")):
        assert torch.equal(apart.seen[key], together.seen[key])


def test_words_that_nobody_taught_can_be_left_out():
    known = Vocabulary.from_sentences(["turn the dial to one"], length=6)
    with pytest.raises(UserError, match="unknown word"):
        dials(6, vocabulary=known)
    read = known.decode(dials(6, vocabulary=known, skip_unknown=True).reset()["instruction"])
    assert "turn the dial to" in read and set(read) <= {"turn the dial to", "turn the dial to one"}


class Odd(Dial):
    def __init__(self, view, task="turn the dial to one"):
        super().__init__()
        self.seen = {"view": view, "task": task}

    def _observe(self):
        return self.seen


def like(**parts):
    """A dial of which some parts are others."""
    return type("Like", (Dial,), parts)


SAME, GREY = Dial(), np.zeros((20, 28), np.uint8)


@pytest.mark.parametrize(
    ("make", "options", "said"),
    [
        (Dial, {"image": "picture"}, "no image 'picture'.*task.*view"),
        (Dial, {"image": None}, "bytes"),
        (Dial, {"instruction": "mission"}, "no instruction 'mission'.*wanted"),
        (Dial, {"vocabulary": Vocabulary(["turn", "the"])}, "unknown word 'dial'"),
        (Dial, {"stop": 3}, "stop must be an action 0..2 or 'add', got 3"),
        (Dial, {"stop": "press"}, r"stop must be an action 0\.\.2 or 'add', got 'press'"),
        (Dial, {"vocabulary": ["turn"]}, "vocabulary is a Vocabulary.*got list"),
        (Dial(), {}, "its class, got Dial"),
        (lambda: "dial", {}, "a world is a gymnasium.Env, got str"),
        (Dial, {"stream": "test"}, "stream"),
        (Dial, {"max_steps": 3}, "in your function"),
        (lambda: Odd(np.zeros((20, 28, 3))), {}, "bytes .* float64"),
        (partial(Odd, GREY, np.array([3, 1])), {}, r"is text, got ndarray array\(\[3, 1\]\)"),
        (partial(Odd, GREY, None), {}, "an instruction is text, got NoneType"),
        (lambda: gymnasium.Wrapper(SAME), {"num_envs": 2}, "returned the same one twice"),
        (like(action_space=MultiDiscrete([3, 2])), {}, r"index\(a, \(3, 2\)\)\), Discrete\(6\)"),
        (like(action_space=MultiBinary(3)), {}, r"index\(a, \(2, 2, 2\)\)\), Discrete\(8\)"),
        (like(action_space=Box(0, 1, (2,))), {}, "TransformAction.*continuous ones are not"),
        (like(reset=lambda self, seed: Dial.reset(self)[0]), {}, "Like.reset must return .* dict"),
        (like(reset=lambda self: Dial.reset(self)), {}, "Like.reset takes no seed"),
        (Dial, {"instructed": "no"}, "instructed 'no': choose one of True, False"),
    ],
)
def test_worlds_that_do_not_fit_are_refused(make, options, said):
    with pytest.raises(UserError, match=said):
        from_gymnasium(make, **{"seed": 0, **DIAL, **options})


def outcome(reward=0.0, **seen):
    return lambda self, action: ({**self._observe(), **seen}, reward, False, False, {})


@pytest.mark.parametrize(
    ("step", "said"),
    [
        (outcome(None), "Like pays None: a reward is one finite number"),
        (outcome(float("nan")), "Like pays nan"),
        (outcome(["a", 2.0]), "Like pays"),
        (outcome(task="press"), "Like changed in an episode, from 'turn the dial .* to 'press'"),
        (lambda self, action: Dial.step(self, action)[:4], "Like.step must return .* 4 values"),
    ],
)
def test_steps_that_do_not_fit_are_refused(step, said):
    for make in (like(step=step), lambda: TimeLimit(like(step=step)(), 9)):
        env = from_gymnasium(make, seed=0, **DIAL)
        with pytest.raises(UserError, match=said):
            env.rollout(1)


def test_actions_are_numbered_from_0_and_a_reward_may_be_an_array():
    def step(self, action):
        seen, reward, *rest = Dial.step(self, action - 1)
        return seen, np.array([reward]), *rest

    env = from_gymnasium(
        like(action_space=Discrete(3, start=1), step=step), num_envs=3, seed=0, stop=PRESS, **DIAL
    )
    rolled = [each.rollout(9, knows) for each in (env, dials(3, stop=PRESS))]
    assert (rolled[0] == rolled[1]).all() and rolled[0]["next", "reward"].any()


def test_a_sentence_of_ones_own_is_refused_or_obeyed():
    own = WORDS.encode("turn the dial to one").expand(3, -1)
    env = dials(3)
    with pytest.raises(UserError, match="the world sets it"):
        env.step(env.rand_action(env.reset().set("instruction", own)))
    with pytest.raises(UserError, match="the world sets it"):
        env.reset(TensorDict({"instruction": own}, [3]))
    free = dials(3, instructed=False, stop=PRESS)
    begun = free.reset().set("instruction", own)
    obeyed = free.rollout(9, knows, auto_reset=False, tensordict=begun)
    assert (obeyed["instruction"] == own.unsqueeze(1)).all()
    assert (shown(obeyed["next", "pixels"][:, -1]) == 0).any()


def test_an_image_keeps_its_size():
    world = Odd(np.zeros((20, 28, 3), np.uint8))
    env = from_gymnasium(lambda: world, seed=0, **DIAL)
    world.seen["view"] = np.zeros((20, 30, 3), np.uint8)
    with pytest.raises(UserError, match=r"was \[3, 20, 28\] and is now \[3, 20, 30\]"):
        env.reset()


@pytest.mark.parametrize(
    ("shape", "channels"),
    [
        *([(20, 28), 1], [(1, 20, 28), 1], [(20, 28, 1), 1], [(3, 20, 28), 3]),
        *([(20, 28, 12), 12], [(12, 20, 28), 12], [(4, 20, 28, 3), 12], [(4, 3, 20, 28), 12]),
    ],
)
def test_images_come_in_every_usual_order(shape, channels):
    env = from_gymnasium(lambda: Odd(np.zeros(shape, np.uint8)), seed=0, **DIAL)
    assert env.reset()["pixels"].shape == (1, channels, 20, 28)


def test_gymnasium_s_stacked_frames_are_channels():
    env = from_gymnasium(lambda: FrameStackObservation(Dial(), 2), seed=0, **DIAL)
    seen = env.rollout(3, make_policy(env))["next"]
    assert torch.equal(seen["pixels"][0, 1:, :3], seen["pixels"][0, :-1, 3:])
    assert WORDS.decode(seen["instruction"][0, :1])[0].startswith("turn the dial")


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


class Coded(gymnasium.Wrapper):
    """A dial whose image is the numbers of two tiles, one dark and one light."""

    def __init__(self, tiles):
        super().__init__(Dial())
        self.tiles = tiles
        self.observation_space = gymnasium.spaces.Dict(
            {**self.env.observation_space, "view": MultiDiscrete(np.full((2, 3), 2), np.int16)}
        )

    def reset(self, **options):
        seen, info = self.env.reset(**options)
        return self.code(seen), info

    def step(self, action):
        seen, *rest = self.env.step(action)
        return self.code(seen), *rest

    def code(self, seen):
        return {**seen, "view": np.array([[0, 1, 1], [1, 0, 1]], np.int16)}


def test_a_world_may_show_numbers_of_its_tiles():
    tiles = torch.tensor([0, 255], dtype=torch.uint8).view(2, 1, 1, 1).expand(2, 3, 8, 8)
    env = from_gymnasium(lambda: Coded(tiles), num_envs=2, seed=0, **DIAL)
    check_env_specs(env)
    td = env.reset()
    assert td["pixels"].dtype == torch.int16 and torch.equal(env.tiles, tiles)
    policy = make_policy(env, seed=0)
    codes = policy(td.clone())["logits"]
    drawn = tiles[td["pixels"].long()].permute(0, 3, 1, 4, 2, 5).reshape(2, 3, 16, 24)
    torch.testing.assert_close(policy(td.set("pixels", drawn))["logits"], codes)
    with pytest.raises(UserError, match="tiles are uint8"):
        from_gymnasium(lambda: Coded(tiles.float()), **DIAL)
    with pytest.raises(UserError, match="images are bytes"):
        from_gymnasium(lambda: Coded(None), **DIAL)
