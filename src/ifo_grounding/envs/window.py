"""A window that shows a world and its instruction; it needs pygame."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from gymnasium.error import DependencyNotInstalled

LINE_HEIGHT = 32
LINE_COLOUR = (235, 235, 235)
BACKGROUND = (14, 15, 18)


class Window:
    """Shows pictures with a line of text below; opens at the first of them.

    Args:
        fps: pictures per second that :meth:`show` waits for.

    Raises:
        DependencyNotInstalled: where pygame is missing.
    """

    def __init__(self, fps: float) -> None:
        try:
            import pygame
        except ImportError as error:
            raise DependencyNotInstalled(
                "render_mode 'human' needs pygame: pip install 'ifo-grounding[human]'"
            ) from error
        self.fps = fps
        self._pygame: Any = pygame
        self._surface: Any = None

    def show(self, frame: np.ndarray, text: str) -> None:
        """Show a picture, uint8 [H, W, 3], and a line of text."""
        pygame = self._pygame
        height, width, _ = frame.shape
        if self._surface is None:
            self._open((width, height + LINE_HEIGHT))
        self._surface.fill(BACKGROUND)
        self._surface.blit(pygame.surfarray.make_surface(frame.swapaxes(0, 1)), (0, 0))
        line = self._font.render(text, True, LINE_COLOUR)
        if line.get_width() > width:
            line = pygame.transform.smoothscale(line, (width, line.get_height()))
        self._surface.blit(line, line.get_rect(center=(width // 2, height + LINE_HEIGHT // 2)))
        pygame.display.set_caption(text)
        pygame.event.pump()
        pygame.display.flip()
        self._clock.tick(self.fps)

    def close(self) -> None:
        """Close the window; a later :meth:`show` opens it again."""
        if self._surface is not None:
            self._pygame.display.quit()
            self._surface = None

    def _open(self, size: tuple[int, int]) -> None:
        pygame = self._pygame
        try:
            pygame.display.init()
        except pygame.error:  # no screen: draw into memory
            os.environ["SDL_VIDEODRIVER"] = "dummy"
            pygame.display.init()
        pygame.font.init()
        self._surface = pygame.display.set_mode(size)
        self._font = pygame.font.Font(None, 22)
        self._clock = pygame.time.Clock()
