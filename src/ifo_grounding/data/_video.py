"""Videos as pictures, and pictures as videos; needs the extra ``video``."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
from PIL import Image

from ifo_grounding.errors import UserError, extra

CODEC = "libx264"


def read_video(path: Path) -> Iterator[Image.Image]:
    """Yield the frames of a video.

    Raises:
        UserError: where it cannot be read, or holds fewer frames than it says.
    """
    iio, av = _libraries()
    read = 0
    try:
        with iio.imopen(path, "r", plugin="pyav") as video:
            expected = video.properties().n_images
            for frame in video.iter():
                read += 1
                yield Image.fromarray(frame)
    except (OSError, av.FFmpegError) as error:
        raise UserError(f"{path} cannot be read ({error})") from None
    # Some formats do not say how many frames they hold: then it is 0.
    if read < expected:
        raise UserError(f"{path} is cut short: it has {read} frames and says {expected}")


def write_video(path: Path, frames: np.ndarray, fps: float) -> None:
    """Write frames, uint8 [T + 1, H, W, 3], as a video that browsers and players show.

    Raises:
        UserError: where a side has an odd number of pixels, which this kind of video cannot have.
    """
    iio, _ = _libraries()
    height, width = frames.shape[1:3]
    if height % 2 or width % 2:
        raise UserError(
            f"a video needs even numbers of pixels, these images have {width}x{height}: give "
            "scale=2, or kind='png'"
        )
    iio.imwrite(path, frames, plugin="pyav", codec=CODEC, fps=fps)


def _libraries() -> tuple[ModuleType, ModuleType]:
    with extra("video", "videos need imageio and PyAV"):
        import av
        import imageio.v3 as iio
    return iio, av
