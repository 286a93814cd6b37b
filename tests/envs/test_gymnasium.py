import sys

import gymnasium
import numpy as np
import pygame
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from torchrl.envs import GymEnv, GymWrapper, check_env_specs

from ifo_grounding.envs.gymnasium_envs import PickAndPlaceGymEnv, PickAndPlaceVectorEnv
from ifo_grounding.envs.window import LINE_HEIGHT
from ifo_grounding.errors import UserError
from ifo_grounding.tasks import TASKS, VOCABULARY
from ifo_grounding.world import Layout, render

IDS = ("Move", "MoveUDLR", "Pick", "PickOut", "PickUDLR")
NAMES = {task: f"ifo_grounding/{name}-v0" for name, task in zip(IDS, TASKS, strict=True)}


def test_the_five_ids_are_registered_on_import():
    ours = {name for name in gymnasium.registry if name.startswith("ifo_grounding/")}
    assert ours == set(NAMES.values())
    for name in ours:
        assert gymnasium.spec(name).max_episode_steps is None  # the limit is the env's own


@pytest.mark.filterwarnings("error")  # Gymnasium's own logger ends in warnings.warn
def test_gymnasium_checks_pass_without_a_warning():
    check_env(gymnasium.make(NAMES["pick-out"]).unwrapped)


def test_spaces_and_infos_are_as_described_and_options_reach_the_world():
    env = gymnasium.make(NAMES["pick-out"], tile_size=16)
    pixels, instruction = env.observation_space["pixels"], env.observation_space["instruction"]
    assert (pixels.shape, pixels.dtype) == ((3, 96, 96), np.uint8)
    assert (instruction.shape, instruction.dtype) == ((16,), np.int64)
    assert env.action_space == gymnasium.spaces.Discrete(6)
    observation, info = env.reset(seed=0)
    assert observation in env.observation_space
    said = VOCABULARY.decode(torch.from_numpy(observation["instruction"]))
    assert said == [info["instruction_text"]]
    assert info.keys() == {"instruction_text"}
    options = {"split": "zero-shot", "holdout": "pairs-1", "stream": "evaluation"}
    layout = Layout(size=4, objects=(2, 3), boxes=(2, 2))
    observation, info = gymnasium.make(NAMES["pick"], layout=layout, **options).reset(seed=0)
    assert observation["pixels"].shape == (3, 32, 32)
    assert "yellow circle" in info["instruction_text"]


def test_a_seed_starts_its_stream_resets_go_on_and_a_scene_can_be_asked_for():
    env, other = gymnasium.make(NAMES["pick"]), gymnasium.make(NAMES["pick"])
    first, second = env.reset(seed=3)[0], env.reset()[0]
    assert not np.array_equal(first["pixels"], second["pixels"])
    assert np.array_equal(other.reset(seed=3)[0]["pixels"], first["pixels"])
    assert np.array_equal(other.reset()[0]["pixels"], second["pixels"])
    assert np.array_equal(env.reset(seed=3)[0]["pixels"], first["pixels"])
    assert not np.array_equal(env.reset(seed=4)[0]["pixels"], first["pixels"])
    env.reset(seed=0)
    frames = [env.reset()[0]["pixels"] for _ in range(3)]
    assert np.array_equal(env.reset(options={"scene": 2})[0]["pixels"], frames[1])


def test_the_seed_of_the_generator_decides_where_reset_names_none():
    frames = []
    for _ in range(2):
        env = PickAndPlaceGymEnv("pick")
        env.np_random = np.random.default_rng(7)
        frames.append(env.reset()[0]["pixels"])
    assert np.array_equal(*frames)


def drawn(env) -> np.ndarray:
    return render(env._worlds._simulator.scene.state, 32)[0].permute(1, 2, 0).numpy()


def test_rgb_array_is_drawn_large():
    env = gymnasium.make(NAMES["pick"], render_mode="rgb_array")
    env.reset(seed=0)
    frame = env.render()
    assert (frame.shape, frame.dtype) == ((192, 192, 3), np.uint8)
    assert np.array_equal(frame, drawn(env.unwrapped))


def in_the_window() -> np.ndarray:
    surface = pygame.display.get_surface()
    return pygame.surfarray.array3d(surface).swapaxes(0, 1)


def test_a_window_shows_the_world_and_the_instruction():
    env = PickAndPlaceGymEnv("pick", render_mode="human")
    env._window.fps = 0  # do not wait
    for seed in (0, 1):
        _, info = env.reset(seed=seed)
        assert pygame.display.get_caption()[0] == info["instruction_text"]
        shown = in_the_window()
        assert shown.shape == (192 + LINE_HEIGHT, 192, 3)
        assert np.array_equal(shown[:192], drawn(env))
        assert len(np.unique(shown[192:].reshape(-1, 3), axis=0)) > 10  # letters
    env.step(1)
    env.step(2)
    assert np.array_equal(in_the_window()[:192], drawn(env))
    assert not np.array_equal(in_the_window(), shown)
    assert env.render() is None
    env.close()
    assert not pygame.display.get_init()
    env.reset()  # opens again
    env.close()
    env.close()


