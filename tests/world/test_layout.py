import pytest
import torch
from scipy import stats

from ifo_grounding.errors import UserError
from ifo_grounding.seeding import Lots
from ifo_grounding.world import Layout, random_layout

N = 20_000


@pytest.fixture(scope="module")
def drawn():
    return random_layout(Lots(0, torch.arange(N)))


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


def test_about_a_third_of_the_objects_starts_inside_a_box(drawn):
    exists, boxed = drawn.objects > 0, (drawn.objects > 0) & (drawn.boxes > 0)
    share = boxed.sum() / exists.sum()
    # 0.35 where boxes are free; with 2-4 boxes for 4-8 objects they sometimes run out.
    assert 0.28 < share < 0.35
    plenty = Layout(objects=(1, 1), boxes=(3, 3))
    alone = random_layout(Lots(1, torch.arange(N)), plenty)
    share = ((alone.objects > 0) & (alone.boxes > 0)).sum() / N
    assert abs(share - 0.35) < 4 * (0.35 * 0.65 / N) ** 0.5


@pytest.mark.parametrize("size", [3, 10])
def test_grids_of_other_sizes(size):
    layout = Layout(size=size, objects=(2, 5), boxes=(1, 4))
    state = random_layout(Lots(size, torch.arange(300)), layout)
    assert state.size == size
    objects, boxes = (state.objects > 0).sum(-1), (state.boxes > 0).sum(-1)
    assert (objects.min(), objects.max(), boxes.min(), boxes.max()) == (2, 5, 1, 4)
    assert state.arm.max() == size * size - 1


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"size": 2}, "3..16"),
        ({"objects": (5, 4)}, "objects must be"),
        ({"objects": (-1, 4)}, "objects must be"),
        ({"boxes": (2, 8)}, r"within 0\.\.7"),
        ({"size": 3, "objects": (4, 8), "boxes": (2, 4)}, "do not fit"),
        ({"inside": 1.5}, r"inside must be within 0\.\.1"),
        ({"excluded_kinds": tuple(range(1, 13))}, "no kind"),
    ],
)
def test_an_impossible_layout_is_refused(wrong, said):
    with pytest.raises(UserError, match=said):
        Layout(**wrong)


def test_lots_are_those_of_splitmix64():
    def mixed(bits: int) -> int:
        bits = ((bits ^ bits >> 30) * 0xBF58476D1CE4E5B9) % 2**64
        bits = ((bits ^ bits >> 27) * 0x94D049BB133111EB) % 2**64
        return bits ^ bits >> 31

    step, lots = 0x9E3779B97F4A7C15, Lots(7, torch.tensor([0, 41]), torch.tensor([3, 5]))
    drawn = [*lots.below(2**31 - 1, 3).unbind(1), *lots.below(10).unbind(1)]
    for row, counters in enumerate([(0, 3), (41, 5)]):
        state = 7
        for counter in counters:
            state = mixed((state + (counter + 1) * step) % 2**64)
        bits = [mixed((state + turn * step) % 2**64) >> 32 for turn in (1, 2, 3, 4)]
        ends = [2**31 - 1] * 3 + [10]
        expected = [bit * end >> 32 for bit, end in zip(bits, ends, strict=True)]
        assert [int(column[row]) for column in drawn] == expected


@pytest.mark.parametrize(("end", "n"), [(3, 3), (4, 2), (300, 300), (5, 0)])
def test_distinct_lots_are_permutations_each_as_likely(end, n):
    drawn = Lots(1, torch.arange(6000)).distinct(end, n)
    assert drawn.shape == (6000, n) and (drawn.sort(1).values.diff(dim=1) > 0).all()
    if n and end < 10:
        _, counts = drawn.unique(dim=0, return_counts=True)
        assert len(counts) == 6 * (end - 2) and uniform(counts) > 1e-4


def test_worlds_do_not_depend_on_the_default_dtype():
    def drawn():
        return random_layout(Lots(0, torch.arange(100)))

    usual = drawn()
    torch.set_default_dtype(torch.float64)
    try:
        assert (drawn() == usual).all()
    finally:
        torch.set_default_dtype(torch.float32)
