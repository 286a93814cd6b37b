"""GIFs of which every frame comes back: Pillow writes equal ones in a row as one that lasts."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from PIL import Image, ImageSequence

from ifo_grounding.errors import UserError

COMMENT = b"ifo-grounding: a frame lasts %d ms"
"""Written into a GIF, so that a frame that lasts longer is told from frames that are equal."""
EXTENSION, PICTURE, TRAILER = 0x21, 0x2C, 0x3B
"""First bytes of the blocks of a GIF."""


def animation_frames(path: Path, opened: Image.Image) -> Iterator[tuple[int, Image.Image]]:
    """Yield number and picture of each frame of an animated picture.

    Of a GIF that :func:`save_gif` wrote, equal frames in a row come as often as they were saved,
    with the same number.

    Raises:
        OSError: for a GIF that is cut short.
    """
    lasts = None
    if opened.format == "GIF":
        _check_whole(path.read_bytes())
        lasts = _lasts(opened)
    for number, frame in enumerate(ImageSequence.Iterator(opened)):
        times = round(frame.info.get("duration", 0) / lasts) if lasts else 1
        for _ in range(max(1, times)):
            yield number, frame


def _check_whole(content: bytes) -> None:
    """Refuse a GIF that is cut short: Pillow takes what there is where a block has ended.

    Raises:
        OSError: where its blocks do not lead to its trailer.
    """
    try:
        at = 13 + _palette_bytes(content[10])
        while content[at] != TRAILER:
            if content[at] == PICTURE:
                at += 11 + _palette_bytes(content[at + 9])
            elif content[at] == EXTENSION:
                at += 2
            else:  # bytes between blocks mean nothing
                at += 1
                continue
            while content[at]:
                at += 1 + content[at]
            at += 1
    except IndexError:
        raise OSError("it is cut short") from None


def _palette_bytes(flags: int) -> int:
    return 3 << (flags & 7) + 1 if flags & 0x80 else 0


def _lasts(gif: Image.Image) -> int | None:
    """Return the milliseconds that a frame of a GIF lasts, where it says so."""
    said = re.fullmatch(COMMENT.replace(b"%d", b"([1-9][0-9]*)"), gif.info.get("comment", b""))
    return int(said[1]) if said else None


def save_gif(path: Path, pictures: list[Image.Image], milliseconds: int) -> None:
    """Write an animation whose frames last as long as each other.

    Raises:
        UserError: where it shows the same for longer than a GIF can say.
    """
    try:
        pictures[0].save(
            path,
            save_all=True,
            append_images=pictures[1:],
            duration=milliseconds,
            comment=COMMENT % milliseconds,
            loop=0,
        )
    except OverflowError:
        raise UserError(
            f"episode {path.stem!r} stays the same for longer than a GIF can say: save it with "
            "kind='png'"
        ) from None
