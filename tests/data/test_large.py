"""Sets of demonstrations whose pixels are more than memory may hold."""

import pickle
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import torch

from comparing import all_frames, assert_same
from ifo_grounding import data


def memory():
    """Anonymous memory in bytes: pages of a mapped file are given back when others need them."""
    status = Path("/proc/self/status").read_text()
    return int(status.partition("RssAnon:")[2].split()[0]) << 10


def use_a_large_set(folder):
    """Build from a generator, save, load and sample; return bytes of pixels and of more memory."""
    data._spool.PIECE_BYTES = data._episodes.PIECE_BYTES = data._spool.MEMORY_BYTES = 2 << 20
    data.codec.PATIENCE_BYTES = 2 << 20
    peaks = [memory()]

    def watch():
        while True:
            peaks.append(memory())
            time.sleep(0.002)

    threading.Thread(target=watch, daemon=True).start()
    noise = (torch.randint(256, (5, 3, 128, 128), dtype=torch.uint8) for _ in range(450))
    demos = data.Demonstrations.from_episodes((n, shown, "go on") for n, shown in enumerate(noise))
    demos.save(folder)
    for one in (demos, data.Demonstrations.load(folder)):
        buffer = data.labelled_buffer(one, torch.zeros(one.transitions).long())
        data.goal_buffer(one[:9]).sample(32)
        buffer.sample(32), one.first_frames()
    return demos.codes.nbytes, max(peaks) - peaks[0]


def test_pixels_of_a_large_set_are_not_held_in_memory(ifo_home, tmp_path):
    """In a new process: a forked one would inherit what other tests left free or keep."""
    program = f"import sys; sys.path[:0] = {sys.path!r}; from data.test_large import *"
    program += "; print(*use_a_large_set(sys.argv[1]))"
    command = [sys.executable, "-c", program, str(tmp_path / "demos")]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    pixels, grown = map(int, done.stdout.splitlines()[-1].split())
    assert pixels > 120 << 20
    assert grown < pixels / 2, f"{grown} bytes of memory for {pixels} bytes of pixels"
    assert not list(ifo_home.iterdir())


@pytest.fixture
def scratch(ifo_home, monkeypatch):
    """Folder of scratch files, where hardly anything may be in memory."""
    monkeypatch.setattr(data._spool, "MEMORY_BYTES", 4000)
    monkeypatch.setattr(data._spool, "PIECE_BYTES", 2000)
    monkeypatch.setattr(data._episodes, "PIECE_FRAMES", 4)
    return ifo_home


def episodes(side=20):
    """Frames without a repeated tile, of 20 x 20 pixels also without a tile size that fits."""
    draw = torch.Generator().manual_seed(0)
    for number in range(9):
        shape = (2 + number % 3, 3, side, side)
        yield f"e{number}", torch.randint(256, shape, generator=draw, dtype=torch.uint8), "go on"


@pytest.mark.parametrize("side", [20, 32])
def test_frames_on_disk_are_those_that_were_read(side, scratch, tmp_path, monkeypatch):
    monkeypatch.setattr(data.codec, "PATIENCE_BYTES", 1)
    demos = data.Demonstrations.from_episodes(episodes(side), close=False)
    assert not list(scratch.iterdir())  # the file has no name, and none is left behind
    assert torch.equal(all_frames(pickle.loads(pickle.dumps(demos))), all_frames(demos))
    assert torch.equal(all_frames(demos), torch.cat([shown for _, shown, _ in episodes(side)]))
    closed, chosen = demos.close_episodes(), demos[[7, 2, 5]]
    assert torch.equal(closed.lengths, demos.lengths + 1)
    for number, (_, shown, _) in enumerate(episodes(side)):
        assert torch.equal(closed[number]["pixels"], torch.cat([shown, shown[-1:]]))
    for one in (closed, chosen):
        one.save(tmp_path / "saved")
        back = data.Demonstrations.load(tmp_path / "saved")
        assert_same(back, one)
        finals = [data.goal_buffer(each.close_episodes())[:]["final"] for each in (back, one)]
        assert torch.equal(*finals)
