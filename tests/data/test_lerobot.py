"""Folders of LeRobot's format v3: those of others, and our own as others read them."""

import json

import datasets
import numpy as np
import pandas
import pytest

from comparing import all_frames, assert_same
from ifo_grounding.data import load_lerobot, save_lerobot
from ifo_grounding.data._video import write_video
from ifo_grounding.errors import UserError

TOP = "observation.images.top"
EPISODES = {
    **{"episode_index": [0, 1], "tasks": [["Go on"], ["stop"]], "length": [7, 5]},
    **{f"videos/{TOP}/chunk_index": 0, f"videos/{TOP}/file_index": 2},
    f"videos/{TOP}/from_timestamp": [0.0, 0.7],
}
INFO = {
    **{"codebase_version": "v3.0", "fps": 10},
    "features": {TOP: {"dtype": "video"}, "wrist": {"dtype": "video"}, "action": {"dtype": "?"}},
}


def write(folder, info=INFO, **episodes):
    """Write two episodes, the frames of both in one video, each brighter than the last."""
    video = folder / f"videos/{TOP}/chunk-000/file-002.mp4"
    meta = folder / "meta/episodes/chunk-000/file-000.parquet"
    for path in (video, meta):
        path.parent.mkdir(parents=True)
    frames = np.arange(0, 240, 20, dtype=np.uint8).reshape(12, 1, 1, 1)
    write_video(video, np.broadcast_to(frames, (12, 32, 48, 3)).copy(), fps=10)
    pandas.DataFrame(EPISODES | episodes).to_parquet(meta)
    (folder / "meta/info.json").write_text(json.dumps(info))


def test_a_camera_of_videos_is_read_without_actions(tmp_path):
    write(tmp_path)
    demos = load_lerobot(tmp_path, camera=TOP, stride=3, size=(16, 24), close=False)
    assert demos.sentences() == ["go on", "stop"] and demos.image_shape == (3, 16, 24)
    assert demos.lengths.tolist() == [3, 2]
    seen = all_frames(demos).float().mean((1, 2, 3)) / 20
    assert seen.round().tolist() == [0, 3, 6, 8, 11]  # the last ones, and every third before


@pytest.mark.parametrize(
    ("changed", "options", "said"),
    [
        ({}, {"camera": None}, f"camera=None is none of '{TOP}', 'wrist': choose with camera="),
        ({"info": INFO | {"codebase_version": "v2.1"}}, {}, "format v2.1: convert it to v3"),
        ({"info": INFO | {"fps": 0}}, {}, "cannot be read as LeRobot's v3.0 .*division"),
        ({"tasks": [["go"], ["go", "on"]]}, {}, "episode 1: it has 2 tasks: a demonstration foll"),
        ({"length": [7, 6]}, {}, r"episode 1: .*file-002\.mp4 shows nothing at 1\.200 s"),
        ({f"videos/{TOP}/file_index": [2, 3]}, {}, r"episode 1: .*file-003\.mp4 is no regular"),
        ({"length": ["?", "?"]}, {}, "cannot be read as LeRobot's v3.0"),
    ],
)
def test_what_does_not_fit_is_said(changed, options, said, tmp_path):
    write(tmp_path, **changed)
    with pytest.raises(UserError, match=said):
        load_lerobot(tmp_path, **{"camera": TOP, **options})


def test_what_is_written_comes_back_and_others_read_it(demos, tmp_path):
    save_lerobot(demos, tmp_path / "d")
    assert_same(load_lerobot(tmp_path / "d"), demos)
    files = sorted(map(str, (tmp_path / "d/data").rglob("*.parquet")))
    frames = datasets.Dataset.from_parquet(files, cache_dir=str(tmp_path / "cache"))
    index = int(demos.lengths[:5].sum()) - 1
    last = frames.cast_column("observation.image", datasets.Image())[index]
    tasks = pandas.read_parquet(tmp_path / "d/meta/tasks.parquet")
    assert tasks.iloc[last["task_index"]].name == demos.sentences()[4]
    assert last["episode_index"] == 4 and last["index"] == index
    assert last["timestamp"] == last["frame_index"] / 4
    shown = np.asarray(last["observation.image"]).transpose(2, 0, 1)
    assert np.array_equal(shown, demos[4]["pixels"][-1])
