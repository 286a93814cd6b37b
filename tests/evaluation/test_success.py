"""Success is what it says: one episode per fixed scene."""

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import OneHot
from torchrl.envs import (
    RenameTransform,
    TransformedEnv,
)
from torchrl.envs.utils import ExplorationType, exploration_type

from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.errors import UserError
from ifo_grounding.evaluation import compare_success, success_rate
from ifo_grounding.networks import make_instruction_classifier, make_policy
from ifo_grounding.tasks import TASKS, grammar
from ifo_grounding.transforms import InstructionSampler, LearnedReward
from transforms.counter_world import CounterWorld


@pytest.mark.parametrize("task", TASKS)
def test_the_expert_always_succeeds_on_shortest_paths(task, make_expert):
    expert = make_expert(task)
    result = success_rate(expert, task, episodes=100, batch_size=40, expose_state=True)
    assert result.rate.rate == 1.0 and result.rate.count == 100
    assert result.stopped.rate == 1.0
    assert torch.equal(result.lengths, expert.steps(100))


def test_never_stopping_fails_at_the_step_limit(up):
    result = success_rate(up, "move", episodes=200)
    assert (result.lengths == 40).all() and result.stopped.successes == 0
    # Success counts at the limit too: in scenes where going up ends on the object.
    assert 0 < result.rate.successes < 20
    short = success_rate(up, "move", episodes=200, max_steps=3)
    assert (short.lengths == 3).all()


def test_scenes_depend_on_seed_and_stream_alone(make_expert, random_policy):
    def scenes(policy, **options):
        return success_rate(policy, "move", episodes=90, **options).scenes

    same = scenes(random_policy)
    assert same == scenes(random_policy, batch_size=40, mode="sampled")
    assert same == scenes(make_expert("move"), expose_state=True)
    others = {scenes(random_policy, seed=1), scenes(random_policy, stream="validation")}
    assert len({same, *others}) == 3


def test_short_episodes_are_not_favoured(make_expert):
    # Half of the scenes are given up at once: "the first 200 finished" would mostly be those.
    policy = make_expert("pick-out").on_even_scenes
    result = success_rate(policy, "pick-out", episodes=400, expose_state=True, batch_size=100)
    assert result.outcomes[0::2].all() and not result.outcomes[1::2].any()
    assert (result.lengths[1::2] == 1).all()
    assert result.rate.rate == 0.5


@pytest.fixture(scope="module")
def policy():
    """An untrained policy with dropout."""
    return make_policy(PickAndPlaceEnv("move", num_envs=1, seed=0), "paper", seed=0)


def test_greedy_and_sampled_are_reproducible_and_differ(policy):
    options = {"episodes": 60, "max_steps": 12}
    both = success_rate(policy, "move", mode="both", **options)
    assert (both.mode, both.sampled.mode) == ("greedy", "sampled")
    assert both.scenes == both.sampled.scenes
    again = success_rate(policy, "move", mode="both", **options)
    assert torch.equal(both.lengths, again.lengths)
    assert torch.equal(both.sampled.lengths, again.sampled.lengths)
    other = success_rate(policy, "move", mode="sampled", seed=1, **options)
    assert not torch.equal(both.sampled.lengths, other.lengths)
    assert both.as_dict()["sampled"]["mode"] == "sampled"


def test_greedy_takes_the_likeliest_action_whatever_the_batch(policy):
    seen = []

    def spy(td):
        seen.append(exploration_type())
        td = policy(td)
        assert torch.equal(td["action"], td["logits"].argmax(-1))
        return td

    first = success_rate(spy, "move", episodes=60, max_steps=12)
    second = success_rate(policy, "move", episodes=60, max_steps=12, batch_size=25)
    assert torch.equal(first.outcomes, second.outcomes)
    assert torch.equal(first.lengths, second.lengths)
    assert set(seen) == {ExplorationType.DETERMINISTIC}


class Watched(nn.Module):
    """Checks the modes of a policy, or fails."""

    def __init__(self, policy, broken=False):
        super().__init__()
        self.policy, self.broken = policy, broken

    def forward(self, td):
        assert not any(part.training for part in self.policy.modules())
        assert not torch.is_grad_enabled()
        if self.broken:
            raise RuntimeError("broken")
        return self.policy(td)


def test_modes_gradients_and_random_numbers_are_left_as_they_were(policy):
    policy.train()
    next(part for part in policy.modules() if isinstance(part, nn.Dropout)).eval()
    before = [part.training for part in policy.modules()]
    torch.manual_seed(7)
    expected = torch.rand(1)
    torch.manual_seed(7)
    success_rate(Watched(policy), "move", episodes=20, mode="sampled", max_steps=3)
    assert torch.rand(1) == expected
    assert [part.training for part in policy.modules()] == before
    with pytest.raises(RuntimeError, match="broken"):
        success_rate(Watched(policy, broken=True), "move", episodes=2)
    assert [part.training for part in policy.modules()] == before and torch.is_grad_enabled()
    policy.eval()


