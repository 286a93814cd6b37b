"""Many worlds of Gymnasium, moved by one batched simulator."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.envs.gymnasium_envs import PickAndPlaceVectorEnv
from ifo_grounding.errors import UserError
from ifo_grounding.keys import STOP
from ifo_grounding.tasks import VOCABULARY, expert

UP = 0


def wise(env) -> np.ndarray:
    """Actions of the expert."""
    scene = env._simulator.scene
    return expert.act(scene.state, scene.wanted).numpy()


@pytest.mark.filterwarnings("error")  # Gymnasium's own logger ends in warnings.warn
def test_make_vec_is_native():
    envs = gymnasium.make_vec("ifo_grounding/Pick-v0", num_envs=5)
    assert isinstance(envs, PickAndPlaceVectorEnv)
    assert envs.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    observations, infos = envs.reset(seed=0)
    assert observations in envs.observation_space
    one = gymnasium.make("ifo_grounding/Pick-v0")
    assert envs.single_observation_space == one.observation_space
    assert envs.action_space.shape == (5,)
    said = VOCABULARY.decode(torch.from_numpy(observations["instruction"]))
    assert infos["instruction_text"].tolist() == said
    assert infos["_instruction_text"].all()


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_one_world_many_worlds_and_torchrl_agree(mode):
    """The same scenes and actions give the same pixels, words, rewards and ends in all three."""
    n, name = 6, "ifo_grounding/PickOut-v0"
    batch = PickAndPlaceEnv("pick-out", n, seed=9, max_steps=9)
    envs = gymnasium.make_vec(name, num_envs=n, autoreset_mode=mode, max_steps=9)
    one = gymnasium.make(name, max_steps=9)
    td, (seen, infos), (single, info) = batch.reset(), envs.reset(seed=9), one.reset(seed=9)
    draw = np.random.default_rng(0)
    live, success = np.ones(n, bool), 0.0
    while True:
        for name in ("pixels", "instruction"):
            assert np.array_equal(td[name].numpy()[live], seen[name][live])
            assert not live[0] or np.array_equal(single[name], seen[name][0])
        said = infos["instruction_text"][live].tolist()
        assert said == VOCABULARY.decode(td["instruction"][torch.from_numpy(live)])
        assert not live[0] or info["instruction_text"] == said[0]
        live = live & ~td["done"].squeeze(-1).numpy()
        if not live.any():
            break
        actions = np.where(draw.random(n) < 0.15, draw.integers(0, 6, n), wise(batch))
        td = batch.step(td.set("action", torch.from_numpy(actions)))["next"]
        seen, rewards, terminated, truncated, infos = envs.step(actions)
        ended = (terminated | truncated) & live
        paid = td.pop("reward").squeeze(-1).numpy()
        for key, flag in (("terminated", terminated), ("truncated", truncated)):
            assert np.array_equal(td[key].squeeze(-1).numpy()[live], flag[live])
        assert np.array_equal(paid[live], rewards[live])
        if live[0]:
            single, *outcome, info = one.step(int(actions[0]))
            assert outcome == [rewards[0], terminated[0], truncated[0]]
            assert info.get("is_success") == (bool(rewards[0]) if ended[0] else None)
        if mode is AutoresetMode.SAME_STEP and ended.any():
            for row in np.flatnonzero(infos["_final_obs"]):
                for name, last in infos["final_obs"][row].items():
                    seen[name][row] = last
            texts, final = infos["instruction_text"], infos["final_info"]
            infos = {**final, "instruction_text": np.where(ended, final["instruction_text"], texts)}
        if ended.any():
            assert infos["_is_success"][ended].all()
            assert np.array_equal(infos["is_success"][ended], rewards[ended] > 0)
        if mode is AutoresetMode.DISABLED and (terminated | truncated).any():
            envs.reset(options={"reset_mask": terminated | truncated})
        success += paid[live].sum()
    assert success > 0


def test_next_step_autoreset_takes_a_step_of_its_own():
    envs = gymnasium.make_vec("ifo_grounding/Move-v0", num_envs=3)
    first, _ = envs.reset(seed=0)
    ended, rewards, terminated, _, infos = envs.step(np.array([STOP, UP, STOP]))
    assert terminated.tolist() == [True, False, True]
    assert infos["_is_success"].tolist() == [True, False, True]
    assert np.array_equal(ended["pixels"][0], first["pixels"][0])
    # The action of an ended world is not looked at: it would stop the new episode.
    fresh, rewards, terminated, truncated, infos = envs.step(np.array([STOP, UP, STOP]))
    assert not (rewards.any() or terminated.any() or truncated.any())
    assert "is_success" not in infos
    stream = PickAndPlaceEnv("move", 5, seed=0).reset()["pixels"].numpy()
    assert np.array_equal(fresh["pixels"][[0, 2]], stream[[3, 4]])
    said = VOCABULARY.decode(torch.from_numpy(fresh["instruction"]))
    assert infos["instruction_text"].tolist() == said
    assert envs.step(np.array([STOP, UP, UP]))[2].tolist() == [True, False, False]


def test_without_autoreset_the_caller_resets():
    envs = PickAndPlaceVectorEnv("move", 3, autoreset_mode=AutoresetMode.DISABLED)
    before, _ = envs.reset(seed=0)
    envs.step(np.array([STOP, UP, STOP]))
    with pytest.raises(UserError, match="2 worlds have ended"):
        envs.step(np.array([UP, UP, UP]))
    mask = np.array([True, False, True])
    fresh, infos = envs.reset(options={"reset_mask": mask})
    assert infos["_instruction_text"].tolist() == mask.tolist()
    stream = PickAndPlaceEnv("move", 5, seed=0).reset()["pixels"].numpy()
    assert np.array_equal(fresh["pixels"][[0, 2]], stream[[3, 4]])
    assert np.array_equal(fresh["instruction"][1], before["instruction"][1])
    assert not envs.step(np.array([UP, UP, UP]))[2].any()


def test_observations_and_infos_are_new_at_every_call():
    envs = gymnasium.make_vec("ifo_grounding/Pick-v0", num_envs=3)
    kept, infos = envs.reset(seed=0)
    copies = {name: value.copy() for name, value in kept.items()}
    texts = infos["instruction_text"].copy()
    for _ in range(3):
        envs.step(np.array([STOP, UP, STOP]))
    assert all(np.array_equal(kept[name], copies[name]) for name in kept)
    assert infos["instruction_text"].tolist() == texts.tolist()


def test_gymnasium_s_vector_wrappers_work():
    envs = RecordEpisodeStatistics(gymnasium.make_vec("ifo_grounding/Move-v0", num_envs=4))
    envs.reset(seed=0)
    for _ in range(30):
        envs.step(wise(envs.unwrapped))
    assert len(envs.return_queue) >= 4
    assert set(envs.return_queue) == {1.0}
