import torch

from ifo_grounding import distinct
from ifo_grounding.distinct import distinct_rows


def test_rows_are_told_apart_even_where_hashes_collide(monkeypatch):
    source = torch.Generator().manual_seed(0)
    rows = torch.randint(40, (100, 16), generator=source)[
        torch.randint(100, (300,), generator=source)
    ]
    expected = torch.unique(rows, dim=0)
    found, index = distinct_rows(rows)
    assert torch.equal(found[index], rows)
    assert len(found) == len(expected)
    monkeypatch.setattr(distinct, "hash_rows", lambda rows: rows.sum(-1) % 3)
    found, index = distinct_rows(rows)
    assert torch.equal(found[index], rows)
    assert torch.equal(found, expected)


def test_rows_that_mirror_each_other_do_not_collide():
    a, b = 0x0123456789ABCDEF, 0x7EDCBA9876543210
    rows = torch.tensor([[a, b, b, a], [b, a, a, b], [a, a, b, b], [b, b, a, a]])
    assert distinct.hash_rows(rows).unique().numel() == 4


def test_what_a_vmap_with_random_numbers_asked_first_serves_all_others():
    distinct._factors.cache_clear()
    torch.vmap(lambda rows: rows + int(distinct._factors(3)[0]), randomness="different")(
        torch.ones(2)
    )
    rows = torch.tensor([[1, 2, 3], [1, 2, 3]])
    assert distinct_rows(rows)[0].tolist() == [[1, 2, 3]]