@pytest.mark.parametrize("driver", [None, "x11"])
def test_a_window_needs_no_screen(monkeypatch, driver):
    for name in ("SDL_VIDEODRIVER", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.setenv(name, driver or "")  # so that it is put back as it was
        if name != "SDL_VIDEODRIVER" or driver is None:
            monkeypatch.delenv(name)
    env = PickAndPlaceGymEnv("move", render_mode="human")
    env.reset(seed=0)
    assert in_the_window().any()
    env.close()


def test_a_missing_pygame_is_explained(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(gymnasium.error.DependencyNotInstalled, match=r"ifo-grounding\[human\]"):
        PickAndPlaceGymEnv("move", render_mode="human")


def test_stable_baselines_trains_on_the_dict():
    envs = make_vec_env(NAMES["move"], n_envs=2, seed=0)
    model = PPO("MultiInputPolicy", envs, n_steps=64, batch_size=64, n_epochs=1, seed=0)
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    model.learn(128)
    after = model.policy.state_dict()
    changed = [name for name in before if not torch.equal(before[name], after[name])]
    assert any("cnn" in name for name in changed)
    assert any("action_net" in name for name in changed)
    assert len(model.ep_success_buffer) > 2  # it found info["is_success"]
    action, _ = model.predict(envs.reset())
    assert action.shape == (2,)


def test_torchrl_wraps_one_world_and_many():
    env = GymEnv(NAMES["move"])
    check_env_specs(env)
    rollout = env.rollout(50)
    assert rollout["pixels"].shape[1:] == (3, 48, 48)
    assert rollout["next", "done"][-1].item()
    # The mode that TorchRL prefers: it resets by itself.
    envs = gymnasium.make_vec(NAMES["move"], 3, autoreset_mode=AutoresetMode.DISABLED)
    env = GymWrapper(envs)
    assert env.batch_size == torch.Size([3])
    rollout = env.rollout(60, break_when_any_done=False)
    assert rollout["next", "done"].sum() >= 3
    assert rollout["next", "pixels"].shape == (3, 60, 3, 48, 48)


@pytest.mark.parametrize(
    ("kind", "wrong", "said"),
    [
        (PickAndPlaceGymEnv, {"render_mode": "ascii"}, "unknown render mode 'ascii'"),
        (PickAndPlaceVectorEnv, {"render_mode": "human"}, "unknown render mode 'human'"),
        (PickAndPlaceVectorEnv, {"num_envs": 0}, "num_envs must be at least 1"),
        (PickAndPlaceVectorEnv, {"autoreset_mode": "x"}, "mode 'x': choose one of 'NextStep'"),
    ],
)
def test_bad_arguments_are_refused(kind, wrong, said):
    with pytest.raises(UserError, match=said):
        kind(**wrong)


def test_bad_calls_are_refused():
    for unknown in ("instructed", "frame_skip"):
        with pytest.raises(TypeError, match=f"keyword argument '{unknown}'"):
            PickAndPlaceGymEnv(**{unknown: False})
    env, envs = PickAndPlaceGymEnv("move"), PickAndPlaceVectorEnv("move", 2)
    for call in (lambda: env.step(0), lambda: envs.step(np.array([0, 0]))):
        with pytest.raises(gymnasium.error.ResetNeeded, match="reset"):
            call()
    with pytest.raises(gymnasium.error.ResetNeeded, match="reset"):
        PickAndPlaceGymEnv("move", render_mode="rgb_array").render()
    env.reset(seed=0)
    envs.reset(seed=0)
    for action in (6, -1, 0.5, [0, 0]):
        with pytest.raises(UserError, match=r"allowed are 0\.\.5|one integer for each of 1 worlds"):
            env.step(action)
    for actions in ([0, 6], [0], [[0], [0]], [0.0, 1.0]):
        with pytest.raises(UserError, match=r"allowed are 0\.\.5|one integer for each of 2 worlds"):
            envs.step(np.array(actions))
    with pytest.raises(UserError, match="unknown reset option 'seen'"):
        env.reset(options={"seen": 3})
    with pytest.raises(UserError, match="one for each of 1 worlds"):
        env.reset(options={"scene": [3, 4]})
    with pytest.raises(UserError, match=r"reset_mask'\] must be bool \[2\]"):
        envs.reset(options={"reset_mask": np.array([True])})
