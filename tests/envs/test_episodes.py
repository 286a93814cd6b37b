"""Episodes of the pick-and-place environment: steps, resets, own sentences, given states."""

import contextlib
import pickle
from functools import partial

import gymnasium
import pytest
import torch
from gymnasium.vector import VectorEnv
from tensordict import TensorDict

from envs.dial import dials
from envs.stepping import choose, everything
from ifo_grounding.data import babyai
from ifo_grounding.envs import PickAndPlaceEnv, from_gymnasium
from ifo_grounding.errors import UserError
from ifo_grounding.keys import STOP
from ifo_grounding.tasks import (
    TASKS,
    VOCABULARY,
    Goal,
    Plan,
    Scene,
    Vocabulary,
    draw_scenes,
    expert,
    grammar,
)
from ifo_grounding.world import WorldState, render
from ifo_grounding.world.dynamics import PICK_PLACE
from reference import LETTERS, act, holds, plain, wishes


@pytest.mark.parametrize("task", TASKS)
def test_steps_and_rewards_agree_with_the_plain_rules(task):
    env = PickAndPlaceEnv(task, 32, seed=0, max_steps=20)
    td = env.reset()
    start = worlds = plain(env.truth.state)
    goals = list(wishes(grammar(task).parse_tokens(td["instruction"])))
    draw = torch.Generator().manual_seed(0)
    ends = 0
    for time in range(20):
        guess = torch.randint(6, (32,), generator=draw)
        known = expert.act(env.truth.state, env.truth.wanted, draw)
        actions = torch.where(torch.rand(32, generator=draw) < 0.1, guess, known)
        after = choose(env, td, actions)
        worlds = [act(w, LETTERS[a]) for w, a in zip(worlds, actions.tolist(), strict=True)]
        assert plain(env.truth.state) == worlds
        assert torch.equal(after["pixels"], render(env.truth.state))
        over = [a == STOP or time == 19 for a in actions.tolist()]
        rewards = [
            float(ended and holds(first, world, goal))
            for first, world, goal, ended in zip(start, worlds, goals, over, strict=True)
        ]
        assert after["reward"].squeeze(-1).tolist() == rewards
        assert after["done"].squeeze(-1).tolist() == over
        ends += sum(rewards)
        td = after.exclude("reward")
    assert ends > 16


@pytest.mark.parametrize("late", [0, 1])  # the expert's last move is action 40, or comes too late
def test_success_counts_when_time_runs_out(late):
    env = PickAndPlaceEnv("pick", 64, seed=0)
    td = env.reset()
    scene = draw_scenes(*env._simulator.seeded, env.scene_numbers)
    idles = scene.state.objects[torch.arange(64), scene.state.arm] == 0  # P does nothing there
    assert idles.sum() > 30
    begins = 40 - (scene.wanted.steps - 1) + late
    for time in range(40):
        wise = expert.act(env.truth.state, scene.wanted)
        after = choose(env, td, torch.where(time < begins, PICK_PLACE, wise))
        td = after.exclude("reward")
        assert bool(after["truncated"].all()) == (time == 39)
        assert not after["terminated"].any()
        assert time == 39 or not after["reward"].any()
    assert after["done"].all()
    assert (after["reward"].squeeze(-1)[idles] == 1 - late).all()


@pytest.mark.parametrize("foreign", [False, True])
@pytest.mark.parametrize("instructed", [False, True])
def test_partial_resets_of_many_worlds_show_what_is_there(instructed, foreign):
    """So many that only what changed is drawn; with entries of others, as EnvBase resets them."""
    env = PickAndPlaceEnv("pick", 256, seed=0, instructed=instructed)
    td = env.reset()
    for turn in range(8):
        actions = 1 + torch.randint(5, (256,))
        running = choose(env, td, actions).exclude("reward").set("action", actions)
        assert torch.equal(running["pixels"], render(env._simulator.scene.state))
        numbers, mask = env.scene_numbers.clone(), torch.rand(256) < 0.2
        given = running.clone().set("_reset", mask.unsqueeze(-1))
        if foreign:
            given["logits"] = torch.full((256, 6), torch.inf)
            given["collector", "number"] = torch.arange(1, 257)
        td = env.reset(given)
        assert torch.equal(td["pixels"], render(env._simulator.scene.state))
        assert torch.equal(td["done"], running["done"] & ~mask.unsqueeze(-1))
        assert torch.equal(td["action"], actions * ~mask)
        assert torch.equal(env.scene_numbers != numbers, mask)
        assert "_reset" not in td
        if foreign:
            assert torch.equal(td["logits"] == 0, mask.unsqueeze(-1).expand(-1, 6))
            assert torch.equal(td["collector", "number"], torch.arange(1, 257) * ~mask)
        if instructed:
            began = draw_scenes(*env._simulator.seeded, env.scene_numbers)
            assert torch.equal(td["instruction"], began.instruction)
            assert torch.equal(env.truth.wanted.objects, began.wanted.objects)
        if turn % 2:  # twice, and a step, before anybody reads
            env._simulator.reset(mask & (mask.cumsum(0) < 4))
            env._simulator.step(torch.randint(5, (256,)))
            td.update(env._observe())
            assert torch.equal(td["pixels"], render(env._simulator.scene.state))


