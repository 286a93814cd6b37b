"""Damaged files: every reader gives what was written, or says in one line what is wrong."""

import contextlib
import json
import os
import random
from io import BytesIO
from types import SimpleNamespace

import pyarrow.dataset
import pytest
import torch
from PIL import Image

from comparing import all_frames
from ifo_grounding.data import Demonstrations, load_pictures, record_demonstrations, save_pictures
from ifo_grounding.data._episodes import read_table
from ifo_grounding.data._images import stack_images
from ifo_grounding.data.lerobot import load_lerobot, save_lerobot
from ifo_grounding.errors import UserError
from ifo_grounding.networks import Shapes, from_pretrained, make_policy, save_pretrained
from ifo_grounding.tasks import VOCABULARY
from ifo_grounding.training.checkpoint import FORMAT, Checkpoint

DAMAGES = {
    "cut": lambda b, at, _: b[:at],
    "beheaded": lambda b, at, _: b[at:],
    "flipped": lambda b, at, r: b[:at] + bytes([b[at] ^ 1 << r.randrange(8)]) + b[at + 1 :],
    "zeros": lambda b, at, _: b[:at] + bytes(len(b[at : at + 32])) + b[at + 32 :],
    "swapped": lambda b, at, _: b[at : at + 64] + b[64:at] + b[:64] + b[at + 64 :],
    "repeated": lambda b, at, _: b[: at + 64] + b[at:],
    "inserted": lambda b, at, r: b[:at] + r.randbytes(7) + b[at:],
    "longer": lambda b, at, r: b + r.randbytes(50),
    "empty": lambda b, at, _: b"",
    "another": lambda b, at, _: b"PK\3\4" + bytes(30),
}
PLACES = {
    "a folder": lambda path: path.mkdir(),
    "missing": lambda path: None,
    "a pipe": os.mkfifo,
    "a loop": lambda path: path.symlink_to(path.name),
}


def shown(demos):
    return demos.sentences(), demos.lengths.tolist(), all_frames(demos)


def restored(path):
    layer = torch.nn.Linear(2, 1)
    return Checkpoint(path / "c.pt", {"lr": 0.1}, layer=layer).load(), layer.weight.data


def weights(folder):
    network = from_pretrained(folder)
    return network.vocabulary, torch.cat([value.flatten() for value in network.parameters()])


def shared(demos, folder):
    save_pretrained(make_policy(Shapes((3, 16, 16), 60, tile_size=8), features=16), folder)


def kept(demos, folder):
    layer = torch.nn.Linear(2, 1)
    Checkpoint(folder / "c.pt", {"lr": 0.1}, layer=layer).save({"iteration": 3})


FOLDERS = {
    "saved": (Demonstrations.save, lambda f: shown(Demonstrations.load(f)), "*"),
    "pictures": (save_pictures, lambda f: shown(load_pictures(f)), "*/0001.png"),
    "lerobot": (save_lerobot, lambda f: shown(load_lerobot(f)), "[dm]*/**/*.*"),
    "network": (shared, weights, "*.safetensors"),
    "checkpoint": (kept, restored, "*"),
}


def same(first, second):
    pairs = zip(first, second, strict=True)
    return all(torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b for a, b in pairs)


