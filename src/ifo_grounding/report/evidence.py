"""A picture of what words say about things."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from ifo_grounding.evaluation.words import WordEvidence
from ifo_grounding.report.plots import _dress, _figure
from ifo_grounding.report.theme import PALETTE

AGAINST, FOR = "#B5532A", PALETTE[0]


def evidence_figure(said: WordEvidence, held_out: Sequence[str] = ()) -> Figure:
    """Draw what words say of the colours and of the forms of objects, for and against.

    Each word's evidence is shown as a share of the most that it says about anything.

    Args:
        said: from :func:`~ifo_grounding.evaluation.word_evidence`.
        held_out: objects that no instruction of the demonstrations mentions, which are marked.

    >>> import torch
    >>> said = WordEvidence(("red",), ("red circle", "blue circle"), torch.ones(2, 1),
    ...                     torch.zeros(2, 1))
    >>> axes = evidence_figure(said, ["blue circle"]).axes
    >>> [label.get_text() for label in axes[0].get_yticklabels()]
    ['red circle', 'blue circle *']
    """
    most = torch.cat([said.colour, said.form]).abs().amax(0).clamp_min(1e-9)
    panels = {"of colours": said.colour / most, "of form": said.form / most}
    colours = LinearSegmentedColormap.from_list("evidence", [AGAINST, "#F7F7F4", FOR])
    height = 1.3 + 0.27 * len(said.objects)
    figure, grid = _figure(2.6 + 0.95 * len(said.words), height, columns=2)
    for axes, (title, values) in zip(grid[0], panels.items(), strict=True):
        _dress(axes, f"What words say {title}", grid="")
        axes.imshow(values.numpy(), cmap=colours, vmin=-1, vmax=1, aspect="auto")
        axes.set_xticks(range(len(said.words)), said.words, rotation=40, ha="right")
        names = [f"{name} *" if name in held_out else name for name in said.objects]
        axes.set_yticks(range(len(names)), names if axes is grid[0][0] else [""] * len(names))
        for row in range(len(said.objects)):
            for column in range(len(said.words)):
                value = float(values[row, column])
                strong = abs(value) > 0.6
                axes.text(
                    column,
                    row,
                    f"{value:.1f}".replace("-0.0", "0.0"),
                    ha="center",
                    va="center",
                    fontsize=8,
                    color="#FDFDFD" if strong else "#10202E",
                )
    return figure
