"""Sets of demonstrations whose pixels are more than memory may hold."""

import copy
import gc
import os
import pickle
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from comparing import all_frames
from ifo_grounding.data import Demonstrations, FrameCodec, _reading, _spool, codec, goal_buffer
from ifo_grounding.data._spool import Spool, is_mapped
from ifo_grounding.errors import UserError

SCRIPT = """
import resource, sys
import torch
from ifo_grounding.data import Demonstrations, _spool, codec, goal_buffer, labelled_buffer

_spool.MEMORY_BYTES = 16 << 20
codec.PATIENCE_BYTES = 8 << 20

def noise():
    draw = torch.Generator().manual_seed(0)
    for number in range(1600):
        frames = torch.randint(256, (5, 3, 128, 128), dtype=torch.uint8, generator=draw)
        yield number, frames, "go on"

def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10

before = peak()
demos = Demonstrations.from_episodes(noise())
demos.save(sys.argv[1])
for one in (demos, Demonstrations.load(sys.argv[1])):
    buffer = labelled_buffer(one, torch.zeros(one.transitions).long())
    goal_buffer(one[:9]).sample(32)
    buffer.sample(32), one.sample_transitions(32), one.sample_episodes(8)
print(demos.codes.nbytes >> 20, peak() - before >> 20)
"""


def test_pixels_of_a_large_set_are_not_held_in_memory(tmp_path, monkeypatch):
    """Build from a generator, save, load and sample, all below half of the pixels."""
    monkeypatch.setenv("IFO_GROUNDING_HOME", str(tmp_path / "home"))
    command = [sys.executable, "-c", SCRIPT, str(tmp_path / "demos")]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    pixels, grown = map(int, done.stdout.splitlines()[-1].split())
    assert pixels > 400
    assert grown < pixels / 2, f"{grown} MiB of memory for {pixels} MiB of pixels"
    assert not list((tmp_path / "home").iterdir())


@pytest.fixture
def scratch(tmp_path, monkeypatch):
    """Folder of scratch files, where hardly anything may be in memory."""
    monkeypatch.setenv("IFO_GROUNDING_HOME", str(tmp_path / "scratch"))
    monkeypatch.setattr(_spool, "MEMORY_BYTES", 4000)
    monkeypatch.setattr(_spool, "PIECE_BYTES", 2000)
    monkeypatch.setattr(_reading, "PIECE_FRAMES", 4)
    return tmp_path / "scratch"


def episodes(side=20):
    """Frames without a repeated tile, of 20 x 20 pixels also without a tile size that fits."""
    draw = torch.Generator().manual_seed(0)
    for number in range(9):
        shape = (2 + number % 3, 3, side, side)
        yield f"e{number}", torch.randint(256, shape, generator=draw, dtype=torch.uint8), "go on"


@pytest.mark.parametrize("side", [20, 32])
def test_frames_on_disk_are_those_that_were_read(side, scratch, tmp_path, monkeypatch):
    monkeypatch.setattr(codec, "PATIENCE_BYTES", 1)
    demos = Demonstrations.from_episodes(episodes(side), close=False)
    assert is_mapped(demos.codes)
    assert torch.equal(all_frames(demos), torch.cat([shown for _, shown, _ in episodes(side)]))
    closed, chosen = demos.close_episodes(), demos[[7, 2, 5]]
    assert torch.equal(closed.lengths, demos.lengths + 1)
    for number, (_, shown, _) in enumerate(episodes(side)):
        assert torch.equal(closed[number]["pixels"], torch.cat([shown, shown[-1:]]))
    for one in (closed, chosen):
        one.save(tmp_path / "saved")
        back = Demonstrations.load(tmp_path / "saved")
        assert [torch.equal(a["pixels"], b["pixels"]) for a, b in zip(back, one, strict=True)]
        assert torch.equal(goal_buffer(back)[:]["final"], goal_buffer(one)[:]["final"])


def test_what_is_on_disk_has_no_file_that_could_stay(scratch):
    demos = Demonstrations.from_episodes(episodes())
    part = demos[:2]
    assert is_mapped(demos.codes)
    assert not list(scratch.iterdir())
    del demos
    gc.collect()
    assert part[1]["pixels"].shape == (4, 3, 20, 20)


COPY = """
import pickle, sys
from test_large import episodes
from ifo_grounding.data import Demonstrations, _spool

_spool.MEMORY_BYTES = 4000
sys.stdout.buffer.write(pickle.dumps(Demonstrations.from_episodes(episodes())))
"""


def test_what_is_on_disk_is_copied_and_outlives_its_process(scratch):
    demos = Demonstrations.from_episodes(episodes())
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}
    other = subprocess.run([sys.executable, "-c", COPY], env=env, check=True, capture_output=True)
    for one in (pickle.loads(other.stdout), copy.deepcopy(demos)):
        assert torch.equal(all_frames(one), all_frames(demos))


def test_no_scratch_file_stays_after_a_mistake(scratch):
    def broken():
        yield from episodes()
        assert list(scratch.iterdir())
        yield "last", torch.zeros(2, 3, 20, 24, dtype=torch.uint8), "go on"

    with pytest.raises(UserError, match="'last' has images"):
        Demonstrations.from_episodes(broken())
    gc.collect()
    assert not list(scratch.iterdir())


def test_rows_on_disk_take_the_type_of_the_largest(scratch):
    spool = Spool()
    for value in (0, 200, 300, 70_000):
        spool.append(torch.full((500, 4), value, dtype=codec.smallest_dtype(value + 1)))
    rows = spool.tensor(torch.int32)
    assert is_mapped(rows)
    assert rows[:, 3].tolist() == [0] * 500 + [200] * 500 + [300] * 500 + [70_000] * 500
    assert not list(scratch.iterdir())


def test_a_dictionary_that_saves_little_is_given_up(monkeypatch):
    monkeypatch.setattr(codec, "PATIENCE_BYTES", 1)
    half = torch.randint(256, (30, 3, 32, 32), dtype=torch.uint8)
    half[:, :, :8] = 0
    assert FrameCodec.fit(iter([half, half[:0]]), tile_size=8).tiles is None
    half[:, :, :24] = 0
    assert FrameCodec.fit(iter([half, half[:0]]), tile_size=8).tiles is not None
