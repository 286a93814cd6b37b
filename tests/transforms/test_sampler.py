"""InstructionSampler: what it writes, whose states it redraws, whom it refuses."""

import copy
import pickle

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, SerialEnv, StepCounter, TransformedEnv

from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.errors import UserError
from ifo_grounding.transforms import InstructionSampler, NothingSuitableError
from transforms.counter_world import POOL, CounterWorld, classifier, constant, shown


def make(batch=(4,), *before, model=None, pool=POOL, world=None, **options):
    sampler = InstructionSampler(model or classifier(), pool, **options)
    world = world or CounterWorld(batch)
    return TransformedEnv(world, Compose(*before, sampler) if before else sampler)


def suits(tensordict):
    return tensordict["instruction"][..., 0] - 1 > shown(tensordict["pixels"])


def test_unsuitable_states_are_drawn_again_for_those_rows_only():
    world = CounterWorld((10,))  # its ten scenes show ten numbers: only 9 has no instruction
    env = make(world=world)
    tensordict = env.reset()
    assert world.resets.tolist().count(2) == 1 and world.resets.sum() == 11
    assert suits(tensordict).all()
    assert torch.equal(shown(tensordict["pixels"]), world.number)


def go_up(tensordict):
    return tensordict.set("action", torch.zeros(tensordict.batch_size, dtype=torch.int64))


def test_same_seed_same_choices():
    def choices(seed):
        env = make((8,), candidates=3, seed=seed)
        return env.rollout(20, policy=go_up, break_when_any_done=False)["instruction"]

    assert torch.equal(choices(1), choices(1))
    assert not torch.equal(choices(1), choices(2))


def test_state_dict_resumes_the_choices():
    env, other = make((8,)), make((8,), seed=9)
    env.reset()
    other.reset()
    other.load_state_dict(env.state_dict())
    assert torch.equal(env.reset()["instruction"], other.reset()["instruction"])
    for each in (env, other):
        each.transform.set_seed(3)
        each.base_env.set_seed(0)
    assert torch.equal(env.reset()["instruction"], other.reset()["instruction"])


def test_copies_draw_alike_and_apart():
    sampler = InstructionSampler(classifier(), POOL)
    TransformedEnv(CounterWorld((6,)), sampler).reset()
    sampler.reset_parent()
    sampler.set_seed(0)
    for twin in (copy.deepcopy(sampler), pickle.loads(pickle.dumps(sampler))):
        assert twin.scorer.classifier is twin.classifier
        assert twin.classifier is not sampler.classifier
        env, other = (TransformedEnv(CounterWorld((6,)), one) for one in (sampler.clone(), twin))
        assert torch.equal(env.reset()["instruction"], other.reset()["instruction"])
        sampler.set_seed(0)


def test_stats_count_and_start_anew():
    env = make(world=CounterWorld((10,)), candidates=4, pool=POOL)
    env.reset()
    stats = env.transform.stats()
    assert stats["states_served"] == 10
    assert stats["states_drawn"] == env.base_env.resets.sum()
    assert stats["served_share"] == 10 / stats["states_drawn"]
    assert 10 <= stats["candidates_scored"] <= 4 * stats["states_drawn"]
    assert stats["mean_score"] == pytest.approx(torch.tensor(3.0).sigmoid().item())
    assert set(env.transform.stats().values()) == {0.0}


def test_environments_that_show_their_state_or_instruct_are_refused():
    for world in (
        CounterWorld((2,), expose_state=True),
        PickAndPlaceEnv("move", num_envs=2, instructed=False, expose_state=True),
        SerialEnv(2, lambda: CounterWorld((2,), expose_state=True)),
    ):
        with pytest.raises(UserError, match="exposes its true state"):
            make(world=world).reset()
    carried = SerialEnv(2, lambda: TransformedEnv(CounterWorld((2,)), StepCounter()))
    assert suits(make(world=carried).reset()).all()
    with pytest.raises(UserError, match="already writes 'instruction'"):
        make(world=CounterWorld((2,), instructed=True)).reset()


def test_stepping_without_an_instruction_says_so():
    env = make()
    tensordict = env.reset().exclude("instruction")
    with pytest.raises(UserError, match="step from what reset"):
        env.step(go_up(tensordict))


def test_called_on_states_it_chooses_for_each():
    world = CounterWorld((10,))
    states = world.reset().select("pixels").view(2, 5)
    sampler = InstructionSampler(classifier(), POOL)
    with pytest.raises(NothingSuitableError, match="1 of 10 states"):
        sampler(states)
    kept = states[shown(states["pixels"]) < 9]
    assert suits(sampler(kept)).all()


def test_what_a_buffer_stores_stays_as_it_is():
    sampler = InstructionSampler(classifier(), POOL)
    stored = TensorDict({"pixels": CounterWorld((4,)).reset()["pixels"]}, [4])
    before = stored.clone()
    assert "instruction" in sampler(stored) and "instruction" not in stored
    assert torch.equal(stored["pixels"], before["pixels"])
    assert sampler(stored[:0])["instruction"].shape == (0, POOL.shape[1])


def test_nothing_suitable_is_one_clear_line():
    env = make(max_tries=2)
    env.transform.classifier = constant(-9.0)  # another one takes the place of the first
    with pytest.raises(NothingSuitableError):
        env.reset()
    world = CounterWorld((3,))
    with pytest.raises(NothingSuitableError) as caught:
        make(world=world, model=constant(0.532), max_tries=7).reset()
    message = str(caught.value)
    for part in ("above 0.8", "7 states", "best score seen in this reset: 0.63", "lower threshold"):
        assert part in message
    assert "\n" not in message
    assert world.resets.tolist() == [7, 7, 7]
    assert isinstance(caught.value, UserError) and isinstance(caught.value, RuntimeError)


def test_impossible_options_are_refused_at_once():
    with pytest.raises(UserError, match="max_tries must be at least 1"):
        make(max_tries=0)


def test_specs_are_those_of_an_instructed_environment():
    world = PickAndPlaceEnv("move", num_envs=5, seed=0, instructed=False)
    env = make(world=world, model=constant(9.0), pool=torch.ones(1, 16).long())
    instructed = PickAndPlaceEnv("move", num_envs=5, seed=0)
    assert env.observation_spec["instruction"] == instructed.observation_spec["instruction"]
    assert env.state_spec["instruction"] == env.observation_spec["instruction"]
    assert make().observation_spec["instruction"].high.max() == 10
    small = CounterWorld((4,))
    small.vocabulary_size = 5
    with pytest.raises(UserError, match="token id 10, but the environment's vocabulary has 5 ids"):
        _ = make(world=small).observation_spec
