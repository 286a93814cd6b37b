import contextlib
import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.envs import Compose, GymEnv, ParallelEnv, SerialEnv, StepCounter, TransformedEnv

from ifo_grounding import keys
from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.errors import UserError
from ifo_grounding.networks import Shapes, make_reward_model
from ifo_grounding.objectives import RewardLoss
from ifo_grounding.training import (
    AdversarialUpdates,
    SelfExaminationConfig,
    self_examine,
)
from ifo_grounding.training.self_examination import summary
from ifo_grounding.transforms import LearnedReward, StartingPairs
from training import tiny


def grouped():
    """A group of transforms in another."""
    inner = Compose(tiny.sampler(), LearnedReward(tiny.likes(1)))
    return TransformedEnv(tiny.simulator(), Compose(StepCounter(9), inner))


def of_pairs():
    """Stored pairs, in an environment that is transformed once more."""
    started = TransformedEnv(tiny.simulator(8), StartingPairs(tiny.pairs()))
    return TransformedEnv(started, LearnedReward(tiny.likes(1)))


@pytest.mark.parametrize(("algorithm", "name"), [("ppo", "worth"), ("reinforce", "state_value")])
def test_a_policy_learns_what_the_reward_model_likes(algorithm, name):
    """Whatever the name under which the value is written."""
    chosen = tiny.config(algorithm=algorithm, iterations=3, **tiny.TEACH)
    networks = tiny.make_networks(name)
    history = self_examine(tiny.make_env(tiny.likes(1), 32), *networks, chosen, seed=0)
    assert history[0]["learned_reward"] < 0.35
    assert history[-1]["learned_reward"] > 0.6


def test_value_warm_up_leaves_the_policy_as_it_was():
    policy, value = tiny.make_networks()
    both, seen = (policy, value), []
    before = [tiny.weights(each) for each in both]

    def watch(iteration):
        now = [tiny.weights(each) for each in both]
        seen.append([*map(tiny.same, now, before)])
        return {}

    chosen = tiny.config(iterations=3, value_warmup=2, evaluate_every=1)
    self_examine(tiny.make_env(), policy, value, chosen, seed=0, callback=watch)
    assert seen == [[True, False], [True, False], [False, False]]
    with pytest.raises(UserError, match="would never learn"):
        tiny.config(iterations=2, value_warmup=2)


def test_the_callback_runs_when_due_and_at_the_end():
    called, chosen = [], tiny.config(iterations=3, evaluate_every=2)
    measure = lambda done: called.append(done) or {"success": torch.tensor(0.5)}  # noqa: E731
    history = self_examine(tiny.make_env(), *tiny.make_networks(), chosen, seed=0, callback=measure)
    assert called == [2, 3]
    assert [metrics.get("success") for metrics in history] == [None, 0.5, 0.5]


def test_values_are_estimated_some_at_a_time_with_the_same_result(monkeypatch):
    learned = []
    for steps in (20, 10_000):  # five worlds, all sixteen
        monkeypatch.setattr("ifo_grounding.training.policy_gradient.AT_ONCE", steps)
        networks = tiny.make_networks()
        self_examine(tiny.make_env(), *networks, tiny.config(gamma=0.9), seed=0)
        learned.append(tiny.weights(*networks))
    torch.testing.assert_close(*learned, atol=1e-5, rtol=1e-3)


@pytest.mark.parametrize(("make", "anew"), [(grouped, True), (of_pairs, False)])
def test_a_killed_run_continues_to_the_same_weights(tmp_path, make, anew):
    chosen = tiny.config(iterations=3, select_every=1, select_episodes=8, max_steps=2)
    whole = tiny.make_networks()
    expected = self_examine(make(), *whole, chosen, seed=0)
    options = {"seed": 0, "checkpoint": tmp_path / "run.pt", "checkpoint_seconds": 0.0}
    env, networks, steps = make(), tiny.make_networks(), []
    with pytest.raises(KeyboardInterrupt):
        self_examine(env, *networks, chosen, log=tiny.kill_at(2), **options)
    if anew:
        env, networks = make(), tiny.make_networks()
    options["log"] = lambda _, step: steps.append(step)
    assert self_examine(env, *networks, chosen, **options) == expected
    assert steps == [2, 3]
    assert tiny.same(tiny.weights(*networks), tiny.weights(*whole))