def own(env, text, **more) -> TensorDict:
    """A reset to the scenes as they are, with another instruction."""
    tokens = VOCABULARY.encode(text).expand(env.num_envs, -1)
    scene = env.scene_numbers.unsqueeze(-1)
    return TensorDict({"scene": scene, "instruction": tokens, **more}, [env.num_envs])


def reachable(start) -> list:
    """All that public names lead to, from object to object."""
    found, waiting = {}, [start]
    while waiting:
        one = waiting.pop()
        if id(one) in found:
            continue
        found[id(one)] = one
        if isinstance(one, dict | list | tuple):
            waiting += one.values() if isinstance(one, dict) else one
        elif type(one).__module__.split(".")[0] in ("ifo_grounding", "gymnasium", "minigrid"):
            for name in {*dir(one)} - {"truth"}:
                with contextlib.suppress(Exception):
                    waiting += [] if name.startswith("_") else [getattr(one, name)]
    return [*found.values()]


def rooms(**options):
    pytest.importorskip("minigrid")
    words = Vocabulary(["go", "to", "the", "red", "ball"])
    return from_gymnasium(babyai("GoToRedBallGrey", mission="none"), vocabulary=words, **options)


def test_a_reset_takes_one_s_own_sentence():
    env = PickAndPlaceEnv("move", 64, seed=0)
    first = env.reset().clone()
    td = env.reset(own(env, "move to the red circle"))
    assert torch.equal(td["pixels"], first["pixels"])
    assert set(VOCABULARY.decode(td["instruction"])) == {"move to the red circle"}
    suits = env.truth.wanted.verdict == 0
    assert 5 < suits.sum() < 60
    paid = torch.zeros(64, 1)
    for _ in range(12):
        td = choose(env, td, expert.act(env.truth.state, env.truth.wanted))
        paid += td.pop("reward")
    assert (paid[suits] >= 1).all()
    with pytest.raises(UserError, match="'put it' is no sentence of move"):
        env.reset(own(env, "put it"))
    anywhere = env.reset(own(env, "move to the red circle").exclude("scene"))
    assert set(VOCABULARY.decode(anywhere["instruction"])) == {"move to the red circle"}
    for name in ("pixels", "done"):  # what a past observation shows is no wish
        past = own(env, "move to the red circle", scene=torch.arange(64), **{name: td[name]})
        assert torch.equal(env.reset(past)["instruction"], first["instruction"])
    amid = env.reset().update(own(env, "move to the red circle").exclude("scene"))
    with pytest.raises(UserError, match=r"give it to reset\(\), in a TensorDict of 'scene'"):
        env.rollout(2, auto_reset=False, tensordict=amid)


@pytest.mark.parametrize("make", [partial(PickAndPlaceEnv, "pick"), dials, rooms])
def test_a_learner_s_environment_hides_what_is_true(make):
    """No public name leads to a state, a goal or the world; what is kept apart holds no goal."""
    env = make(num_envs=4, seed=0, instructed=False)
    env.rollout(3)
    hidden = WorldState | Scene | Plan | Goal | gymnasium.Env | VectorEnv
    assert not [one for one in reachable(env) if isinstance(one, hidden)]
    for spec in (env.output_spec, env.input_spec):
        parts = {part for key in spec.keys(True, True) for part in key}
        assert not {"state", "objects", "instruction"} & parts
    pickled = pickle.dumps(env)
    assert b"to the" not in pickled  # nor any sentence of a room
    if make in (dials, rooms):
        return
    with pytest.raises(UserError, match="keeps its true state to itself"):
        _ = env.truth
    for kept in (env, pickle.loads(pickled)):
        scenes = [kept._simulator.scene, draw_scenes(*kept._simulator.seeded, torch.arange(50))]
        assert not any(s.instruction.any() or s.wanted.objects.any() for s in scenes)


def test_the_state_is_hidden_or_what_the_pixels_show_all_along():
    env = PickAndPlaceEnv("pick", 4, seed=0)
    keys = set(everything(env.rollout(5)))
    assert not any("state" in key or "scene" in key for key in keys)
    assert not list(env.state_spec.keys(True, True))
    with pytest.raises(NotImplementedError, match="set_state"):
        env.reset(env.reset(), set_state=True)
    env = PickAndPlaceEnv("pick", 8, seed=0, expose_state=True)
    rollout = env.rollout(80, break_when_any_done=False)
    assert rollout["next", "done"].sum() > 20
    for td in (rollout, rollout["next"]):
        state = WorldState(**td["state"].to_dict(), batch_size=td.batch_size)
        assert torch.equal(render(state), td["pixels"])
