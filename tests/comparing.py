"""What is compared of demonstrations that were written and read again."""

import torch


def all_frames(demos):
    return demos.frames(torch.arange(demos.n_frames))


def assert_same(one, other):
    assert one.sentences() == other.sentences()
    assert torch.equal(one.lengths, other.lengths)
    assert torch.equal(all_frames(one), all_frames(other))
