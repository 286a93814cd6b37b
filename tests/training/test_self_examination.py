import math
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torch.distributions import Categorical
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, GymEnv, ParallelEnv, SerialEnv, StepCounter, TransformedEnv
from torchrl.modules import ProbabilisticActor
from torchrl.objectives.value import GAE

from ifo_grounding import keys
from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.errors import UserError
from ifo_grounding.networks import make_policy, make_reward_model, make_value
from ifo_grounding.objectives import ImitationLoss, RewardLoss
from ifo_grounding.tasks import grammar
from ifo_grounding.training import (
    Adversary,
    Rehearsal,
    SelfExaminationConfig,
    policy_gradient,
    select_pairs,
    self_examine,
)
from ifo_grounding.training.environment import summary
from ifo_grounding.transforms import InstructionSampler, LearnedReward, StartingPairs

SMALL = {"preset": "paper", "dropout": 0.0, "features": 16, "seed": 0}
POOL = grammar("move").tokens


def accepts_all():
    def score(pixels, instruction):
        return torch.full((*instruction.shape[:-1], 1), 5.0)

    return TensorDictModule(score, [keys.PIXELS, keys.INSTRUCTION], [keys.SUITABILITY])


def likes(action):
    """A judge of actions that likes one of them."""

    def score(pixels, instruction, taken):
        return ((taken == action).float() * 8 - 4).unsqueeze(-1)

    return TensorDictModule(
        score, [keys.PIXELS, keys.INSTRUCTION, keys.ACTION], [keys.ACTION_SCORE]
    )


def simulator(num_envs=16, **kwargs):
    return PickAndPlaceEnv("move", num_envs, seed=0, instructed=False, **kwargs)


def make_env(judge=None, num_envs=16):
    sampler = InstructionSampler(accepts_all(), POOL)
    return TransformedEnv(simulator(num_envs), Compose(sampler, LearnedReward(judge or likes(1))))


def nested():
    """Transforms around an environment that has some already."""
    sampled = TransformedEnv(simulator(), InstructionSampler(accepts_all(), POOL))
    return TransformedEnv(sampled, LearnedReward(likes(1)))


def grouped():
    """A group of transforms in another."""
    inner = Compose(InstructionSampler(accepts_all(), POOL), LearnedReward(likes(1)))
    return TransformedEnv(simulator(), Compose(StepCounter(9), inner))


def of_pairs():
    """The same, of which the inner ones keep the scenes."""
    pairs = select_pairs(simulator(8), accepts_all(), POOL, 24, seed=0)
    return TransformedEnv(
        TransformedEnv(simulator(8), StartingPairs(pairs)), LearnedReward(likes(1))
    )


def make_networks():
    policy = make_policy(simulator(1), **SMALL)
    return policy, make_value(simulator(1), init_from=policy, **SMALL)


def config(**kwargs):
    chosen = {"iterations": 2, "steps": 8, "minibatch": 64, "value_warmup": 0, "epochs": 1}
    return SelfExaminationConfig(**{**chosen, **kwargs})


@pytest.mark.parametrize("algorithm", ["ppo", "reinforce"])
def test_a_policy_learns_what_the_judge_likes(algorithm):
    """A judge that likes one action raises its share from about a sixth; the true reward is 0."""
    env, (policy, value) = make_env(likes(1), num_envs=32), make_networks()
    history = self_examine(
        env,
        policy,
        value,
        config(algorithm=algorithm, iterations=12, gamma=0.0, lr=3e-3, entropy=0.0, epochs=3),
        seed=0,
    )
    assert history[0]["learned_reward"] < 0.35
    assert history[-1]["learned_reward"] > 0.6


def test_a_value_may_write_under_any_name():
    found = []
    for name in ("state_value", "worth"):
        env, policy = make_env(likes(1)), make_policy(simulator(1), **SMALL)
        value = make_value(simulator(1), init_from=policy, out_key=name, **SMALL)
        found.append(self_examine(env, policy, value, config(), seed=0))
    assert found[0][-1]["loss_critic"] == found[1][-1]["loss_critic"]


