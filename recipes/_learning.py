"""How a recipe learns: by which settings, from which beginning, and what is left of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from _shared import plain, shows_progress
from omegaconf import DictConfig
from torch import nn
from torchrl.data import ReplayBuffer

from ifo_grounding import networks
from ifo_grounding.data import FrameDecoder
from ifo_grounding.objectives import SupervisedLoss
from ifo_grounding.seeding import derive
from ifo_grounding.training import FitConfig, HeldOut, SelfExaminationConfig, fit
from ifo_grounding.training.run import Stage
from ifo_grounding.training.supervised import Metrics, Validation


def train(
    options: DictConfig,
    stage: Stage,
    loss: nn.Module,
    buffer: ReplayBuffer,
    section: str,
    file: str,
    held_out: Validation | None = None,
    finish: Callable[[], Any] | None = None,
    checkpoint: Path | None = None,
    tried: Sequence[Metrics] = (),
    **found: float,
) -> dict:
    """Fit a network to a buffer, do what is left to do, save it, and finish with what was found.

    What was ``tried`` before, up to the checkpoint, is logged first.
    """
    log = stage.log()
    if log is not None:
        for metrics in tried:
            log(metrics, int(metrics["step"]))
    history = learn(options, stage, loss, buffer, section, checkpoint, held_out=held_out, log=log)
    if finish is not None:
        finish()
    stage.replace()
    networks.save(loss.network, stage.run / file)  # type: ignore[arg-type]
    return stage.finish({**history[-1], **found}, history)


def learn(
    options: DictConfig,
    stage: Stage,
    loss: nn.Module,
    buffer: ReplayBuffer,
    section: str,
    checkpoint: Path | None = None,
    **kwargs: Any,
) -> list[Metrics]:
    """Learn on from a checkpoint as a section of the options says."""
    decode_on(options.device, buffer)
    return fit(
        loss,
        buffer,
        fit_config(options[section]),
        seed=options.seed,
        name=stage.name,
        checkpoint=checkpoint or stage.checkpoint,
        checkpoint_seconds=options.checkpoint_seconds,
        progress=shows_progress(options),
        settings=stage.settings,
        cudagraph=True,
        **kwargs,
    )


def decode_on(device: str, buffer: ReplayBuffer) -> None:
    """Let a buffer keep its frames on a GPU and decode them there, unless they are pixels."""
    transform = getattr(buffer, "transform", None)  # of several buffers there is none
    if transform is None or torch.device(device).type == "cpu":
        return
    parts = [part for part in transform.modules() if isinstance(part, FrameDecoder)]
    if all(part.table is not None for part in parts):
        transform.to(device)


def beginning_seed(options: DictConfig, number: int) -> int:
    """Return the seed of the initial weights of a beginning."""
    return derive(options.seed, "beginning", number) if number else options.seed


class Beginning:
    """One of several ways to begin learning, of which the best one after a few steps goes on."""

    def __init__(
        self,
        options: DictConfig,
        stage: Stage,
        section: str,
        loss: SupervisedLoss,
        seen: ReplayBuffer,
        number: int,
        held_out: ReplayBuffer | None = None,
    ) -> None:
        self.options, self.stage, self.section = options, stage, section
        self.loss, self.seen, self.number = loss, seen, number
        self.validation = HeldOut(loss, held_out) if held_out is not None else None
        self.tried: list[Metrics] = []
        self.checkpoint = stage.checkpoint.with_stem(f"{stage.checkpoint.stem}-{number}")

    def try_out(self, times: int = 1) -> float:
        """Learn for so many trials, leave a checkpoint to go on from, and return the loss."""
        section = self.options[self.section]
        steps = min(times * section.trial_steps, section.steps)
        history = self.learn(until=steps)
        iteration = fit_config(section).iteration
        self.tried = history[: math.ceil(steps / iteration)]
        return self.tried[-1][self.loss.out_keys[0]]

    def learn(self, until: int | None = None) -> list[Metrics]:
        """Learn on from the checkpoint, up to some step or to the end."""
        return learn(*self._what, self.checkpoint, held_out=self.validation, until=until)

    def train(self, file: str, finish: Callable[[], Any] | None = None) -> dict:
        """Learn on to the end, and save the network."""
        return train(
            *self._what,
            file,
            held_out=self.validation,
            finish=finish,
            checkpoint=self.checkpoint,
            tried=self.tried,
            beginning=float(self.number),
        )

    @property
    def _what(self) -> tuple[DictConfig, Stage, SupervisedLoss, ReplayBuffer, str]:
        return self.options, self.stage, self.loss, self.seen, self.section


def fit_config(section: DictConfig) -> FitConfig:
    """Return the part of a section that says how long and how fast to learn."""
    return FitConfig(**_known(section, FitConfig))


def self_examination_config(section: DictConfig) -> SelfExaminationConfig:
    """Return the part of a section that says how the policy is improved."""
    return SelfExaminationConfig(**_known(section, SelfExaminationConfig))


def _known(section: DictConfig, kind: Any) -> dict[str, Any]:
    return {k: v for k, v in plain(section).items() if k in kind.__dataclass_fields__}
