"""Every test starts from the same seeds, on one thread, away from the user's own folders."""

import os
import random

# Before these are imported anywhere: no test needs a screen or the network.
os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
os.environ.setdefault("HF_HUB_OFFLINE", "1")

import numpy as np
import pytest
import torch

torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def _seeds():
    random.seed(0)
    np.random.seed(0)  # noqa: NPY002  the global generator is what other libraries read
    if torch.cuda.is_available():
        torch.manual_seed(0)
    torch.default_generator.manual_seed(0)  # alone a hundred times as fast where there is no GPU
    torch.set_flush_denormal(False)  # a run that a test before began in this process flushes them


@pytest.fixture(autouse=True)
def ifo_home(tmp_path_factory, monkeypatch):
    """Folder that stands for the user's IFO_GROUNDING_HOME during one test."""
    folder = tmp_path_factory.mktemp("home")
    monkeypatch.setenv("IFO_GROUNDING_HOME", str(folder))
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder / "minari"))
    return folder
