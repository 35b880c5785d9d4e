"""Files are whole or not there, whoever dies as they are written."""

import os
import time

import pytest

from styleexp.system import atomic


def test_a_writer_that_fails_leaves_the_old_file_and_nothing_else(tmp_path):
    target = tmp_path / "file.txt"
    atomic.write(target, atomic.text("old"))

    def fail(path):
        path.write_text("half of the n")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        atomic.write(target, fail)
    assert [path.name for path in tmp_path.iterdir()] == ["file.txt"]
    assert target.read_text() == "old"


def test_content_and_name_are_on_the_disk_before_a_writer_returns(tmp_path, monkeypatch):
    done = []
    for name in ("fsync", "replace"):
        real = getattr(os, name)
        monkeypatch.setattr(
            os, name, lambda *given, real=real, name=name: (done.append(name), real(*given))
        )
    atomic.write(tmp_path / "file.txt", atomic.text("new"))
    assert done == ["fsync", "replace", "fsync"]


def test_only_what_dead_writers_left_is_swept_away(tmp_path):
    kept = ["result.ply", ".hidden", "my.partial.ply"]
    for name in [*kept, ".result.01234567.partial.ply"]:
        (tmp_path / name).write_text("x")
    (tmp_path / ".fetch.partial-abc").mkdir()
    (tmp_path / ".fetch.partial-abc" / "half").write_text("x")
    atomic.sweep(tmp_path, seconds=60)
    assert len(list(tmp_path.iterdir())) == len(kept) + 2
    old = time.time() - 3600
    os.utime(tmp_path / ".fetch.partial-abc", (old, old))
    atomic.sweep(tmp_path, seconds=60)
    assert not (tmp_path / ".fetch.partial-abc").exists()
    atomic.sweep(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(kept)
