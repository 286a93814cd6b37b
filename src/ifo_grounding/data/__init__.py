"""Data: frames stored compactly, demonstrations without actions, transitions and labels."""

from ifo_grounding.data.babyai import babyai, bot_outcomes, record_babyai
from ifo_grounding.data.buffers import first_frame_buffer, goal_buffer
from ifo_grounding.data.codec import FrameCodec
from ifo_grounding.data.decoding import FrameDecoder, show_codes
from ifo_grounding.data.demonstrations import Demonstrations
from ifo_grounding.data.huggingface import from_huggingface, to_huggingface
from ifo_grounding.data.labelling import (
    Labelled,
    LabelReport,
    label_demonstrations,
    labelled_buffer,
)
from ifo_grounding.data.lerobot import load_lerobot, save_lerobot
from ifo_grounding.data.minari import from_minari, to_minari
from ifo_grounding.data.pictures import load_pictures, save_pictures
from ifo_grounding.data.recording import record_demonstrations
from ifo_grounding.data.transitions import Collected, TransitionReport, collect_transitions
from ifo_grounding.data.truth import Truth

__all__ = [
    "Collected",
    "Demonstrations",
    "FrameCodec",
    "FrameDecoder",
    "LabelReport",
    "Labelled",
    "TransitionReport",
    "Truth",
    "babyai",
    "bot_outcomes",
    "collect_transitions",
    "first_frame_buffer",
    "from_huggingface",
    "from_minari",
    "goal_buffer",
    "label_demonstrations",
    "labelled_buffer",
    "load_lerobot",
    "load_pictures",
    "record_babyai",
    "record_demonstrations",
    "save_lerobot",
    "save_pictures",
    "show_codes",
    "to_huggingface",
    "to_minari",
]
