"""Data-parallel learning: the processes that ``torchrun`` starts learn one network together."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, distributed, nn
from torch.nn.parallel import DistributedDataParallel
from torchrl.data import ReplayBuffer

from ifo_grounding.errors import UserError
from ifo_grounding.seeding import derive
from ifo_grounding.training.loop import Metrics
from ifo_grounding.training.run import Run

READ = ("demonstrations", "labels", "transitions", "truth")
"""Folders of a run that learning only reads."""


def processes() -> int:
    """Return how many processes learn together, 1 where each one learns alone."""
    there = distributed.is_available() and distributed.is_initialized()
    return distributed.get_world_size() if there else 1


def rank() -> int:
    """Return the number of this process among those that learn together; the first one writes."""
    return distributed.get_rank() if processes() > 1 else 0


@contextlib.contextmanager
def together(run: str, device: str) -> Iterator[tuple[str, str]]:
    """Join the processes of ``torchrun``; yield the run and the device of this one.

    The first process works on the run itself, the others on copies that are dropped, so that all of
    them do the same and one of them writes. Without ``torchrun`` nothing changes.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield run, device
        return
    on_gpu = torch.device(device).type == "cuda"
    if on_gpu:
        device = f"cuda:{os.environ['LOCAL_RANK']}"
        torch.cuda.set_device(device)
    distributed.init_process_group("nccl" if on_gpu else "gloo")
    original = Run(run)
    with contextlib.ExitStack() as stack:
        stack.callback(distributed.destroy_process_group)
        if not rank():
            stack.callback(original.drop_if_empty)
            stack.enter_context(original.lock())
        distributed.barrier()  # its unfinished files are gone
        if rank():
            run = stack.enter_context(tempfile.TemporaryDirectory())
            copy_run(original.folder, Path(run))
            stack.enter_context(contextlib.redirect_stdout(None))
        distributed.barrier()  # until then, nothing in the run changes
        yield run, device


def copy_run(folder: Path, to: Path) -> None:
    """Copy a run's folder, but for large folders that learning only reads, which are linked to."""
    shutil.copytree(folder, to, ignore=shutil.ignore_patterns(*READ), dirs_exist_ok=True)
    for name in READ:
        if (folder / name).exists():
            (to / name).symlink_to((folder / name).resolve())


def averaging(loss: nn.Module) -> Callable[[TensorDictBase], Any]:
    """Return a loss whose gradients are the mean over all processes: itself where it learns alone.

    A network may leave some of its weights unused, the same ones in every step.
    """
    if processes() == 1:
        return loss
    return DistributedDataParallel(_Losses(loss), static_graph=True)


class _Losses(nn.Module):
    """A loss that returns a dict, in which DistributedDataParallel finds what was computed."""

    def __init__(self, loss: nn.Module) -> None:
        super().__init__()
        self.loss = loss

    def forward(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Compute the losses of a batch."""
        return dict(self.loss(batch).items())


def samples(buffer: ReplayBuffer, size: int, count: int, seed: int) -> Iterator[TensorDictBase]:
    """Draw ``count`` batches of ``size`` samples by torch's randomness, seeded here.

    Processes that learn together draw the same batches and take an equal share of each; all further
    randomness is their own.

    Raises:
        UserError: where shares are unequal.
    """
    torch.manual_seed(seed)
    if processes() == 1:
        for _ in range(count):
            yield buffer.sample(size)
        return
    if size % processes():
        raise UserError(f"batch_size={size} samples are no {processes()} equal shares")
    drawn = [buffer.sampler.sample(buffer.storage, size)[0] for _ in range(count)]
    torch.manual_seed(derive(seed, "process", rank()))
    for index in drawn:
        yield buffer[index[rank() :: processes()]]


def averaged(metrics: Metrics, device: torch.device) -> Metrics:
    """Return the means of metrics over all processes."""
    if processes() == 1:
        return metrics
    values = torch.tensor([*metrics.values()], dtype=torch.float64, device=device)
    distributed.all_reduce(values)
    return dict(zip(metrics, (values / processes()).tolist(), strict=True))
