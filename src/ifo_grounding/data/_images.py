"""Frames from images as Pillow opens them, and GIFs of which every frame comes back."""

from __future__ import annotations

import re
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
COMMENT = b"ifo-grounding: a frame lasts %d ms"
"""Written into a GIF, so that a frame that lasts longer is told from frames that are equal."""
MOST_FRAMES = 100_000
"""Frames that a GIF may show, repeated ones included."""


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
    """Yield number and image of each frame of an animation.

    Of a GIF that :func:`save_gif` wrote, equal frames in a row come as often as they were saved,
    with the same number: Pillow writes them as one that lasts.

    Raises:
        OSError: (or another of :data:`BROKEN`) where it is damaged or cut short, or shows more than
            :data:`MOST_FRAMES`.
    """
    content = regular_file(path).read_bytes()
    file = BytesIO(content + b"\0")
    shown = 0
    with Image.open(file, formats=FORMATS) as opened:
        said = re.fullmatch(COMMENT.replace(b"%d", b"([1-9]\\d*)"), opened.info.get("comment", b""))
        for number, frame in enumerate(ImageSequence.Iterator(opened)):
            times = round(frame.info.get("duration", 0) / int(said[1])) if said else 1
            shown += max(1, times)
            if shown > MOST_FRAMES:
                raise OSError(f"it shows more than {MOST_FRAMES} frames")
            for _ in range(max(1, times)):
                yield number, frame
        # Pillow takes what there is of a GIF: without its last byte, it has read on to ours.
        if opened.format == "GIF" and file.tell() > len(content):
            raise OSError("it is cut short")


def save_gif(path: Path, images: list[Image.Image], milliseconds: int) -> None:
    """Write an animation whose frames last as long as each other.

    Raises:
        UserError: where it shows the same for longer than a GIF can say.
    """
    try:
        images[0].save(
            path,
            save_all=True,
            append_images=images[1:],
            duration=milliseconds,
            comment=COMMENT % milliseconds,
            loop=0,
        )
    except OverflowError:
        raise UserError(
            f"episode {path.stem!r} stays the same for longer than a GIF can say: save it with "
            "kind='png'"
        ) from None
