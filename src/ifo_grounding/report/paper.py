"""What the paper reports, in percent: Tables 2 to 4, by task."""

from __future__ import annotations

from ifo_grounding.tasks import TASKS

EPISODES = 500
"""The paper's rates are multiples of 0.2%: they look like this many episodes each."""
TABLE_2 = {
    "move": (76.6, 79.4, 78.4),
    "move-udlr": (69.0, 73.4, 72.4),
    "pick": (13.0, 15.0, 15.4),
    "pick-out": (32.8, 34.0, 34.6),
    "pick-udlr": (22.6, 26.0, 24.8),
}
"""Success after phase 1, and after phase 2 with 5,000 and with 10,000 pairs."""
TABLE_3 = dict(zip(TASKS, (91.725, 81.145, 90.190, 77.940, 76.810), strict=True))
"""Suitable instructions among those chosen."""
TABLE_4 = dict(
    zip(TASKS, ((62.8, 68.4), (56.8, 60.6), (11.2, 14.6), (27.4, 29.8), (19.8, 21.0)), strict=True)
)
"""Success on held-out pairs of colour and shape, after phase 1 and after phase 2."""
