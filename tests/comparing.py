"""What is compared of demonstrations that were written and read again."""

import torch


def all_frames(demos):
    return demos.frames(torch.arange(demos.n_frames))


def said(demos):
    return demos.instructions.tolist() if demos.vocabulary is None else demos.sentences()


def assert_same(one, other):
    assert said(one) == said(other)
    assert torch.equal(one.lengths, other.lengths)
    assert all(torch.equal(a["pixels"], b["pixels"]) for a, b in zip(one, other, strict=True))
