"""COLMAP's long steps run in a process of their own: what ends or fails there is one error here."""

import threading

import pytest

from stages.core.errors import InputError
from stages.reconstruct import colmap
from stages.reconstruct.colmap import colmap_process, run_colmap
from stages.reconstruct.features import writing_database
from tests.limits import file_size_limit

pytest.importorskip("pycolmap")


@pytest.mark.parametrize(("code", "ending"), [("os.abort()", "signal SIGABRT"), ("os._exit(3)", "exit status 3"),
                                              ("os.kill(os.getpid(), 9)", "signal SIGKILL")])  # fmt: skip
def test_a_process_that_ends_is_an_error_that_names_the_folder(tmp_path, monkeypatch, code, ending):
    monkeypatch.setattr(colmap, "WORKER", f"import os, sys; sys.stdin.readline(); {code}")
    message = rf"{tmp_path}: COLMAP ended without a result \({ending}\); either memory or the disk is full"
    with colmap_process() as process, pytest.raises(InputError, match=message):
        run_colmap("map", tmp_path)
    assert process.poll() is not None
    monkeypatch.setattr(colmap, "WORKER", "pass")
    with colmap_process() as process:
        process.wait()
        for _ in range(2):  # the second request finds a closed pipe
            with pytest.raises(InputError, match="exit status 0"):
                run_colmap("map", tmp_path, text="x" * 100_000)


def test_progress_and_errors_come_back_and_the_process_goes_on(tmp_path, monkeypatch):
    code = "import sys; [print(line, flush=True) for _ in sys.stdin for line in {}]"
    lines = ['["progress", 2]', '["progress", 1]', '["done", null]']
    monkeypatch.setattr(colmap, "WORKER", code.format(lines))
    seen = []
    with colmap_process() as outer:
        with colmap_process() as inner:
            assert inner is outer
        for _ in range(2):
            run_colmap("map", tmp_path, seen.append)
    assert seen == [2, 1, 2, 1]
    for text, kind in (("Check failed", RuntimeError), ("std::bad_alloc", MemoryError)):
        monkeypatch.setattr(colmap, "WORKER", code.format([f'["error", "{text}"]']))
        with pytest.raises(kind, match=text):
            run_colmap("map", tmp_path)


def test_what_colmap_refuses_is_an_error_with_its_words(tmp_path):
    with colmap_process() as process:
        for _ in range(2):
            with pytest.raises(InputError, match="COLMAP cannot write its files"), writing_database(tmp_path):
                run_colmap("extract", tmp_path / "absent", names=["a.pgm"], threads=1)
        assert process.poll() is None


def test_a_full_disk_is_one_error(tmp_path):
    """SQLite or COLMAP may raise or abort: each is an InputError."""
    (tmp_path / "a.pgm").write_bytes(b"P5 64 64 255\n" + bytes(range(256)) * 16)
    with file_size_limit(4096), pytest.raises(InputError, match="COLMAP"), writing_database(tmp_path):
        run_colmap("extract", tmp_path, names=["a.pgm"], threads=1)


def test_the_process_ends_when_the_one_that_started_it_does(tmp_path):
    with colmap_process() as process:
        timer = threading.Timer(60, process.kill)
        timer.start()
        process.stdin.close()  # as when the other end is killed
        assert process.wait() == 0
        timer.cancel()
        process.stdin = None
