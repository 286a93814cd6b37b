"""Frames from images and animations, as Pillow opens them."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image, ImageOps, ImageSequence

from ifo_grounding.data._episodes import check_size
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

Source = Image.Image | Path | bytes
"""An image, its file, or what is in the file."""


def open_image(source: Path | bytes) -> Image.Image:
    """Open a single image (of a photo, which may hold a preview too, the first) or raise BROKEN."""
    content = regular_file(source).read_bytes() if isinstance(source, Path) else source
    image = Image.open(BytesIO(content), formats=FORMATS)
    if image.format == "PNG":  # Pillow compares a PNG's checksums if asked to, and then opens anew
        image.verify()
        image = Image.open(BytesIO(content), formats=FORMATS)
    if image.format != "MPO" and (count := getattr(image, "n_frames", 1)) > 1:
        raise OSError(f"it holds {count} pictures: save them one by one")
    return image


def stack_images(
    images: Iterable[tuple[str, Source]],
    channels: int = 3,
    size: tuple[int, int] | None = None,
) -> np.ndarray:
    """Return the images of an episode, each with its name, as frames [T + 1, C, H, W].

    C is the number of ``channels``: 1 for grey, 3 for colours, 4 with alpha. With a ``size``, (H,
    W), images are scaled to it.

    Raises:
        UserError: naming the image that cannot be read, is of another size or not made of bytes;
            or where there is none.
    """
    frames: list[np.ndarray] = []
    for name, source in images:
        try:
            shown = _pixels(source, MODES[channels], size)
        except BROKEN as error:
            raise UserError(f"{name} cannot be read ({error})") from None
        frames.append(shown.reshape(*shown.shape[:2], channels))
        check_size(len(frames), len(frames) * shown.nbytes)
        if frames[-1].shape != frames[0].shape:
            found, first = (f"{one.shape[1]}x{one.shape[0]}" for one in (frames[-1], frames[0]))
            raise UserError(
                f"{name} has {found} pixels, the first frame has {first}: scale them to one size"
            )
    if not frames:
        raise UserError("it has no frames")
    return np.stack(frames).transpose(0, 3, 1, 2)


def _pixels(source: object, mode: str, size: tuple[int, int] | None) -> np.ndarray:
    """Return an image as it is shown, uint8 [H, W] or [H, W, C]."""
    if not isinstance(source, Source):
        raise TypeError(f"{source!r:.40} is no picture")
    image = source if isinstance(source, Image.Image) else open_image(source)
    if image.mode in NOT_BYTES:
        raise ValueError(f"it has numbers of mode {image.mode!r}: save 8 bits per colour")
    if image.getexif().get(ExifTags.Base.Orientation, 1) != 1:
        image = ImageOps.exif_transpose(image)
    image = image.convert(mode)
    return np.asarray(image.resize(size[::-1]) if size else image)


def animation_frames(path: Path) -> Iterator[Image.Image]:
    """Yield each frame of an animation, however long it is shown; refuse one that is cut short."""
    try:
        content = regular_file(path).read_bytes()
        file = BytesIO(content + b"\0")
        with Image.open(file, formats=FORMATS) as opened:
            yield from ImageSequence.Iterator(opened)
            # Pillow takes what there is of a GIF: without its last byte, it has read on to ours.
            if opened.format == "GIF" and file.tell() > len(content):
                raise OSError("it is cut short")
    except BROKEN as error:
        raise UserError(f"{path} cannot be read ({error})") from None
