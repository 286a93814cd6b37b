"""An instruction for every episode, chosen by a learned classifier of suitability."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor

from ifo_grounding.errors import UserError, at_least_one
from ifo_grounding.keys import INSTRUCTION, PIXELS
from ifo_grounding.seeding import generator
from ifo_grounding.transforms.base import InstructionTransform
from ifo_grounding.transforms.choosing import (
    PoolScorer,
    check_options,
    check_pool,
    choose_instructions,
)


class NothingSuitableError(UserError, RuntimeError):
    """No instruction of the pool suited any state that the simulator drew."""


class InstructionSampler(InstructionTransform):
    """Gives every new episode an instruction that a classifier finds suitable.

    At each reset, full or partial, some instructions of the pool are scored for each new state and
    one above the threshold is kept for the episode. Where there is none, the simulator draws a new
    state for that row (paper, "Instruction Module"). The instruction is written at the reset,
    carried along by every step, and declared in the specs.

    The classifier moves with the environment's device. Its mode (train or eval) is left as it is.
    Instructions come from the transform's own generator, so ``env.set_seed`` leaves them alone; in
    workers of a batched environment, give each worker's transform a seed of its own.

    Args:
        classifier: TensorDictModule from (pixels, instruction) to the logit of suitability.
        pool: token ids of the instructions, int64 [N, L]; duplicates count once.
        threshold: least probability of a suitable pair.
        candidates: instructions drawn for each state; the whole pool if it is smaller.
        choose: ``random`` among the suitable ones (then only as many are scored as it takes to find
            one), or the ``best``.
        max_tries: states drawn for one row before giving up.
        seed: seed of the choices.
        in_keys: key of the image.
        out_keys: key of the instruction.

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
        super().__init__(in_keys=in_keys or [PIXELS], out_keys=out_keys or [INSTRUCTION])
        check_options(threshold, candidates, choose)
        max_tries = at_least_one("max_tries", max_tries)
        self.threshold, self.candidates, self.choose = threshold, candidates, choose
        self.max_tries = max_tries
        distinct = check_pool(pool).unique(dim=0)
        self.scorer = PoolScorer(classifier, distinct, self.in_keys[0])
        self.classifier = classifier
        self.register_buffer("pool", distinct, persistent=False)
        self.set_seed(seed)
        self._clear_stats()

    pool: Tensor

    @property
    def tokens(self) -> Tensor:
        """The pool, int64 [N, L]."""
        return self.pool

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

        Returns:
            ``states_drawn`` and ``states_served`` (those that got an instruction), their ratio
            ``served_share``, ``candidates_scored``, and ``mean_score``, the mean probability of
            the chosen pairs.
        """
        stats = {
            "states_drawn": float(self._drawn),
            "states_served": float(self._served),
            "served_share": self._served / max(self._drawn, 1),
            "candidates_scored": float(self.scorer.scored),
            "mean_score": self._score_sum / max(self._served, 1),
        }
        self._clear_stats()
        return stats

    def _clear_stats(self) -> None:
        self._drawn = self._served = self.scorer.scored = 0
        self._score_sum = 0.0

    def _choose(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        self.scorer.classifier = self.classifier  # another one may have been put there
        index, score = choose_instructions(
            self.scorer,
            None,
            pixels,
            threshold=self.threshold,
            candidates=self.candidates,
            choose=self.choose,
            generator=self.generator,
        )
        self._drawn += len(index)
        self._served += int((index >= 0).sum())
        self._score_sum += float(score[index >= 0].sum())
        return index, score

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        batch = tensordict_reset.batch_size
        rows = batch.numel()
        waiting = self.new_rows(tensordict, rows)
        pixels = tensordict_reset.get(self.in_keys[0])
        instruction = self.pool.new_zeros(rows, self.pool.shape[1], device=pixels.device)
        best_score, attempt = 0.0, 0
        while len(waiting) and attempt < self.max_tries:
            if attempt:
                tensordict_reset = self._draw_again(tensordict_reset, waiting)
            pixels = tensordict_reset.get(self.in_keys[0])
            waiting = waiting.to(pixels.device)
            index, score = self._choose(pixels.reshape(rows, *pixels.shape[len(batch) :])[waiting])
            found = index >= 0
            instruction[waiting[found]] = self.pool.to(pixels.device)[index[found]]
            waiting = waiting[~found]
            attempt += 1
            best_score = max(best_score, float(score.max()))
        if len(waiting):
            raise NothingSuitableError(self._complaint(len(waiting), attempt, best_score))
        tensordict_reset.set(self.out_keys[0], instruction.reshape(*batch, -1))
        return tensordict_reset

    def _complaint(self, waiting: int, tries: int, best_score: float) -> str:
        return (
            f"no instruction of the pool scored above {self.threshold} on any of "
            f"{tries} states in {waiting} of the rows (best score seen in this reset: "
            f"{best_score:.2f}; {self._served} of {self._drawn} states served so far): lower "
            "threshold, raise candidates or max_tries, or train the classifier longer"
        )

    def _draw_again(self, tensordict_reset: TensorDictBase, rows: Tensor) -> TensorDictBase:
        """Let the simulator draw new states for some rows and leave the others as they are."""
        parent = self.parent
        if parent is None:
            raise UserError(f"{type(self).__name__} needs an environment that can draw a new state")
        # A copy, since the partial reset writes into what it is given.
        request = tensordict_reset.clone()
        group = parent.done_keys_groups[parent.reset_keys.index(self.reset_key)]
        done = request.get(group[0])
        mask = torch.zeros(tensordict_reset.batch_size.numel(), dtype=torch.bool)
        mask[rows.cpu()] = True
        mask = mask.to(done.device).view(*tensordict_reset.batch_size, 1).expand(done.shape)
        request.set(self.reset_key, mask.clone())
        return parent.reset(request, select_reset_only=True)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write a suitable instruction for every state of a tensordict [*B].

        Raises:
            NothingSuitableError: where a state has none, as no simulator can draw another.
        """
        pixels = tensordict.get(self.in_keys[0])
        batch = tensordict.batch_size
        index, score = self._choose(pixels.reshape(batch.numel(), *pixels.shape[len(batch) :]))
        if (index < 0).any():
            raise NothingSuitableError(
                f"{int((index < 0).sum())} of {len(index)} states have no instruction above "
                f"{self.threshold} (best score {float(score[index < 0].max()):.2f}): select states "
                "with choose_instructions first, or lower threshold"
            )
        chosen = self.pool.to(pixels.device)[index]
        tensordict.set(self.out_keys[0], chosen.reshape(*batch, chosen.shape[-1]))
        return tensordict
