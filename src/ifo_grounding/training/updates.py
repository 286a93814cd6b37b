"""One gradient step: the optimizer, the sum of losses, the update."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from ifo_grounding.networks.warm_start import inherited


def make_optimizer(
    parameters: Iterable[nn.Parameter], lr: float, weight_decay: float = 0.0
) -> torch.optim.Optimizer:
    """Return AdamW in its fused form."""
    trained = [parameter for parameter in parameters if parameter.requires_grad]
    return torch.optim.AdamW(trained, lr=lr, weight_decay=weight_decay, fused=True)


def decay_towards_origin(optimizer: torch.optim.Optimizer, module: nn.Module) -> None:
    """Let the weights that a module has inherited decay towards what they were, not to zero."""
    begun = [(weight, start) for weight, start in inherited(module) if weight.requires_grad]

    @torch.no_grad()
    def undo(optimizer: torch.optim.Optimizer, *_: Any) -> None:
        group = optimizer.param_groups[0]
        for weight, start in begun:
            weight.add_(start, alpha=group["lr"] * group["weight_decay"])

    optimizer.register_step_post_hook(undo)


def total_loss(losses: TensorDictBase) -> Tensor:
    """Add up all entries named ``loss_*``."""
    return torch.stack(
        [value.mean() for key, value in losses.items() if str(key).startswith("loss_")]
    ).sum()


def update(
    losses: TensorDictBase, optimizer: torch.optim.Optimizer, grad_clip: float
) -> dict[str, Tensor]:
    """Make one gradient step and return what the losses and metrics were."""
    optimizer.zero_grad(set_to_none=True)
    total_loss(losses).backward()
    trained = [p for group in optimizer.param_groups for p in group["params"]]
    norm = nn.utils.clip_grad_norm_(trained, grad_clip)
    optimizer.step()
    scalars = {str(key): value.detach().float().mean() for key, value in losses.items()}
    return {**scalars, "grad_norm": norm.detach()}