def test_rehearsal_keeps_what_the_demonstrations_show():
    """Demonstrations that always take action 3 hold against a judge that likes action 1."""
    demos = TensorDictReplayBuffer(storage=LazyTensorStorage(64))
    frames = simulator(64).reset()[keys.PIXELS]
    words = POOL[torch.arange(64) % len(POOL)]
    shown = {keys.PIXELS: frames, keys.INSTRUCTION: words, keys.ACTION: torch.full((64,), 3)}
    demos.extend(TensorDict(shown, [64]))
    shares = {}
    for weight in (0.0, 10.0):
        env, (policy, value) = make_env(likes(1)), make_networks()
        history = self_examine(
            env,
            policy,
            value,
            config(iterations=10, gamma=0.0, lr=3e-3, epochs=3),
            seed=0,
            rehearsal=Rehearsal(ImitationLoss(policy), demos, weight, 32) if weight else None,
        )
        assert ("loss_rehearsal" in history[-1]) == bool(weight)
        action = policy(TensorDict(shown, [64]))[keys.ACTION]
        shares[weight] = float((action == 3).float().mean())
    assert shares[0.0] < 0.3 and shares[10.0] > 0.8
    with pytest.raises(UserError, match="positive weight"):
        Rehearsal(ImitationLoss(policy), demos, 0.0)


def test_value_warm_up_leaves_the_policy_as_it_was():
    env, (policy, value) = make_env(), make_networks()
    before = {name: weight.clone() for name, weight in policy.state_dict().items()}
    critic = {name: weight.clone() for name, weight in value.state_dict().items()}
    seen = []

    def look(iteration):
        seen.append(
            [
                all(torch.equal(w, then[n]) for n, w in network.state_dict().items())
                for network, then in ((policy, before), (value, critic))
            ]
        )
        return {}

    self_examine(
        env,
        policy,
        value,
        config(iterations=3, value_warmup=2, evaluate_every=1),
        seed=0,
        callback=look,
    )
    assert seen == [[True, False], [True, False], [False, False]]
    with pytest.raises(UserError, match="would never learn"):
        config(iterations=2, value_warmup=2)


def test_divergence_from_phase_1_costs_reward():
    env = make_env(likes(1), num_envs=32)
    free, held = [
        self_examine(
            env,
            *make_networks(),
            config(iterations=8, gamma=0.0, lr=3e-3, entropy=0.0, kl=kl),
            seed=0,
        )[-1]["learned_reward"]
        for kl in (0.0, 10.0)
    ]
    assert held < free - 0.1


def test_a_policy_that_reads_more_may_be_held_too():
    class Counting(nn.Module):
        def __init__(self):
            super().__init__()
            self.bias = nn.Parameter(torch.zeros(keys.N_ACTIONS))

        def forward(self, pixels, instruction, count):
            return self.bias + 0 * count

    read = [keys.PIXELS, keys.INSTRUCTION, "step_count"]
    policy = ProbabilisticActor(
        TensorDictModule(Counting(), read, ["logits"]),
        in_keys=["logits"],
        distribution_class=Categorical,
        return_log_prob=True,
    )
    env = make_env(likes(1))
    env.append_transform(StepCounter())
    history = self_examine(env, policy, make_networks()[1], config(kl=0.1), seed=0)
    assert history[0]["divergence"] == 0.0


def test_the_learned_reward_is_told_without_what_divergence_costs():
    judge = TensorDictModule(
        lambda pixels, action: torch.rand(*action.shape, 1),
        [keys.PIXELS, keys.ACTION],
        [keys.ACTION_SCORE],
    )
    history = self_examine(
        make_env(judge), *make_networks(), config(iterations=4, kl=50.0, lr=3e-3), seed=0
    )
    assert min(metrics["learned_reward"] for metrics in history) > 0.5  # a probability
    assert history[0]["divergence"] == 0 < max(metrics["divergence"] for metrics in history)


@pytest.mark.parametrize("options", [{"kl": 1.0}, {"kl": 1.0, "select_every": 1}], ids=str)
def test_an_interrupted_run_goes_on_with_the_same_objects(tmp_path, options):
    """As in a notebook: policy and environment are then no longer as they were at first."""
    chosen = config(iterations=4, lr=3e-3, steps=5, select_episodes=8, max_steps=5, **options)
    whole = make_networks()
    expected = self_examine(of_pairs(), *whole, chosen, seed=0)
    env, networks, path = of_pairs(), make_networks(), tmp_path / "run.pt"

    def interrupt(metrics, step):
        if step == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        self_examine(env, *networks, chosen, seed=0, checkpoint=path, log=interrupt)
    assert self_examine(env, *networks, chosen, seed=0, checkpoint=path) == expected
    for network, other in zip(whole, networks, strict=True):
        assert all(torch.equal(w, other.state_dict()[n]) for n, w in network.state_dict().items())


def test_values_of_some_worlds_at_a_time_are_those_of_all_at_once(monkeypatch):
    learned = []
    for steps in (8, 40, 10_000):  # one world, five, all sixteen
        monkeypatch.setattr(policy_gradient, "AT_ONCE", steps)
        nets = make_networks()
        self_examine(make_env(), *nets, config(gamma=0.9), seed=0)
        learned.append([p.detach() for net in nets for p in net.parameters()])
    for some in learned[:2]:
        for one, whole in zip(some, learned[2], strict=True):
            torch.testing.assert_close(one, whole, atol=1e-4, rtol=1e-3)


