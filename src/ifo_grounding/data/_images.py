"""Frames from images and animations, as Pillow opens them."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image, ImageOps, ImageSequence

from ifo_grounding.data._episodes import Name
from ifo_grounding.errors import UserError
from ifo_grounding.files import regular_file

SUFFIXES = (
    *(".png", ".jpg", ".jpeg", ".jpe", ".jfif", ".bmp", ".webp"),
    *(".tif", ".tiff", ".ppm", ".pgm", ".tga"),
)
"""Of the files of a folder that are its frames."""
FORMATS = ("PNG", "JPEG", "BMP", "WEBP", "TIFF", "PPM", "TGA", "GIF")
"""What is decoded, whatever a file is called: no format that runs other programs."""
MODES = {1: "L", 3: "RGB", 4: "RGBA"}
"""Modes of Pillow by channels."""
NOT_BYTES = ("F", "I", "I;16", "I;16L", "I;16B", "I;16N")
"""Modes of Pillow whose values are not bytes: turned into bytes, most become black or white."""
BROKEN = (
    *(OSError, SyntaxError, ValueError, IndexError, EOFError, TypeError),
    *(struct.error, Image.DecompressionBombError),
)
"""What Pillow raises for files that are damaged, cut short, or no files."""


def open_image(source: Path | bytes) -> Image.Image:
    """Open an image, a regular file or its content.

    Raises:
        OSError: (or another of :data:`BROKEN`) where it is no image of :data:`FORMATS`.
    """
    given = regular_file(source) if isinstance(source, Path) else BytesIO(source)
    return Image.open(given, formats=FORMATS)


def stack_images(
    name: Name, images: Iterable[tuple[str, Image.Image]], channels: int = 3
) -> np.ndarray:
    """Return the images of an episode, each with its own name, as frames [T + 1, C, H, W].

    C is the number of ``channels``: 1 for grey, 3 for colours, 4 with alpha.

    Raises:
        UserError: naming the episode and the image, where there is none, or one is of another size
            or not made of bytes.
    """
    frames: list[np.ndarray] = []
    for place, image in images:
        if image.mode in NOT_BYTES:
            raise UserError(
                f"episode {name!r}: {place} has numbers of mode {image.mode!r}: save it with 8 "
                "bits per colour"
            )
        try:
            if image.getexif().get(ExifTags.Base.Orientation, 1) != 1:
                image = ImageOps.exif_transpose(image)  # as it is shown
            shown = np.asarray(image.convert(MODES[channels]))
        except BROKEN as error:
            raise UserError(f"episode {name!r}: {place} cannot be read ({error})") from None
        frames.append(shown.reshape(*shown.shape[:2], channels))
        if frames[-1].shape != frames[0].shape:
            found, first = (f"{one.shape[1]}x{one.shape[0]}" for one in (frames[-1], frames[0]))
            raise UserError(
                f"episode {name!r}: {place} has {found} pixels, the first frame has {first}: scale "
                "them to one size"
            )
    if not frames:
        raise UserError(f"episode {name!r} has no frames")
    return np.stack(frames).transpose(0, 3, 1, 2)


def animation_frames(path: Path) -> Iterator[tuple[int, Image.Image]]:
    """Yield number and image of each frame of an animation, however long it is shown.

    Raises:
        OSError: (or another of :data:`BROKEN`) where it is damaged or cut short.
    """
    content = regular_file(path).read_bytes()
    file = BytesIO(content + b"\0")
    with Image.open(file, formats=FORMATS) as opened:
        yield from enumerate(ImageSequence.Iterator(opened))
        # Pillow takes what there is of a GIF: without its last byte, it has read on to ours.
        if opened.format == "GIF" and file.tell() > len(content):
            raise OSError("it is cut short")