def test_a_given_pick_and_place_env_plays_the_scenes_of_its_task(random_policy):
    env = PickAndPlaceEnv("pick", num_envs=30, seed=9)
    options = {"episodes": 70, "seed": 4, "stream": "validation"}
    named = success_rate(random_policy, "pick", batch_size=30, **options)
    given = success_rate(random_policy, env, **options)
    assert given.scenes == named.scenes
    assert torch.equal(given.outcomes, named.outcomes)
    assert env.stream == "training"
    env.set_seed(0)
    assert torch.equal(env.reset()["pixels"], PickAndPlaceEnv("pick", 30, seed=0).reset()["pixels"])


class Patient(CounterWorld):
    """Succeeds at its sixtieth step."""

    def __init__(self):
        super().__init__((2,), max_steps=60, instructed=True)

    def _step(self, tensordict):
        stepped = super()._step(tensordict)
        return stepped.set("reward", stepped["done"].float())


def choosing():
    """An environment that instructions are chosen for."""
    classifier = make_instruction_classifier(PickAndPlaceEnv(), seed=0)
    sampler = InstructionSampler(classifier, grammar("move").tokens)
    return TransformedEnv(PickAndPlaceEnv(num_envs=2, instructed=False), sampler)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda p: success_rate(p, "move", mode="best"), "unknown mode 'best'"),
        (lambda p: success_rate(p, "move", episodes=0), "must be at least 1"),
        (lambda p: success_rate(p, PickAndPlaceEnv(instructed=False)), "instructed"),
        (lambda p: success_rate(p, choosing()), "pays no true reward"),
        (lambda p: success_rate(p, PickAndPlaceEnv(), tile_size=8), "tile_size"),
        (lambda p: success_rate(p, "move", batch_size=2.5), "batch_size must be a whole number"),
        (lambda p: success_rate(p, Patient(), max_steps=0), "max_steps must be at least 1"),
    ],
)
def test_mistakes_get_one_clear_line(call, message, random_policy):
    with pytest.raises(UserError, match=message):
        call(random_policy)


def test_comparison_is_paired_and_refuses_other_scenes(make_expert, random_policy):
    expert = make_expert("move")
    worse = success_rate(random_policy, "move", episodes=100)
    better = success_rate(expert, "move", episodes=100, expose_state=True)
    difference = compare_success(worse, better)
    assert difference.points == pytest.approx(100 * (1 - worse.rate.rate))
    assert difference.worse == 0 and difference.low > 80
    other = success_rate(random_policy, "move", episodes=100, seed=1)
    with pytest.raises(UserError, match="different scenes"):
        compare_success(worse, other)
    sampled = success_rate(random_policy, "move", episodes=100, mode="sampled")
    with pytest.raises(UserError, match="cannot compare"):
        compare_success(worse, sampled)


def test_other_worlds_end_by_themselves(up):
    assert success_rate(up, Patient(), episodes=4).rate.rate == 1.0
    assert success_rate(up, Patient(), episodes=4, max_steps=59).rate.rate == 0.0


def test_values_logits_actions_of_another_shape_and_worlds_without_an_image_are_refused(up):
    one_hot = Patient()
    one_hot.action_spec = OneHot(6, shape=(2, 6))
    with pytest.raises(UserError, match=r"shape \[2\].*takes \[2, 6\].*categorical_action"):
        success_rate(up, one_hot, episodes=2)
    renamed = TransformedEnv(Patient(), RenameTransform(["pixels"], ["camera"]))
    with pytest.raises(UserError, match="its image under 'pixels'"):
        success_rate(up, renamed, episodes=2)
    speaks = lambda td: td.set("action", torch.full(td.shape, 5.9))  # noqa: E731
    logits = TensorDictModule(lambda pixels: pixels[:, 0, 0, :6].float(), ["pixels"], ["logits"])
    for world in ("move", Patient()):
        with pytest.raises(UserError, match=r"actions are torch\.float32"):
            success_rate(speaks, world, episodes=2)
        with pytest.raises(UserError, match=r"writes no action: .* under 'action'"):
            success_rate(logits, world, episodes=2)


def test_success_is_seen_from_the_true_reward_where_there_are_others(up):
    zeros = lambda action: torch.zeros(*action.shape, 1)  # noqa: E731
    model = TensorDictModule(zeros, ["action"], ["action_score"])
    plain = TransformedEnv(PickAndPlaceEnv("move", num_envs=100, seed=0))
    paid = TransformedEnv(PickAndPlaceEnv("move", num_envs=100, seed=0), LearnedReward(model))
    result = success_rate(up, paid, episodes=200)
    assert torch.equal(result.outcomes, success_rate(up, plain, episodes=200).outcomes)
    assert 0 < result.rate.successes < 20
    renamed = TransformedEnv(paid, RenameTransform(["reward"], ["pay"]))
    with pytest.raises(UserError, match="success is seen from the true reward, named 'reward'"):
        success_rate(up, renamed, episodes=20)
