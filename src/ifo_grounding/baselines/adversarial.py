"""Adversarial imitation: a discriminator of demonstrations and policy, which pays the policy.

GAIL (Ho and Ermon 2016) tells actions apart, GAIfO (Torabi et al. 2019) changes of state, AGILE
(Bahdanau et al. 2019) states in which an instruction is fulfilled. Each is conditioned on the
instruction, and pays through one transform, so that
:func:`ifo_grounding.training.improve_policy` trains them all.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch
import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import TensorDictReplayBuffer

from ifo_grounding import keys
from ifo_grounding.baselines.access import (
    ENDED,
    ActionDemonstrations,
    SteppableDemonstrations,
    check_access,
    transitions_of,
)
from ifo_grounding.baselines.rewards import AbsorbingState, DiscriminatorReward, StopReward
from ifo_grounding.data import Demonstrations
from ifo_grounding.data.demonstrations import FEW
from ifo_grounding.errors import UserError, share
from ifo_grounding.networks import (
    make_instruction_classifier,
    make_inverse,
    make_reward_model,
)
from ifo_grounding.networks.trunk import RewardNetwork
from ifo_grounding.networks.warm_start import remember
from ifo_grounding.objectives.base import SupervisedLoss
from ifo_grounding.training import AdversarialUpdates
from ifo_grounding.training.loop import Metrics
from ifo_grounding.transforms.base import rows_of
from ifo_grounding.transforms.reward import RewardTransform


class DiscriminatorLoss(SupervisedLoss):
    """Binary cross entropy of demonstrations (1) against the policy (0).

    TorchRL's ``GAILLoss`` reads one tensor of observations, not an image and a sentence.

    Writes ``loss_discriminator``, ``demonstrated_probability``, ``policy_probability`` and, with
    ``swapped``, ``swapped_probability``.

    Args:
        network: what it reads of a step, the instruction too, to one logit.
        spare: share of the policy's steps, those that look most like demonstrations, that is left
            out: they may be right (1 - rho of AGILE).
        swapped: whether demonstrations with another one's instruction are negatives, too (Zolna et
            al. 2020): half of the weight of negatives.

    >>> from tensordict.nn import TensorDictModule
    >>> network = TensorDictModule(lambda pixels: pixels, ["pixels"], ["logit"])
    >>> seen, own = (TensorDict({"pixels": torch.tensor([[x]])}, [1]) for x in (2.0, -2.0))
    >>> loss = DiscriminatorLoss(network)(seen, own)["loss_discriminator"]
    >>> round(float(loss), 4) == round(float(F.softplus(torch.tensor(-2.0))), 4)
    True
    """

    def __init__(
        self, network: TensorDictModule, *, spare: float = 0.0, swapped: bool = False
    ) -> None:
        super().__init__(network)
        self.output = network.out_keys[0]
        self.spare, self.swapped = share("spare", spare, full=False), swapped

    def forward(self, demonstrations: TensorDictBase, policy: TensorDictBase) -> TensorDict:
        """Compute the loss of a batch of demonstrated steps and one of the policy's."""
        with self._mode():
            right, wrong = self._logits(demonstrations), self._logits(policy)
            kept = len(wrong) - int(self.spare * len(wrong))
            wrong = wrong.sort().values[:kept]
            negative = F.softplus(wrong).mean()
            found = {
                "demonstrated_probability": self._mean(right.sigmoid()),
                "policy_probability": self._mean(wrong.sigmoid()),
            }
            if self.swapped:
                own = demonstrations[keys.INSTRUCTION]
                other = own.roll(1, 0)  # that of the row before
                swapped = demonstrations.copy().set(keys.INSTRUCTION, other)
                elsewhere = self._logits(swapped[(own != other).any(-1)])
                if len(elsewhere):
                    negative = (negative + F.softplus(elsewhere).mean()) / 2
                    found["swapped_probability"] = self._mean(elsewhere.sigmoid())
        loss = (F.softplus(-right).mean() + negative) / 2
        return TensorDict({"loss_discriminator": loss, **found})

    adversarial = forward  # as AdversarialUpdates asks for it

    def _logits(self, batch: TensorDictBase) -> Tensor:
        if not len(batch):
            return torch.zeros(0)
        read = batch.select(*self.network.in_keys)
        return self.network(read).get(self.output).reshape(-1).float()