@pytest.mark.filterwarnings("ignore:A lambda function was passed to ParallelEnv")
def test_worlds_may_live_in_workers():
    sampled = Compose(tiny.sampler(), LearnedReward(tiny.likes(1)))
    env = TransformedEnv(ParallelEnv(2, lambda: tiny.simulator(4), mp_start_method="fork"), sampled)
    with contextlib.closing(env):
        chosen = tiny.config(select_every=1, select_episodes=12, max_steps=3)
        history = self_examine(env, *tiny.make_networks(), chosen, seed=0)
    assert history[-1]["frames"] == 2 * 4 * 4
    assert history[-1]["selection_return"] > 0


def test_starts_inside_of_workers_are_refused():
    pairs = tiny.pairs()

    def worker(number):
        mine = pairs[12 * number : 12 * (number + 1)]
        return lambda: TransformedEnv(tiny.simulator(4), StartingPairs(mine, seed=number))

    env = TransformedEnv(SerialEnv(2, [worker(0), worker(1)]), LearnedReward(tiny.likes(1)))
    with pytest.raises(UserError, match="do without workers"):
        self_examine(env, *tiny.make_networks(), tiny.config(), seed=0)


def test_no_true_reward_reaches_the_learner():
    seen, model = [], make_reward_model(Shapes((3, 48, 48), 64, tile_size=8), features=16, seed=0)

    class Spy(AdversarialUpdates):
        def __call__(self, batch):
            seen.append(set(batch.keys(True, True)))
            return {}

    spy, once = Spy(RewardLoss(model), None, 1, 1e-3), tiny.config(iterations=1)
    self_examine(tiny.make_env(), *tiny.make_networks(), once, seed=0, adversarial=spy)
    assert (keys.NEXT, keys.LEARNED_REWARD) in seen[0]
    assert (keys.NEXT, keys.REWARD) not in seen[0]
    assert not any("state" in str(key) and "value" not in str(key) for key in seen[0])


def instructed():
    return PickAndPlaceEnv("move", 4, seed=0)


def of_gymnasium():
    return GymEnv("ifo_grounding/Move-v0", categorical_action_encoding=True)


def exposed():
    return tiny.simulator(4, expose_state=True)


def unpaid():
    return TransformedEnv(tiny.simulator(), tiny.sampler())


@pytest.mark.parametrize(
    ("make", "error"),
    [
        (exposed, "never sees the true state"),
        (lambda: SerialEnv(2, exposed), "never sees the true state"),
        (instructed, "never sees true instructions"),
        (lambda: SerialEnv(2, instructed), "never sees true instructions"),
        (lambda: SerialEnv(2, of_gymnasium), "never sees true instructions"),
        (tiny.simulator, "no instructions"),
        (unpaid, "no learned reward"),
    ],
)
def test_envs_that_leak_or_lack_something_are_refused(make, error):
    with pytest.raises(UserError, match=error):
        self_examine(make(), *tiny.make_networks(), tiny.config(), seed=0)


@pytest.mark.parametrize(
    "wrong",
    [
        *({"algorithm": "dqn"}, {"iterations": 0}, {"minibatch": 0}, {"max_steps": 2.5}),
        *({"clip": math.nan}, {"select_margin": math.nan}, {"lr": math.inf}, {"lr": "fast"}),
        *({"gamma": 1.5}, {"entropy": -1.0}, {"select_every": -1}),
    ],
    ids=str,
)
def test_impossible_configs_are_refused(wrong):
    with pytest.raises(UserError):
        SelfExaminationConfig(**wrong)


def test_policies_that_are_no_actors_are_refused():
    policy, value = tiny.make_networks()
    for wrong in (TensorDictSequential(policy), policy[0]):
        with pytest.raises(UserError, match=r"must be an actor.*Sequential\(\*others, \*actor\)"):
            self_examine(tiny.make_env(), wrong, value, tiny.config(), seed=0)


def test_the_summary_counts_by_hand():
    done, terminated = torch.zeros(2, 16, 4, 1).bool()
    done[[0, 1, 2], [3, 3, 1]] = True
    terminated[[0, 2], [3, 1]] = True
    reward = torch.full((16, 4, 1), 0.25)
    batch = {"done": done, "terminated": terminated, "learned_reward": reward}
    # Of 16 rows: ends after 4, 4 and 2 steps, 14 rows are cut.
    said = summary(TensorDict({"next": batch}, [16, 4]))
    assert said["frames"] == 64
    assert said["episode_length"] == pytest.approx(10 / 3)
    assert said["learned_return"] == pytest.approx(2.5 / 3)
    assert said["stopped"] == pytest.approx(2 / 3)
    assert said["unfinished"] == pytest.approx(14 / 17)


def test_a_policy_that_diverges_does_not_act_again():
    with pytest.raises(UserError, match=r"diverged: loss_.* lower lr"):
        self_examine(tiny.make_env(), *tiny.make_networks(), tiny.config(lr=1e30), seed=0)