def test_advantages_are_those_of_torchrls_estimator_with_its_own_values():
    """Episodes end, are cut off after three steps, and go on beyond the batch."""
    policy, value = make_networks()
    worlds = simulator(64, max_steps=3)
    sampler = InstructionSampler(accepts_all(), POOL)
    env = TransformedEnv(worlds, Compose(sampler, LearnedReward(likes(1))))
    learner = policy_gradient.Learner(env, policy, value, config(gamma=0.9))
    batch = learner.collect()
    assert batch["next", "terminated"].any() and batch["next", "truncated"].any()
    assert not batch["next", "done"][:, -1].all()
    expected = GAE(gamma=0.9, lmbda=0.95, value_network=value, deactivate_vmap=True)
    expected.set_keys(reward=keys.LEARNED_REWARD)
    expected(asked := batch.clone())
    learner._estimate_advantages(batch)
    for name in ("advantage", "value_target", "state_value"):
        torch.testing.assert_close(batch[name], asked[name], atol=1e-5, rtol=1e-4)


def test_without_discount_it_learns_what_torchrls_estimator_would_teach_it():
    learned = []
    for gamma in (0.0, 1e-12):
        nets = make_networks()
        self_examine(make_env(), *nets, config(gamma=gamma), seed=0)
        learned.append([p.detach() for net in nets for p in net.parameters()])
    for one, other in zip(*learned, strict=True):
        torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-3)
    untrained = [p.detach() for net in make_networks() for p in net.parameters()]
    assert not all(map(torch.equal, learned[0], untrained))


@pytest.mark.parametrize("make", [make_env, nested, grouped, of_pairs])
def test_a_killed_run_continues_to_the_same_weights(tmp_path, make):
    whole = make_networks()
    expected = self_examine(make(), *whole, config(iterations=3), seed=0)

    class Killed(BaseException):
        pass

    def kill(metrics, step):
        if step == 2:
            raise Killed

    path = tmp_path / "run.pt"
    with pytest.raises(Killed):
        self_examine(
            make(), *make_networks(), config(iterations=3), seed=0, checkpoint=path, log=kill
        )
    resumed, steps = make_networks(), []
    history = self_examine(
        make(),
        *resumed,
        config(iterations=3),
        seed=0,
        checkpoint=path,
        log=lambda _, step: steps.append(step),
    )
    assert steps == [2, 3]
    assert history == expected
    for network, other in zip(whole, resumed, strict=True):
        assert all(torch.equal(w, other.state_dict()[n]) for n, w in network.state_dict().items())


def test_the_adversary_calls_the_policys_actions_wrong():
    from ifo_grounding.data import labelled_buffer, record_demonstrations

    demos, truth = record_demonstrations("move", 40, seed=0, keep_truth=True)
    buffer = labelled_buffer(demos, truth.actions)
    model = make_reward_model(simulator(1), **SMALL)
    adversary = Adversary(RewardLoss(model), buffer, steps=4, lr=3e-3, batch_size=64)
    policy, value = make_networks()
    env = make_env(model)
    history = self_examine(env, policy, value, config(iterations=3), seed=0, adversary=adversary)
    first, last = history[0], history[-1]
    assert last["reward/loss_reward"] < first["reward/loss_reward"]
    assert last["reward/positive_probability"] > last["reward/negative_probability"]
    state = adversary.state_dict()
    other = Adversary(
        RewardLoss(make_reward_model(simulator(1), **{**SMALL, "seed": 1})),
        buffer,
        1,
        1e-3,
    )
    other.load_state_dict(state)
    assert all(
        torch.equal(w, other.loss.state_dict()[n]) for n, w in adversary.loss.state_dict().items()
    )


def test_stored_pairs_are_practised():
    pairs = select_pairs(simulator(8), accepts_all(), POOL, 24, seed=0)
    env = TransformedEnv(simulator(8), Compose(StartingPairs(pairs), LearnedReward(likes(1))))
    history = self_examine(env, *make_networks(), config(iterations=2), seed=0)
    assert len(history) == 2
    assert set(env.base_env.scene_numbers.tolist()) <= set(pairs["scene"].flatten().tolist())


@pytest.mark.filterwarnings("ignore:A lambda function was passed to ParallelEnv")
@pytest.mark.parametrize("kind", [SerialEnv, partial(ParallelEnv, mp_start_method="fork")])
def test_worlds_in_workers_are_practised_in(kind):
    worlds = kind(2, lambda: simulator(4))
    env = TransformedEnv(
        worlds, Compose(InstructionSampler(accepts_all(), POOL), LearnedReward(likes(1)))
    )
    try:
        looking = config(iterations=2, select_every=1, select_episodes=12)
        history = self_examine(env, *make_networks(), looking, seed=0)
    finally:
        env.close(raise_if_closed=False)
    assert history[-1]["frames"] == 2 * 4 * 8
    assert history[-1]["selection_return"] > 0


