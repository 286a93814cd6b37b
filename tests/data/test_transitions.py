"""Random transitions: what is taken, kept and stored."""

import warnings
from functools import partial

import pytest
import torch
from torchrl.data import Categorical, LazyTensorStorage, OneHot
from torchrl.envs import ParallelEnv, SerialEnv, StepCounter, Transform, TransformedEnv

from ifo_grounding.data import Collected, Demonstrations, collect_transitions
from ifo_grounding.data.transitions import RandomActions
from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.errors import UserError
from ifo_grounding.world import Layout
from transforms.counter_world import STOP, CounterWorld


def make_env(num_envs: int = 16, **options) -> PickAndPlaceEnv:
    return PickAndPlaceEnv("pick", num_envs=num_envs, seed=0, **options)


def unchanged(sample) -> torch.Tensor:
    return (sample["pixels"] == sample["next", "pixels"]).flatten(1).all(1)


def test_actions_explain_what_changed():
    buffer, report = collect_transitions(make_env(), 800, seed=1)
    assert int(report.taken.sum()) == 800
    assert len(buffer) == int(report.kept.sum()) < 800
    everything = buffer[:]
    action = everything["action"]
    assert torch.equal(action.bincount(minlength=6), report.kept)
    assert torch.equal(unchanged(everything), action == 5)
    corners = (everything["pixels"][:, :, ::8, ::8] == 255).all(1).flatten(1).float().argmax(1)
    after = everything["next", "pixels"][:, :, ::8, ::8]
    moved = (after == 255).all(1).flatten(1).float().argmax(1) - corners
    step = torch.tensor([-6, 1, 6, -1, 0, 0])
    assert torch.equal(moved, step[action])


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_stops_are_kept_of_workers_in_processes():
    make = partial(PickAndPlaceEnv, "move", num_envs=4, instructed=False)
    makers = [partial(make, seed=number) for number in range(2)]
    workers = TransformedEnv(ParallelEnv(2, makers, mp_start_method="fork"), StepCounter())
    try:
        report = collect_transitions(workers, 100, seed=0).report
    finally:
        workers.close()
    assert int(report.kept[5]) == int(report.taken[5]) > 0


def test_the_stop_can_be_rare():
    _, report = collect_transitions(make_env(), 1200, stop_probability=0.02)
    assert abs(report.taken[5] - 24) < 20
    assert (report.taken[:5] - 235).abs().max() < 60
    _, report = collect_transitions(make_env(), 100, stop_probability=0.0)
    assert report.taken[5] == 0


def test_same_seeds_same_transitions():
    first, second = (collect_transitions(make_env(), 300, seed=4).buffer[:] for _ in range(2))
    other = collect_transitions(make_env(), 300, seed=5).buffer[:]
    assert (first == second).all()
    assert first.shape != other.shape or not torch.equal(first["action"], other["action"])


@pytest.mark.parametrize("n", [1, 5, 16, 37])
def test_any_number_of_steps_is_taken_exactly(n):
    _, report = collect_transitions(make_env(), n, drop_unchanged=False)
    assert int(report.taken.sum()) == n


def test_wrapped_environments_serve_too():
    plain = partial(PickAndPlaceEnv, "move", num_envs=2, seed=0, instructed=False)
    serial = SerialEnv(2, plain)
    with pytest.warns(UserWarning, match="several workers begin with the same image: unless"):
        collect_transitions(serial, 8, drop_unchanged=False)
    serial.set_seed(0)
    for env in (TransformedEnv(plain(), StepCounter()), serial):
        with warnings.catch_warnings():
            warnings.simplefilter("error", UserWarning)
            everything = collect_transitions(env, 60, drop_unchanged=False).buffer[:]
        assert everything.shape == (60,) and everything["pixels"].shape == (60, 3, 48, 48)
    assert not serial.is_closed
    serial.close()


def test_a_transform_of_the_buffer_sees_images(tmp_path):
    """Not the codes that they are stored as."""

    class Inverted(Transform):
        def _apply_transform(self, pixels):
            return 255 - pixels

    seen = ["pixels", ("next", "pixels")]
    plain = collect_transitions(make_env(), 200)
    plain.save(tmp_path / "transitions")
    inverted, _ = collect_transitions(make_env(), 200, transform=Inverted(seen, seen))
    loaded, _ = Collected.load(tmp_path / "transitions", transform=Inverted(seen, seen))
    for buffer in (inverted, loaded):
        assert buffer[:]["pixels"].equal(255 - plain.buffer[:]["pixels"])
        assert buffer[:]["next", "pixels"].equal(255 - plain.buffer[:]["next", "pixels"])
    with pytest.raises(UserError, match="leave storage out"):
        collect_transitions(make_env(), 20, storage=LazyTensorStorage(20))


def test_saved_transitions_are_the_same(tmp_path):
    collected = collect_transitions(make_env(), 400)
    collected.save(tmp_path / "t")
    loaded = Collected.load(tmp_path / "t", batch_size=5)
    assert (loaded.buffer[:] == collected.buffer[:]).all()
    assert torch.equal(loaded.report.taken, collected.report.taken)
    assert loaded.buffer.sample().shape == (5,)
    with pytest.raises(UserError, match="holds 'ifo-grounding transitions', not"):
        Demonstrations.load(tmp_path / "t")
    (tmp_path / "t" / "action.npy").unlink()
    with pytest.raises(UserError, match=r"action\.npy is missing"):
        Collected.load(tmp_path / "t")


def test_bad_input_is_refused():
    env = make_env()
    with pytest.raises(UserError, match="n must be at least 1"):
        collect_transitions(env, 0)
    with pytest.raises(UserError, match=r"stop_action must be 0\.\.5, got 6"):
        collect_transitions(env, 10, stop_action=6)
    env.action_spec = OneHot(6, shape=(16, 6))
    with pytest.raises(UserError, match="need one categorical action"):
        collect_transitions(env, 10)
    env.action_spec = Categorical(6, shape=(16,))
    assert RandomActions(env).n_actions == 6


def test_nothing_kept_is_said():
    env = PickAndPlaceEnv("pick", num_envs=1, seed=0, layout=Layout(objects=(1, 1), boxes=(1, 1)))
    always_pick = {"stop_action": 0, "stop_probability": 0.0}
    taken = [RandomActions(env, **always_pick, seed=seed) for seed in range(40)]
    picks = [policy(env.reset())["action"].item() == 4 for policy in taken]
    with pytest.raises(UserError, match="none of 1 steps changed anything"):
        collect_transitions(env, 1, seed=picks.index(True), **always_pick)


def test_who_does_not_say_which_action_is_the_stop_is_asked():
    env = make_env()
    env.stop_action = "press"
    with pytest.raises(UserError, match="stop_action must be a whole number, got 'press'"):
        collect_transitions(env, 10)
    silent = CounterWorld((4,))
    with pytest.raises(UserError, match="does not say which action is its stop"):
        collect_transitions(silent, 10)
    every = collect_transitions(silent, 40, drop_unchanged=False).report
    assert torch.equal(every.kept, every.taken)
    report = collect_transitions(silent, 40, stop_action=STOP).report
    assert report.kept[STOP] == report.taken[STOP]