def frames_of(seen: Any) -> Demonstrations:
    """Return the demonstrations, whatever else a method may use."""
    demos: Demonstrations = seen if isinstance(seen, Demonstrations) else seen.demos
    return demos


class Adversary(AdversarialUpdates):
    """A discriminator, its reward, and the updates between two iterations of policy gradient.

    Args:
        seen: what the method may use; another kind is refused.
        preset: of the network.
        steps: gradient steps after each iteration.
        lr: learning rate; by default that of the method.
        prior: weight decay times demonstrations, as of
            :class:`~ifo_grounding.training.FitConfig`.
        gamma: discount of the policy gradient.
        stop_action: the action by which a policy ends an episode.
        shapes: what the network is built for, such as the policy's ``network_config.shapes``; by
            default the demonstrations, with the six actions of the own world.
        options: for the network, such as ``seed`` and ``device``.

    Raises:
        UserError: where ``seen`` gives less than the method needs, or more than it may use.
    """

    access: type[Any]
    """What the method may use."""
    spare = 0.0
    """Share of the policy's steps that is left out."""
    lr: float
    """Learning rate of the discriminator by default, of three tried on validation scenes."""
    lr_of_many: float | None = None
    """That with 1,000 demonstrations or more, where it is another one."""
    window: int | None = 64
    """Steps of each world per iteration, where every step is paid: in windows hardly longer than
    episodes, even a perfect policy would stop less often than demonstrations do."""
    network: TensorDictModule
    reward: RewardTransform

    def __init__(
        self,
        seen: Any,
        preset: str = "strong",
        *,
        steps: int = 10,
        lr: float | None = None,
        batch_size: int = 256,
        swapped: bool = True,
        prior: float = 800.0,
        gamma: float = 0.95,
        stop_action: int | None = keys.STOP,
        shapes: Any = None,
        **options: Any,
    ) -> None:
        check_access(self, seen, self.access)
        self.stop_action, demos = stop_action, frames_of(seen)
        self.network = self.discriminator(shapes or demos, preset, **options)
        loss = DiscriminatorLoss(self.network, spare=self.spare, swapped=swapped)
        self.reward = self.paid(demos, gamma)
        # Part of the loss, so that a checkpoint holds what it has counted.
        loss.absorbing = getattr(self.reward, "absorbing", None)
        decay = prior / len(demos)
        own = self.lr if len(demos) < FEW else self.lr_of_many or self.lr
        rate = own if lr is None else lr
        super().__init__(loss, self.demonstrated(seen), steps, rate, batch_size, decay)

    def __call__(self, batch: TensorDictBase) -> Metrics:
        """Count the policy's steps [N, T], train on them, and return mean metrics."""
        if self.loss.absorbing is not None:
            self.loss.absorbing.count(batch)
        return super().__call__(batch)

    @classmethod
    def practice(cls, phase2: Any) -> Any:
        """Return settings of phase 2, with as many frames per iteration in windows of its own."""
        worlds, steps = phase2.num_envs, phase2.steps
        if cls.window is not None:
            worlds, steps = math.ceil(worlds * steps / cls.window), cls.window
        if phase2.gamma == 0:  # preset=paper: for a reward that says what each action is worth
            phase2 = type(phase2)()
        return replace(phase2, num_envs=worlds, steps=steps)

    def probability(self, seen: Any) -> float:
        """Return the mean probability that demonstrations, of the same access, are demonstrated."""
        steps = self.demonstrated(seen)[:]
        read = [rows_of(steps, key) for key in self.network.in_keys]
        return float(self.reward._score(read).sigmoid().mean())

    def demonstrated(self, seen: Any) -> TensorDictReplayBuffer:
        """Return the demonstrated steps that are told apart from the policy's."""
        raise NotImplementedError

    def discriminator(self, shapes: Any, preset: str, **options: Any) -> TensorDictModule:
        """Return the network."""
        raise NotImplementedError

    def paid(self, demos: Demonstrations, gamma: float) -> RewardTransform:
        """Return the transform that pays."""
        absorbing = AbsorbingState(float(demos.lengths.float().mean()) - 1, gamma)
        return DiscriminatorReward(self.network, absorbing)