def test_starts_inside_of_workers_stay_the_scenes_that_they_are():
    pairs = select_pairs(simulator(8), accepts_all(), POOL, 24, seed=0)

    def worker(number):
        mine = pairs[12 * number : 12 * (number + 1)]
        return lambda: TransformedEnv(simulator(4), StartingPairs(mine, seed=number))

    env = TransformedEnv(SerialEnv(2, [worker(0), worker(1)]), LearnedReward(likes(1)))
    history = self_examine(env, *make_networks(), config(iterations=3), seed=0)
    assert len(history) == 3  # a scene that is another one would have been noticed
    with pytest.raises(UserError, match="set select_every=0 to keep the last one"):
        self_examine(env, *make_networks(), config(select_every=1), seed=0)


def test_no_true_reward_reaches_the_learner():
    """The simulator would pay for success; what is learned from does not even hold that entry."""
    seen = []

    class Spy:
        def __call__(self, batch):
            seen.append(set(batch.keys(True, True)))
            return {}

        def state_dict(self):
            return {}

        def load_state_dict(self, state):
            raise AssertionError

    self_examine(make_env(), *make_networks(), config(iterations=1), seed=0, adversary=Spy())
    assert (keys.NEXT, keys.LEARNED_REWARD) in seen[0]
    assert (keys.NEXT, keys.REWARD) not in seen[0]
    assert not any("state" in str(key) and "value" not in str(key) for key in seen[0])


def test_envs_that_leak_or_lack_something_are_refused():
    policy, value = make_networks()
    with pytest.raises(UserError, match="never sees the true state"):
        self_examine(simulator(expose_state=True), policy, value, config(), seed=0)
    worlds = SerialEnv(2, lambda: simulator(4, expose_state=True))
    with pytest.raises(UserError, match="never sees the true state"):
        self_examine(worlds, policy, value, config(), seed=0)
    with pytest.raises(UserError, match="never sees true instructions"):
        self_examine(PickAndPlaceEnv("move", 4, seed=0), policy, value, config(), seed=0)
    worlds = SerialEnv(2, lambda: PickAndPlaceEnv("move", 4, seed=0))
    with pytest.raises(UserError, match="never sees true instructions"):
        self_examine(
            TransformedEnv(worlds, LearnedReward(likes(1))), policy, value, config(), seed=0
        )
    told = SerialEnv(2, lambda: GymEnv("ifo_grounding/Move-v0", categorical_action_encoding=True))
    with pytest.raises(UserError, match="never sees true instructions"):
        self_examine(TransformedEnv(told, LearnedReward(likes(1))), policy, value, config(), seed=0)
    with pytest.raises(UserError, match="no instructions"):
        self_examine(simulator(), policy, value, config(), seed=0)
    sampled = TransformedEnv(simulator(), InstructionSampler(accepts_all(), POOL))
    with pytest.raises(UserError, match="no learned reward"):
        self_examine(sampled, policy, value, config(), seed=0)


@pytest.mark.parametrize(
    "wrong",
    [
        *({"algorithm": "dqn"}, {"iterations": 0}, {"minibatch": 0}, {"max_steps": 2.5}),
        *({"clip": math.nan}, {"select_margin": math.nan}, {"lr": math.inf}, {"lr": "fast"}),
    ],
    ids=str,
)
def test_impossible_configs_are_refused(wrong):
    with pytest.raises(UserError):
        SelfExaminationConfig(**wrong)


def test_the_summary_counts_by_hand():
    env = make_env()
    batch = env.rollout(4, break_when_any_done=False, policy=None)
    batch["next", "terminated"].zero_()
    batch["next", "done"].zero_()
    batch["next", "done"][0, 3] = True
    batch["next", "terminated"][0, 3] = True
    batch["next", "done"][1, 3] = True
    batch["next", "done"][2, 1] = True
    batch["next", "terminated"][2, 1] = True
    batch["next", "learned_reward"].fill_(0.25)
    said = summary(batch)  # of 16 rows: ends after 4, 4 and 2 steps, 14 rows are cut
    assert said["frames"] == 64
    assert said["episode_length"] == pytest.approx(10 / 3)
    assert said["learned_return"] == pytest.approx(2.5 / 3)
    assert said["stopped"] == pytest.approx(2 / 3)
    assert said["unfinished"] == pytest.approx(14 / 17)
