"""COLMAP's long steps run in a separate process, and its failure or termination causes one error here."""

import threading

import pytest

from stages.core.errors import InputError
from stages.reconstruct import colmap, colmap_worker
from stages.reconstruct.colmap import colmap_process, run_colmap
from stages.reconstruct.features import writing_database
from tests.limits import file_size_limit

pycolmap = pytest.importorskip("pycolmap")


@pytest.mark.parametrize(("code", "ending"), [("os.abort()", "signal SIGABRT"), ("os._exit(3)", "exit status 3"),
                                              ("os.kill(os.getpid(), 9)", "signal SIGKILL")])  # fmt: skip
def test_a_process_that_ends_is_an_error_that_names_the_folder(tmp_path, monkeypatch, code, ending):
    monkeypatch.setattr(colmap, "WORKER", f"import os, sys; sys.stdin.readline(); {code}")
    message = rf"{tmp_path}: COLMAP ended without a result \({ending}\); memory or the disk is probably full"
    with colmap_process() as process, pytest.raises(InputError, match=message):
        run_colmap("map", tmp_path)
    assert process.poll() is not None
    monkeypatch.setattr(colmap, "WORKER", "pass")
    with colmap_process() as process:
        process.wait()
        for _ in range(2):  # for the second request, the pipe is closed
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
    """SQLite or COLMAP may raise an exception or abort; each must cause an InputError."""
    (tmp_path / "a.pgm").write_bytes(b"P5 64 64 255\n" + bytes(range(256)) * 16)
    with file_size_limit(4096), pytest.raises(InputError, match="COLMAP"), writing_database(tmp_path):
        run_colmap("extract", tmp_path, names=["a.pgm"], threads=1)


def test_the_process_ends_when_the_one_that_started_it_does(tmp_path):
    with colmap_process() as process:
        timer = threading.Timer(60, process.kill)
        timer.start()
        process.stdin.close()  # as if the process at the other end were killed
        assert process.wait() == 0
        timer.cancel()
        process.stdin = None


@pytest.mark.parametrize(("photos", "x", "y", "found"), [(12, 550, 430, True), (12, 470, 420, True),
                                                         (12, 512, 384, False), (6, 550, 430, False)])  # fmt: skip
def test_principal_points_off_the_middle_are_found_from_ten_photos_on(tmp_path, photos, x, y, found):
    """COLMAP's synthetic data have noise of half a pixel; the initial value is the middle of 1024 x 768 pixels."""
    pycolmap.set_random_seed(1)
    path, out = tmp_path / "x.db", tmp_path / "out"
    out.mkdir()
    database = pycolmap.Database.open(path)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_frames_per_rig=photos, num_points3D=300, camera_params=[1280, x, y, 0.05]
    )
    truth = pycolmap.synthesize_dataset(options, database)
    pycolmap.synthesize_noise(pycolmap.SyntheticNoiseOptions(point2D_stddev=0.5), truth, database)
    for camera in database.read_all_cameras():
        camera.params = [1228.8, 512, 384, 0]
        database.update_camera(camera)
    database.close()
    done = []
    colmap_worker.map_photos(done.append, str(out), str(path), photos, seed=0, min_points=30)
    model = pycolmap.Reconstruction(out / "0")
    (camera,) = model.cameras.values()
    assert sum(done) == model.num_reg_images() == photos
    if found:
        assert camera.params[1:3] == pytest.approx([x, y], abs=3)
    else:
        assert list(camera.params[1:3]) == [512, 384]
