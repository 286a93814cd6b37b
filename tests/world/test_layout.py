from __future__ import annotations

import pytest
import torch
from scipy import stats

from ifo_grounding.errors import UserError
from ifo_grounding.world import Layout, random_layout
from ifo_grounding.world.layout import highest

N = 20_000


@pytest.fixture(scope="module")
def drawn():
    return random_layout(N, generator=torch.Generator().manual_seed(0))


def uniform(counts: torch.Tensor) -> float:
    """p-value of equal probabilities."""
    return float(stats.chisquare(counts.numpy()).pvalue)


def test_counts_are_uniform_within_their_bounds(drawn):
    for cells, low, high in ((drawn.objects, 4, 8), (drawn.boxes, 2, 4)):
        counts = (cells > 0).sum(-1).bincount()
        assert counts[:low].sum() == 0
        assert len(counts) == high + 1
        assert uniform(counts[low:]) > 1e-4


def test_colours_kinds_and_arms_are_equally_likely(drawn):
    assert uniform(drawn.boxes[drawn.boxes > 0].bincount()[1:]) > 1e-4
    assert uniform(drawn.objects[drawn.objects > 0].bincount()[1:]) > 1e-4
    assert uniform(drawn.arm.bincount(minlength=36)) > 1e-4
    assert not drawn.held.any()
    for colour in range(1, 8):  # boxes of a scene differ
        assert ((drawn.boxes == colour).sum(-1) <= 1).all()


def test_every_cell_is_equally_likely(drawn):
    # Counts per cell over scenes are not quite multinomial (cells of a scene exclude each other),
    # which makes the test a little too kind, not too strict: so compare the spread as well.
    for cells in (drawn.objects, drawn.boxes):
        counts = (cells > 0).sum(0)
        share = counts.sum() / (N * 36)
        deviation = (counts - N * share) / (N * share * (1 - share)).sqrt()
        assert deviation.abs().max() < 4.2
        assert uniform(counts) > 1e-4


def test_about_a_third_of_the_objects_starts_inside_a_box(drawn):
    exists, boxed = drawn.objects > 0, (drawn.objects > 0) & (drawn.boxes > 0)
    share = boxed.sum() / exists.sum()
    # 0.35 where boxes are free; with 2-4 boxes for 4-8 objects they sometimes run out.
    assert 0.28 < share < 0.35
    plenty = Layout(objects=(1, 1), boxes=(3, 3))
    alone = random_layout(N, plenty, generator=torch.Generator().manual_seed(1))
    share = ((alone.objects > 0) & (alone.boxes > 0)).sum() / N
    assert abs(share - 0.35) < 4 * (0.35 * 0.65 / N) ** 0.5


def test_the_share_inside_boxes_can_be_chosen():
    never = random_layout(500, Layout(inside=0.0), generator=torch.Generator().manual_seed(0))
    assert not ((never.objects > 0) & (never.boxes > 0)).any()
    always = Layout(objects=(3, 3), boxes=(3, 3), inside=1.0)
    state = random_layout(500, always, generator=torch.Generator().manual_seed(0))
    assert ((state.objects > 0) == (state.boxes > 0)).all()


@pytest.mark.parametrize("size", [3, 10])
def test_grids_of_other_sizes(size):
    layout = Layout(size=size, objects=(2, 5), boxes=(1, 4))
    state = random_layout(300, layout, generator=torch.Generator().manual_seed(size))
    assert state.size == size
    objects, boxes = (state.objects > 0).sum(-1), (state.boxes > 0).sum(-1)
    assert (objects.min(), objects.max(), boxes.min(), boxes.max()) == (2, 5, 1, 4)
    assert state.arm.max() == size * size - 1


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"size": 2}, "3..16"),
        ({"size": 17}, "3..16"),
        ({"objects": (5, 4)}, "objects must be"),
        ({"objects": (-1, 4)}, "objects must be"),
        ({"boxes": (2, 8)}, r"within 0\.\.7"),
        ({"size": 3, "objects": (4, 8), "boxes": (2, 4)}, "do not fit"),
        ({"inside": 1.5}, "probability"),
        ({"excluded_kinds": tuple(range(1, 13))}, "no kind"),
    ],
)
def test_an_impossible_layout_is_refused(wrong, said):
    with pytest.raises(UserError, match=said):
        Layout(**wrong)


@pytest.mark.parametrize("cells", [9, 36, 256])
@pytest.mark.parametrize("values", [2**24, 2**5], ids=["distinct", "many alike"])
def test_places_are_drawn_as_topk_draws_them(cells, values):
    draw = torch.Generator().manual_seed(0)
    lots = torch.randint(values, (5000, cells), generator=draw) / values
    for k in (1, 8, cells):
        assert torch.equal(highest(lots, k), lots.topk(k).indices)
    assert highest(lots, 0).shape == (5000, 0)


def test_worlds_do_not_depend_on_the_default_dtype():
    def drawn():
        return random_layout(100, generator=torch.Generator().manual_seed(0))

    usual = drawn()
    torch.set_default_dtype(torch.float64)
    try:
        assert (drawn() == usual).all()
    finally:
        torch.set_default_dtype(torch.float32)