class GAIL(Adversary):
    """Tells demonstrated actions from the policy's: state, instruction, action."""

    access: type[Any] = ActionDemonstrations
    lr = 1e-3

    def demonstrated(self, seen: ActionDemonstrations) -> TensorDictReplayBuffer:  # noqa: D102
        return seen.transitions()

    def discriminator(self, shapes: Any, preset: str, **options: Any) -> TensorDictModule:  # noqa: D102
        return make_reward_model(shapes, preset, **options)


class ChangeNetwork(nn.Module):
    """Scores what a change of state looks like: a logit [*B, 1].

    An inverse model tells kinds of change apart, a reward model scores each kind in the light of
    the instruction, and an episode's end is a kind of its own: to the eye a stop is any step that
    changes nothing. Both models learn together, and read no action.
    """

    def __init__(self, inverse: nn.Module, reward: RewardNetwork, stop: int | None) -> None:
        super().__init__()
        self.inverse, self.reward, self.stop = inverse, reward, stop

    def forward(self, before: Tensor, after: Tensor, ended: Tensor, instruction: Tensor) -> Tensor:
        """Weigh the score of each kind by how much the change is of that kind.

        Args:
            before: states, uint8 [*B, C, H, W].
            after: those that follow, likewise.
            ended: whether the episode ends there by a stop, bool [*B, 1].
            instruction: token ids, int64 [*B, L].
        """
        logits = self.inverse(before, after)
        if self.stop is None:
            kinds = logits.softmax(-1)
        else:
            stop = torch.arange(logits.shape[-1], device=logits.device) == self.stop
            kinds = logits.masked_fill(stop, -torch.inf).softmax(-1)
            kinds = torch.where(ended, stop.to(kinds.dtype), kinds)
        return (kinds * self.reward.all_actions(before, instruction)).sum(-1, keepdim=True)


class GAIfO(Adversary):
    """Tells demonstrated changes from the policy's: state, next state, instruction.

    With ``inverse=`` the discriminator begins with an inverse model, which learns on with it, and
    whose weights decay towards what they were.
    """

    access: type[Any] = Demonstrations
    lr, lr_of_many = 3e-4, 1e-3

    def demonstrated(self, seen: Demonstrations) -> TensorDictReplayBuffer:  # noqa: D102
        return transitions_of(seen)

    def discriminator(self, shapes: Any, preset: str, **options: Any) -> TensorDictModule:  # noqa: D102
        if inverse := options.pop("inverse", None):
            remember(inverse.module)
        else:
            inverse = make_inverse(shapes, preset, **options)
        reward = make_reward_model(shapes, preset, **options)
        network = ChangeNetwork(inverse.module, reward.module, self.stop_action)
        in_keys = [keys.PIXELS, keys.NEXT_PIXELS, ENDED, keys.INSTRUCTION]
        return TensorDictModule(network, in_keys, ["change_score"]).eval()


class AGILE(Adversary):
    """Tells last frames of demonstrations from the policy's states: state, instruction.

    Of the policy's states the three quarters that it likes best are left out. Paid is the stop
    where it finds the instruction fulfilled: our worlds end there, those of the paper do not.
    """

    access: type[Any] = SteppableDemonstrations
    spare = 0.75
    lr = 1e-3
    window = None  # learns more in short ones

    def demonstrated(self, seen: Any) -> TensorDictReplayBuffer:  # noqa: D102
        return transitions_of(frames_of(seen), last=True)

    def discriminator(self, shapes: Any, preset: str, **options: Any) -> TensorDictModule:  # noqa: D102
        in_keys = (keys.NEXT_PIXELS, keys.INSTRUCTION)
        return make_instruction_classifier(shapes, preset, in_keys=in_keys, **options)

    def paid(self, demos: Demonstrations, gamma: float) -> RewardTransform:  # noqa: D102
        if self.stop_action is None:
            raise UserError(
                "AGILE is paid at the stop, and this world has none: give world.stop=add"
            )
        return StopReward(self.network, self.stop_action)


class ChosenAGILE(AGILE):
    """AGILE without its access: chosen instructions in fresh states, as in self-examination."""

    access: type[Any] = Demonstrations
