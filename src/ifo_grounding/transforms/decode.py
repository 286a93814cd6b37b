"""Frame decoding for replay buffers; it lives with the codec, since buffers of data need it too."""

from ifo_grounding.data.decoding import FrameDecoder, Lookup

__all__ = ["FrameDecoder", "Lookup"]
