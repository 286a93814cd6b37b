"""Where the channels of an image are: first, as networks read them, or last, as files hold them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def channels_last(shape: Sequence[int]) -> bool:
    """Say whether an image [..., C, H, W] or [..., H, W, C] is the latter: C is the shortest."""
    return shape[-1] < min(shape[-3:-1])


def channels_first(images: np.ndarray) -> np.ndarray:
    """Return images [N, H, W], or [N, ..., H, W, C] or [N, ..., C, H, W], as [N, C, H, W].

    What is stacked before them, such as the last frames, becomes channels.

    >>> channels_first(np.zeros((7, 4, 20, 28, 3), np.uint8)).shape
    (7, 12, 20, 28)
    """
    if images.ndim > 3 and channels_last(images.shape):
        images = np.moveaxis(images, -1, -3)
    return np.ascontiguousarray(images).reshape(len(images), -1, *images.shape[-2:])
