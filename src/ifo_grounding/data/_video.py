"""Videos as pictures, and pictures as videos; needs the extra ``video``."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ifo_grounding.errors import UserError, optional
from ifo_grounding.files import regular_file

CODEC = "libx264"
OPTIONS = {"format_whitelist": "mov,matroska,avi", "protocol_whitelist": "file"}
"""A file that is a list of others, or of addresses, is no video."""


def read_video(path: Path) -> Iterator[Image.Image]:
    """Yield the frames of a video as a player shows them; refuse one that ends before it says.

    The time of a frame in seconds is its ``info["time"]``.
    """
    av = optional("av", extra="video")
    # What titles say is not read, nor has to be UTF-8: since PyAV 19 it needs no option for that.
    lenient = {"metadata_errors": "replace"} if int(av.__version__.split(".")[0]) < 19 else {}
    whole, end = 0, 0.0
    try:
        opened = f"file:{regular_file(path)}"
        with av.open(opened, options=OPTIONS, **lenient) as video:
            if not video.streams.video:
                raise UserError(f"{path} cannot be read (it shows nothing: is it cut short?)")
            stream = video.streams.video[0]
            for packet in video.demux(stream):
                if packet.size and packet.pts is not None and not packet.is_corrupt:
                    whole += 1
                    end = max(end, float((packet.pts + (packet.duration or 0)) * packet.time_base))
                for frame in packet.decode():
                    pixels = frame.to_ndarray(format="rgb24")
                    shown = Image.fromarray(np.rot90(pixels, round(frame.rotation / 90)))
                    shown.info["time"] = frame.time
                    yield shown
            expected, seconds, rate = stream.frames, _seconds(video, stream), stream.average_rate
    except (OSError, av.FFmpegError) as error:
        raise UserError(f"{path} cannot be read ({error})") from None
    # Where an editor left frames that are not shown, time is right and the count is not.
    if seconds and rate and end + 0.5 / rate < seconds:
        raise UserError(f"{path} is cut short: it ends at {end:.2f} s and says {seconds:.2f} s")
    if not seconds and whole < expected:
        raise UserError(f"{path} is cut short: it has {whole} frames and says {expected}")


def _seconds(video: Any, stream: Any) -> float:
    """Return when the frames of a video end, as far as it says so itself, else 0."""
    if stream.duration:
        return float(stream.duration * stream.time_base)
    tagged = stream.metadata.get("DURATION", "")
    if tagged.count(":") == 2:
        hours, minutes, seconds = tagged.split(":")
        return 3600 * int(hours) + 60 * int(minutes) + float(seconds)
    alone = len(video.streams) == 1 and video.duration
    return video.duration / 1e6 if alone else 0.0


def write_video(path: Path, frames: np.ndarray, fps: int) -> None:
    """Write frames, uint8 [T + 1, H, W, 3], as a video that browsers and players show."""
    av = optional("av", extra="video")
    height, width = frames.shape[1:3]
    if height % 2 or width % 2:
        raise UserError(
            f"a video needs even numbers of pixels, these images have {width}x{height}: give "
            "scale=2, or kind='png'"
        )
    with av.open(path, "w") as video:
        stream = video.add_stream(CODEC, rate=fps)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for frame in frames:
            video.mux(stream.encode(av.VideoFrame.from_ndarray(frame)))
        video.mux(stream.encode())
