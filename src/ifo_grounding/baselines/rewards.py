"""What a discriminator pays: its logit for every step, or its verdict at the stop."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn

from ifo_grounding import keys
from ifo_grounding.baselines.access import ENDED
from ifo_grounding.errors import UserError
from ifo_grounding.transforms.base import rows_of
from ifo_grounding.transforms.reward import RewardTransform


class AbsorbingState(nn.Module):
    """What lengths of episodes tell demonstrations and policy apart by (Kostrikov et al. 2019).

    Where every step is paid a logit, a policy whose steps are mostly told apart gains by stopping
    at once. So an episode goes on after its end, in a state of its own that pays, too. How often
    demonstrations and policy are there need not be learned: of an episode of L steps, discounted by
    g, 1 - g^L are steps and g^L is the state.

    Args:
        length: mean number of steps of a demonstration.
        gamma: discount.

    Raises:
        UserError: where the discount is 0 or 1: the state is then worth nothing, or without bounds.

    >>> from tensordict import TensorDict
    >>> state = AbsorbingState(5.0, gamma=0.9)
    >>> done = torch.tensor([[0, 1, 0, 1]]).bool().unsqueeze(-1)  # two episodes of two steps
    >>> state.count(TensorDict({"next": {"done": done}}, [1, 4]))
    >>> [round(float(paid), 2) for paid in (state.step, state.end)]  # longer ones are wanted
    [0.77, -2.84]
    """

    step: Tensor
    """What is paid for every step beside its logit, a scalar."""
    end: Tensor
    """What is paid beside it where an episode terminates: all that the state will pay."""

    def __init__(self, length: float, gamma: float) -> None:
        super().__init__()
        if not 0 < gamma < 1:
            raise UserError(
                f"gamma must be above 0 and below 1 for an absorbing state, got {gamma}"
            )
        self.length, self.gamma = length, gamma
        self.register_buffer("step", torch.zeros(()))
        self.register_buffer("end", torch.zeros(()))

    def count(self, batch: TensorDictBase) -> None:
        """Measure the policy's episodes in collected steps [N, T]; where none ends, they count T.

        An episode that the last step cuts off tells only that it is no shorter (Kaplan and Meier
        1958).
        """
        done = batch[keys.NEXT, "done"].squeeze(-1)
        now = torch.arange(done.shape[1], device=done.device).expand_as(done)
        begun = torch.where(done, now + 1, 0).cummax(1).values.roll(1, 1)
        begun[:, 0] = 0
        age = now - begun
        reached, ended = (
            ages.flatten().bincount(minlength=done.shape[1]) for ages in (age, age[done])
        )
        going_on = (1 - ended / reached.clamp(min=1)).cumprod(0)
        own = 1 + float(going_on[:-1].sum())
        among_steps = (1 - self.gamma**self.length) / (1 - self.gamma**own)
        self.step.fill_(math.log(among_steps))
        worth = self.gamma / (1 - self.gamma)  # it begins with the step after the last
        self.end.fill_((self.length - own) * math.log(self.gamma) * worth)


class _Judged(RewardTransform):
    """Reads what a discriminator reads: ``in_keys`` of it may name what a step led to."""

    def __init__(self, discriminator: TensorDictModuleBase, also: NestedKey) -> None:
        self.later = [key in (keys.NEXT_PIXELS, ENDED) for key in discriminator.in_keys]
        read = [
            key[-1] if later else key
            for key, later in zip(discriminator.in_keys, self.later, strict=True)
        ]
        super().__init__(discriminator, str(discriminator.out_keys[0]), [*read, also], None, [also])

    def entries(self, before: TensorDictBase, after: TensorDictBase) -> list[Tensor]:
        """Return what the discriminator reads of steps [*B], rows first."""
        return [
            rows_of(after if later else before, key)
            for later, key in zip(self.later, self.in_keys, strict=False)
        ]


class DiscriminatorReward(_Judged):
    """Pays every step its logit (log D - log(1 - D), Fu et al. 2018), and what ``absorbing`` adds.

    Args:
        discriminator: its ``in_keys`` may name what a step led to, as ``("next", "pixels")``.
    """

    def __init__(self, discriminator: TensorDictModuleBase, absorbing: AbsorbingState) -> None:
        super().__init__(discriminator, ENDED[-1])
        self.absorbing = absorbing

    def pay(self, before: TensorDictBase, after: TensorDictBase) -> Tensor:
        """Return the reward, float32 [*B, 1]."""
        ended = rows_of(after, ENDED[-1]).reshape(-1)
        paid = self._score(self.entries(before, after)).reshape(-1)
        paid = paid + self.absorbing.step + self.absorbing.end * ended
        return paid.view(*before.batch_size, 1)


class StopReward(_Judged):
    """Pays 1 at a stop that a discriminator finds more likely right than wrong (AGILE).

    Args:
        discriminator: as of :class:`DiscriminatorReward`.
        stop_action: the action by which a policy ends an episode.
    """

    def __init__(self, discriminator: TensorDictModuleBase, stop_action: int) -> None:
        super().__init__(discriminator, keys.ACTION)
        self.stop_action = stop_action

    def pay(self, before: TensorDictBase, after: TensorDictBase) -> Tensor:
        """Return the reward, float32 [*B, 1]."""
        stops = rows_of(before, keys.ACTION).eq(self.stop_action)
        reward = torch.zeros(len(stops), device=stops.device)
        rows = stops.nonzero().squeeze(-1)
        read = [entry[rows] for entry in self.entries(before, after)]
        reward[rows] = (self._score(read) > 0).float()
        return reward.view(*before.batch_size, 1)
