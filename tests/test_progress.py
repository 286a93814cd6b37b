"""How far a command is, where its output goes to a file."""

import time

from ifo_grounding import progress


def test_a_log_gets_lines_with_stage_steps_and_time_left(capsys, monkeypatch):
    monkeypatch.setattr(progress, "_told", [])
    monkeypatch.setattr(progress, "EVERY", 0.02)
    progress._begin.cache_clear()
    progress.tell_progress("imitate")
    for number in progress.progress_bar(range(20), desc="fit", shown=True):
        time.sleep(0.2 * (number == 8))
    progress.tell_progress(None)
    time.sleep(0.1)
    lines = capsys.readouterr().err.splitlines()
    time.sleep(0.1)
    assert not capsys.readouterr().err  # a stage that is done is told no longer
    monkeypatch.setattr(progress, "EVERY", 3600)
    assert len(lines) > 2
    assert all(line.startswith("imitate: running (") for line in lines)
    assert "fit: 8 of 20, " in lines[1] and " left" in lines[1]
