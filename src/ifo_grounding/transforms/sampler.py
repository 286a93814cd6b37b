"""An instruction for every episode, chosen by a learned classifier of suitability."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import TransformedEnv

from ifo_grounding.errors import UserError, at_least_one
from ifo_grounding.seeding import generator
from ifo_grounding.transforms.base import InstructionTransform, check_pool, rows_of
from ifo_grounding.transforms.choosing import Choices, PoolScorer, check_options


class NothingSuitableError(UserError, RuntimeError):
    """No instruction of the pool suited any state that the simulator drew."""


class InstructionSampler(InstructionTransform):
    """Gives every new episode an instruction that a classifier finds suitable.

    At each reset, full or partial, some instructions of the pool are scored for each new state and
    one above the threshold is kept for the episode. Where there is none, the simulator draws a new
    state for that row (paper, "Instruction Module"). Every step carries the instruction along.

    The classifier's mode (train or eval) is left as it is. Instructions come from the transform's
    own generator, so ``env.set_seed`` leaves them alone; in workers of a batched environment, give
    each worker's transform a seed of its own.

    Args:
        classifier: TensorDictModule from (pixels, instruction) to the logit of suitability.
        pool: token ids of the instructions, int64 [N, L]; duplicates count once.
        max_tries: states drawn for one row before giving up; ``threshold``, ``candidates`` and
            ``choose`` are those of :meth:`PoolScorer.choose`.

    Raises:
        UserError: on an option or a pool of another form, on an environment that exposes its true
            state or already has an instruction.
        NothingSuitableError: where a row finds no instruction within so many states.

    >>> from tensordict.nn import TensorDictModule
    >>> from torchrl.envs import TransformedEnv
    >>> from ifo_grounding.envs import PickAndPlaceEnv
    >>> classifier = TensorDictModule(  # finds everything suitable
    ...     lambda pixels, instruction: torch.full((len(pixels), 1), 9.0),
    ...     ["pixels", "instruction"], ["suitability"],
    ... )
    >>> env = TransformedEnv(
    ...     PickAndPlaceEnv("move", num_envs=4, seed=0, instructed=False),
    ...     InstructionSampler(classifier, pool=torch.randint(1, 20, (10, 16))),
    ... )
    >>> env.rollout(5, break_when_any_done=False)["instruction"].shape
    torch.Size([4, 5, 16])
    """

    def __init__(
        self,
        classifier: TensorDictModuleBase,
        pool: Tensor,
        threshold: float = 0.8,
        candidates: int = 64,
        choose: str = "random",
        max_tries: int = 1000,
        seed: int = 0,
        in_keys: Sequence[NestedKey] | None = None,
        out_keys: Sequence[NestedKey] | None = None,
    ) -> None:
        super().__init__(check_pool(pool).unique(dim=0), in_keys, out_keys)
        self.options: dict[str, Any] = {"threshold": threshold, "candidates": candidates}
        self.options["choose"] = choose
        check_options(**self.options)
        self.max_tries = at_least_one("max_tries", max_tries)
        self.scorer = PoolScorer(classifier, self.tokens)
        self.classifier = classifier
        self.set_seed(seed)
        self._clear_stats()

    def set_seed(self, seed: int) -> None:
        """Restart the choices from a seed."""
        self.generator = generator(seed, "instruction-sampler")

    def get_extra_state(self) -> Tensor:
        """Return the state of the generator: ``state_dict`` resumes the choices."""
        return self.generator.get_state()

    def set_extra_state(self, state: Tensor) -> None:
        """Resume the choices."""
        self.generator.set_state(state.cpu())

    def stats(self) -> dict[str, float]:
        """Return what happened since the last call, and start counting anew.

        ``states_served`` are those that got an instruction, ``served_share`` their share of
        ``states_drawn``; ``mean_score`` is the mean probability of the chosen pairs.
        """
        served = float(self._served)
        stats = {
            "states_drawn": float(self._drawn),
            "states_served": served,
            "served_share": served / max(self._drawn, 1),
            "candidates_scored": float(self.scorer.scored),
            "mean_score": float(self._score_sum) / max(served, 1),
        }
        self._clear_stats()
        return stats

    def _clear_stats(self) -> None:
        self._drawn = self.scorer.scored = 0
        # Added up where they are computed: a GPU is asked for them in stats().
        self._served = torch.zeros((), dtype=torch.int64)
        self._score_sum = torch.zeros(())

    def _choose(self, pixels: Tensor) -> Choices:
        self.scorer.classifier = self.classifier  # another one may have been put there
        choices = self.scorer.choose(pixels, generator=self.generator, **self.options)
        found = choices.chosen >= 0
        self._drawn += len(found)
        self._served = self._served.to(found.device) + found.sum()
        scores = choices.score.where(found, 0.0).sum()
        self._score_sum = self._score_sum.to(found.device) + scores
        return choices

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        batch = tensordict_reset.batch_size
        rows = batch.numel()
        waiting = self.new_rows(tensordict, rows)
        home = tensordict_reset.get(self.in_keys[0]).device
        instruction = self.tokens.new_zeros(rows, self.tokens.shape[1], device=home)
        best_score, attempt = torch.zeros((), device=home), 0
        while len(waiting) and attempt < self.max_tries:
            if attempt:
                tensordict_reset = self._draw_again(tensordict_reset, waiting)
            waiting = waiting.to(home)
            index, score = self._choose(rows_of(tensordict_reset, self.in_keys[0])[waiting])
            instruction[waiting] = self.tokens.to(home)[index]  # of rows without any, the last one
            best_score = torch.maximum(best_score, score.max())
            waiting = waiting[index < 0]
            attempt += 1
        if len(waiting):
            raise NothingSuitableError(
                f"no instruction of the pool scored above {self.options['threshold']} on any of "
                f"{attempt} states in {len(waiting)} of the rows (best score seen in this reset: "
                f"{best_score:.2f}; {self._served} of {self._drawn} states served so far): lower "
                "threshold, raise candidates or max_tries, or train the classifier longer"
            )
        return tensordict_reset.set(self.out_keys[0], instruction.reshape(*batch, -1))

    def _draw_again(self, tensordict_reset: TensorDictBase, rows: Tensor) -> TensorDictBase:
        """Let the simulator draw new states for some rows and leave the others as they are."""
        parent = self.parent
        if parent is None:
            raise UserError(f"{type(self).__name__} needs an environment that can draw a new state")
        # A copy, since the partial reset writes into what it is given.
        request = tensordict_reset.clone()
        group = parent.done_keys_groups[parent.reset_keys.index(self.reset_key)]
        done = request.get(group[0])
        mask = done.new_zeros(done.shape, dtype=torch.bool)
        mask.view(tensordict_reset.batch_size.numel(), -1)[rows.to(done.device)] = True
        request.set(self.reset_key, mask)
        if isinstance(parent, TransformedEnv) and not len(parent.transform):
            parent = parent.base_env  # which need not choose between old and new pixel by pixel
        return parent.reset(request, select_reset_only=True)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write a suitable instruction for every state of a tensordict [*B], or raise."""
        index, score = self._choose(rows_of(tensordict, self.in_keys[0]))
        if (index < 0).any():
            raise NothingSuitableError(
                f"{int((index < 0).sum())} of {len(index)} states have no instruction above "
                f"{self.options['threshold']} (best score {float(score[index < 0].max()):.2f}): "
                "select states with PoolScorer.choose first, or lower threshold"
            )
        chosen = self.tokens.to(index.device)[index]
        shape = (*tensordict.batch_size, chosen.shape[-1])
        # A full buffer may hand out its storage, which keeps what it holds.
        return tensordict.copy().set(self.out_keys[0], chosen.reshape(shape))