@pytest.mark.parametrize("count", [1, pytest.param(25, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", FOLDERS)
def test_damage_is_said_or_changes_nothing(kind, count, tmp_path):
    save, load, files = FOLDERS[kind]
    save(record_demonstrations("move", 2, seed=0), tmp_path)
    before, draw = load(tmp_path), random.Random(0)
    gone = 0
    for path in sorted(path for path in tmp_path.glob(files) if path.is_file()):
        whole = path.read_bytes()
        tried = [
            (n, d(whole, draw.randrange(len(whole)), draw))
            for n, d in DAMAGES.items()
            for _ in range(count)
        ]
        for name, content in [*tried, *PLACES.items()]:
            path.unlink()
            content(path) if callable(content) else path.write_bytes(content)
            try:
                after = load(tmp_path)
            except UserError as error:
                assert "\n" not in str(error)  # noqa: PT017
            else:  # a picture or a checkpoint that is not there
                unseen = name in ("missing", "a loop") and kind in ("pictures", "checkpoint")
                assert unseen or same(before, after), (path.name, name)
            gone += 1
            path.rmdir() if path.is_dir() else path.unlink(missing_ok=True)
            path.write_bytes(whole)
    assert gone and same(before, load(tmp_path))


@pytest.mark.parametrize(
    ("old", "new"), [('"circle"', '"circus"'), ('"vocabulary_size": ', '"vocabulary_size": 1')]
)
def test_facts_that_changed_are_noticed(old, new, tmp_path):
    record_demonstrations("move", 2, seed=0).save(tmp_path)
    meta = tmp_path / "meta.json"
    meta.write_text(meta.read_text().replace(old, new))
    with pytest.raises(UserError, match=r"checksum of the facts in meta\.json is another"):
        Demonstrations.load(tmp_path)
    content = json.loads(meta.read_text())
    del content["facts_crc32"]  # as older folders are
    meta.write_text(json.dumps(content))
    assert len(Demonstrations.load(tmp_path)) == 2


def test_frames_of_an_episode_that_are_not_all_there_are_noticed(tmp_path):
    pandas = pytest.importorskip("pandas")
    save_lerobot(record_demonstrations("move", 2, seed=0), tmp_path / "l")
    path = next(tmp_path.glob("l/data/*/file-001.parquet"))
    table = pandas.read_parquet(path)
    for other in (table[:-1], table.assign(frame_index=0)):
        other.to_parquet(path)
        with pytest.raises(UserError, match=r"episode 1: .*file-001 holds no frames 0 to"):
            load_lerobot(tmp_path / "l")


def test_a_flipped_page_of_a_table_is_noticed(tmp_path):
    save_lerobot(record_demonstrations("move", 1, seed=0), tmp_path / "l")
    path = next(tmp_path.glob("l/data/*/*.parquet"))
    content = path.read_bytes()
    at = content.index(b"frame.png")  # where no picture's own checksum sees it
    path.write_bytes(content[:at] + b"F" + content[at + 1 :])
    with pytest.raises(UserError, match=r"cannot be read .*(CRC|corrupt)"):
        load_lerobot(tmp_path / "l")


def test_what_arrow_alone_raises_is_an_error_of_the_file():
    def broken(**_):
        raise pyarrow.ArrowException("Unknown error: Wrapping")
        yield

    with pytest.raises(OSError, match="Wrapping"):
        read_table(SimpleNamespace(to_batches=broken))


@pytest.mark.parametrize("name", ["settings", "progress", "seconds", "parts"])
@pytest.mark.parametrize("value", [None, 3, ...])
def test_checkpoints_of_another_shape_are_refused(name, value, tmp_path):
    kept(None, tmp_path)
    content = torch.load(tmp_path / "c.pt", weights_only=True)
    assert content["format"] == FORMAT
    content.pop(name) if value is ... else content.update({name: value})
    torch.save(content, tmp_path / "c.pt")
    with pytest.raises(UserError, match=r"is no checkpoint of this version"):
        restored(tmp_path)


def test_no_changed_byte_of_a_png_changes_a_picture():
    file = BytesIO()
    frame = record_demonstrations("move", 1, seed=0)[0]["pixels"][1].permute(1, 2, 0).numpy()
    Image.fromarray(frame).save(file, "PNG")
    content = file.getvalue()
    for at, old in enumerate(content):
        changed = content[:at] + bytes([old ^ 64]) + content[at + 1 :]
        with contextlib.suppress(UserError):
            assert (stack_images([("a", changed)])[0].transpose(1, 2, 0) == frame).all(), at


def test_an_error_is_one_line_whatever_it_cites():
    assert (
        str(UserError("cannot\r\n be read\x1b[31m (a\n\nb \ud800)")) == "cannot be read [31m (a b )"
    )


def test_words_that_nothing_encodes_are_refused():
    with pytest.raises(UserError, match="characters that can be printed"):
        VOCABULARY.from_sentences(["go \ud800"])
