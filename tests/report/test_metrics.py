"""Metrics come back as they were logged."""

from __future__ import annotations

import pytest
from torchrl.record.loggers import CSVLogger

from ifo_grounding.errors import UserError
from ifo_grounding.report import read_metrics


def test_the_folder_of_torchrls_logger(tmp_path):
    logger = CSVLogger("run", log_dir=str(tmp_path))
    for step in (0, 10, 20):
        logger.log_scalar("imitate/loss", 1.0 / (1 + step), step=step)
    logger.log_scalar("success", 0.5, step=20)
    expected = ([0.0, 10.0, 20.0], [1.0, 1 / 11, 1 / 21])
    metrics = read_metrics(tmp_path / "run")
    assert metrics == {"imitate/loss": expected, "success": ([20.0], [0.5])}
    assert set(read_metrics(tmp_path)) == {"run/imitate/loss", "run/success"}


def test_steps_that_a_resumed_run_repeats_count_once(tmp_path):
    path = tmp_path / "loss.csv"
    path.write_text("0,4\n10,3\n20,2\n10,3.5\n20,2.5\n30,1\n")
    assert read_metrics(tmp_path)["loss"] == ([0, 10, 20, 30], [4, 3.5, 2.5, 1])


def test_json_lines_cut_short_by_a_kill(tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_text(
        '{"step": 5, "loss": 1, "ok": true, "name": "a"}\n\n{"step": 6, "loss": 2}\n{"st'
    )
    assert read_metrics(path) == {"loss": ([5.0, 6.0], [1.0, 2.0])}
    path.write_text('{"step": 5\n{"step": 6, "loss": 2}\n')
    with pytest.raises(UserError, match="line 1 is not JSON"):
        read_metrics(path)


def test_csv_cut_short_by_a_kill(tmp_path):
    """The rest of a number is a number too."""
    (tmp_path / "loss.csv").write_text("100,2.0\n200,1.25\n3,0")
    assert read_metrics(tmp_path)["loss"] == ([100, 200], [2.0, 1.25])
    (tmp_path / "metrics.csv").write_text("step,loss\n10,0.5\n20,0.")
    assert read_metrics(tmp_path / "metrics.csv") == {"loss": ([10], [0.5])}


def test_csv_with_a_header_and_gaps(tmp_path):
    path = tmp_path / "metrics.csv"
    path.write_text("step,loss,success\n0,1.5,\n10,nan,0.5\n20,1.0,0.75\n")
    assert read_metrics(path) == {
        "loss": ([0.0, 20.0], [1.5, 1.0]),
        "success": ([10.0, 20.0], [0.5, 0.75]),
    }


def test_rows_without_steps_are_numbered(tmp_path):
    path = tmp_path / "metrics.csv"
    path.write_text("loss\n3\n2\n")
    assert read_metrics(path) == {"loss": ([0.0, 1.0], [3.0, 2.0])}


def test_refusals(tmp_path):
    with pytest.raises(UserError, match="does not exist"):
        read_metrics(tmp_path / "nothing.csv")
    with pytest.raises(UserError, match="holds no metrics"):
        read_metrics(tmp_path)
    for content, said in (
        (b"", "holds no metrics"),
        (b'{"loss": 1}\n3\n', "line 2 is no JSON object"),
        (b"\xff\xfe\x00\n", "is no text"),
    ):
        (tmp_path / "metrics.jsonl").write_bytes(content)
        with pytest.raises(UserError, match=said):
            read_metrics(tmp_path / "metrics.jsonl")
    (tmp_path / "metrics.txt").write_text("loss")
    with pytest.raises(UserError, match=r"neither \.jsonl nor \.csv"):
        read_metrics(tmp_path / "metrics.txt")
