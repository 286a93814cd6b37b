"""Actions for demonstrations that have none: an inverse model names what each transition shows."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from tensordict import NestedKey, TensorDict, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer

from ifo_grounding import keys
from ifo_grounding.data.buffers import check_demonstrations, frame_buffer
from ifo_grounding.data.demonstrations import Demonstrations
from ifo_grounding.data.folder import damaged, load_folder, save_folder
from ifo_grounding.errors import UserError, at_least_one
from ifo_grounding.machine import release_freed_memory
from ifo_grounding.modules import device_of, evaluating
from ifo_grounding.progress import progress_bar

KIND = "ifo-grounding labels"
QUANTILES = {"min": 0.0, "p01": 0.01, "p10": 0.1, "median": 0.5}


@dataclass(frozen=True)
class LabelReport:
    """What the inverse model said, and how sure it was.

    >>> report = LabelReport(torch.tensor([0, 0, 2]), torch.tensor([0.9, 1.0, 0.5]), n_actions=3)
    >>> report.counts.tolist(), report.summary()[2]["mean"]
    ([2, 0, 1], 0.5)
    """

    actions: Tensor
    """Label of each transition, in the order of ``Demonstrations.locate()``, integer [M]: uint8
    where it fits, int32 for more than 256 actions."""
    confidence: Tensor
    """Probability that the model gave to its label, float32 [M]."""
    n_actions: int
    """Number of actions."""

    @property
    def counts(self) -> Tensor:
        """Labels of each action, int64 [n_actions]."""
        return self.actions.long().bincount(minlength=self.n_actions)

    def summary(self) -> list[dict[str, float]]:
        """Return count, mean, and low quantiles of the confidence for each action."""
        rows = []
        for action, count in enumerate(self.counts.tolist()):
            row: dict[str, float] = {"action": action, "count": count}
            if count:
                values = self.confidence[self.actions == action].double().numpy()
                found = np.quantile(values, list(QUANTILES.values()), method="lower").tolist()
                row |= dict(zip(("mean", *QUANTILES), (float(values.mean()), *found), strict=True))
            rows.append(row)
        return rows

    def save(self, folder: str | Path) -> None:
        """Write a folder; :func:`labelled_buffer` makes the buffer again from it."""
        arrays = {"actions": self.actions, "confidence": self.confidence}
        save_folder(folder, KIND, arrays, {"n_actions": self.n_actions})

    @classmethod
    def load(cls, folder: str | Path) -> LabelReport:
        """Read what :meth:`save` wrote; a damaged or foreign folder is a :class:`UserError`."""
        arrays, facts = load_folder(folder, KIND, ("actions", "confidence"))
        with damaged(folder):
            return cls(arrays["actions"], arrays["confidence"], facts["n_actions"])


class Labelled(NamedTuple):
    """A labelled replay buffer, and how sure the labels are."""

    buffer: TensorDictReplayBuffer
    """Samples hold ``pixels``, ``instruction``, ``action``, ``final``; see labelled_buffer."""
    report: LabelReport
    """Labels and confidence."""


def label_demonstrations(
    demos: Demonstrations,
    inverse: TensorDictModuleBase,
    *,
    batch_size: int = 1024,
    progress: bool = True,
    **buffer_options: Any,
) -> Labelled:
    """Label every transition of demonstrations with an inverse model (paper, "Labelling").

    The model runs in eval mode without gradients. One of
    :func:`~ifo_grounding.networks.make_inverse` whose patches are the codec's tiles is shown these,
    with the same result: no picture is put together.

    Args:
        inverse: reads ``pixels`` and ``("next", "pixels")``, or two images of other names: the one
            below ``next``, else the second, is the later one. Logits [B, A] are its first output.
        buffer_options: for :func:`labelled_buffer`.

    Raises:
        UserError: where no episode has two frames, or the model writes no such logits.
    """
    check_demonstrations(demos)
    if not demos.transitions:
        raise UserError("there is nothing to label: no episode has two frames")
    batch_size = at_least_one("batch_size", batch_size)
    device = device_of(inverse) or torch.device("cpu")
    frame = demos.locate()[1]
    labels, sure, n_actions = [], [], 0
    with evaluating(inverse), progress_bar(total=len(frame), desc="label", shown=progress) as bar:
        for count, numbers in enumerate(frame.split(batch_size), 1):
            logits = _logits(demos, inverse, numbers, device)
            n_actions = logits.shape[-1]
            best = logits.float().softmax(-1).max(-1)
            if not best.values.isfinite().all():
                raise UserError("the inverse model's logits are not all finite: train it anew")
            labels.append(best.indices.to("cpu", torch.uint8 if n_actions <= 256 else torch.int32))
            sure.append(best.values.cpu())
            bar.update(len(numbers))
            if not count % 16:  # freed blocks differ in size and would pile up
                release_freed_memory()
    report = LabelReport(torch.cat(labels), torch.cat(sure), n_actions)
    return Labelled(labelled_buffer(demos, report.actions, **buffer_options), report)


def labelled_buffer(
    demos: Demonstrations, actions: Tensor, **options: Any
) -> TensorDictReplayBuffer:
    """Put demonstrations and labels into a replay buffer, which shares the demonstrations' frames.

    Entry number i is transition number i of ``demos.locate()``. A sample holds ``pixels`` uint8
    [B, C, H, W], ``instruction`` int64 [B, L], ``action`` int64 [B], and ``final`` bool [B, 1],
    true for the last transition of a demonstration. A transition takes 17 to 25 bytes.

    Args:
        actions: label of each transition, integer [M].
        options: for ``TensorDictReplayBuffer``, such as ``batch_size`` or ``generator``.

    Raises:
        UserError: where there is not one label for each transition, or one is no action's number.

    >>> frames = [torch.zeros(3, 3, 48, 48, dtype=torch.uint8) for _ in range(5)]
    >>> demos = Demonstrations.from_arrays(frames, ["go up"] * 5)
    >>> buffer = labelled_buffer(demos, torch.zeros(10).long())
    >>> buffer.sample(4)["pixels"].shape
    torch.Size([4, 3, 48, 48])
    """
    check_demonstrations(demos)
    actions = torch.as_tensor(actions)
    if actions.shape != (demos.transitions,):
        raise UserError(
            f"there are {demos.transitions} transitions, but labels {list(actions.shape)}: were "
            "they made for these demonstrations?"
        )
    if actions.numel() and (actions.is_floating_point() or (actions < 0).any()):
        raise UserError("labels are numbers of actions, whole and from 0 on")
    episode, frame = demos.locate()
    last = demos.starts + demos.lengths - 2
    stored: dict[NestedKey, Tensor] = {
        keys.PIXELS: frame,
        keys.INSTRUCTION: episode,
        keys.ACTION: actions.long(),
        keys.FINAL: (frame == last[episode]).unsqueeze(-1),
    }
    return frame_buffer(demos, stored, [keys.PIXELS], **options)


def _logits(
    demos: Demonstrations, inverse: TensorDictModuleBase, frame: Tensor, device: torch.device
) -> Tensor:
    """Return the logits [B, A] of transitions that begin with some frames, int64 [B]."""
    read = [unravel_key(key) for key in getattr(inverse, "in_keys", ())]
    if len(read) != 2:
        read = [keys.PIXELS, keys.NEXT_PIXELS]
    later_first = isinstance(read[0], tuple) and read[0][0] == keys.NEXT
    numbers = [frame + 1, frame] if later_first else [frame, frame + 1]
    reads_tiles = getattr(getattr(inverse, "module", None), "reads_tiles", None)
    if reads_tiles is not None and reads_tiles(demos.image_shape, demos.tile_size):
        parts = (demos.codec.tiles, *(demos.codes[each] for each in numbers))
        return inverse.module.from_tiles(*(cast(Tensor, part).to(device) for part in parts))
    pair = TensorDict({}, [len(frame)])
    for key, each in zip(read, numbers, strict=True):
        pair[key] = demos.frames(each).to(device)
    key = next(iter(getattr(inverse, "out_keys", ())), keys.LOGITS)
    logits = inverse(pair).get(key, None)
    if logits is None or logits.ndim != 2 or len(logits) != len(frame):
        found = "nothing" if logits is None else list(logits.shape)
        raise UserError(f"the inverse model wrote {found} at {key!r}, not logits [B, A]")
    return logits
