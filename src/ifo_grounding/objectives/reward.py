"""Learning which actions are right."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, dispatch
from torch import Tensor

from ifo_grounding import keys
from ifo_grounding.errors import UserError, at_least_one
from ifo_grounding.objectives.base import ActionKeys, SupervisedLoss, check_action

SMOOTHING = 0.1
"""How far targets are from 1 and 0 during self-examination, for the policy is often right."""


class RewardLoss(SupervisedLoss):
    """Binary cross entropy of right actions against wrong ones (2nd phase of the paper).

    Positives are the labelled actions of demonstrations. Before self-examination (:meth:`forward`)
    negatives are randomly different actions, during it (:meth:`adversarial`) the policy's own.
    Positives and negatives weigh the same. Both write ``loss_reward``, ``positive_probability`` and
    ``negative_probability``.

    Args:
        network: an image, an instruction and an action, its last input, to a logit, as
            ``make_reward_model`` builds it. One with ``all_actions`` encodes an image once.
        n_actions: number of actions; networks of this library know theirs.

    >>> from ifo_grounding.networks import Shapes, make_reward_model
    >>> rwd = make_reward_model(Shapes(image_shape=(3, 48, 48), vocabulary_size=40))
    >>> batch = TensorDict({
    ...     "pixels": torch.zeros(2, 3, 48, 48, dtype=torch.uint8),
    ...     "instruction": torch.ones(2, 16, dtype=torch.int64),
    ...     "action": torch.tensor([0, 5]),
    ... }, [2])
    >>> RewardLoss(rwd)(batch)["loss_reward"].backward()
    """

    _AcceptedKeys = ActionKeys
    written = keys.ACTION_SCORE
    out_keys = ["loss_reward", "positive_probability", "negative_probability"]  # noqa: RUF012

    def __init__(self, network: TensorDictModule, *, n_actions: int | None = None) -> None:
        super().__init__(network)
        self.own_keys = self.own_keys[:-1]  # the last is an action, the labelled one or another
        known = getattr(getattr(network, "shapes", None), "n_actions", None)
        count = known if n_actions is None else n_actions
        if count is None:
            raise UserError("how many actions there are is not known: give n_actions=")
        self.n_actions = at_least_one("n_actions", count)
        if self.n_actions < 2:
            raise UserError("a single action has no different ones to serve as negatives")

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Compute the loss of labelled actions against randomly different ones."""
        self._require(tensordict)
        action = self._actions(tensordict)
        step = torch.randint(1, self.n_actions, action.shape, device=action.device)
        both = torch.cat([action, (action + step) % self.n_actions], -1)
        with self._mode():
            right, wrong = self._scores(tensordict, both).unbind(-1)
        return self._losses(right, wrong, tensordict, tensordict)

    def adversarial(self, demonstrations: TensorDictBase, policy: TensorDictBase) -> TensorDict:
        """Compute the loss of labelled actions against the policy's own (self-examination).

        Args:
            demonstrations: transitions with labelled actions, as for :meth:`forward`.
            policy: transitions with the policy's actions, of any batch size.
        """
        self._require(demonstrations)
        self._require(policy)
        with self._mode():
            right = self._scores(demonstrations, self._actions(demonstrations)).squeeze(-1)
            wrong = self._scores(policy, self._actions(policy)).squeeze(-1)
        return self._losses(right, wrong, demonstrations, policy, SMOOTHING)

    def _losses(
        self,
        right: Tensor,
        wrong: Tensor,
        labelled: TensorDictBase,
        others: TensorDictBase,
        smoothing: float = 0.0,
    ) -> TensorDict:
        """Reduce both halves, each over the samples that the mask of its batch leaves."""
        positive = self._reduce_loss(F.softplus(-right) + smoothing * right, labelled)
        negative = self._reduce_loss(F.softplus(wrong) - smoothing * wrong, others)
        return TensorDict(
            {
                "loss_reward": (positive + negative) / 2,
                "positive_probability": self._mean(right.sigmoid(), labelled),
                "negative_probability": self._mean(wrong.sigmoid(), others),
            }
        )

    def _actions(self, tensordict: TensorDictBase) -> Tensor:
        """Return the labelled actions [*B, 1]."""
        return tensordict.get(self.tensor_keys.action).unsqueeze(-1)

    def _scores(self, tensordict: TensorDictBase, actions: Tensor) -> Tensor:
        """Score several actions [*B, K] of each state: logits [*B, K]."""
        *input_keys, action_key = self.network.in_keys
        check_action(actions[..., 0], tensordict.get(input_keys[-1]).shape[:-1], self.n_actions)
        actions = actions.long()
        if hasattr(self.network, "all_actions"):
            every = self.network.all_actions(*(tensordict.get(key) for key in input_keys))
            return every.gather(-1, actions)
        inputs = tensordict.select(*input_keys)
        columns = [
            self.network(inputs.copy().set(action_key, action)).get(self.output)
            for action in actions.unbind(-1)
        ]
        return torch.cat(columns, -1)
