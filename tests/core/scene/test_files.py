"""Files that are replaced only when the new one is complete."""

import os
import signal
import subprocess
import sys
import time

import pytest
import torch

from ngff_cli.options import interrupt
from stages.core.errors import InputError
from stages.core.scene import error_deferring_file, files
from stages.core.scene.error_deferring_file import ErrorDeferringFile
from stages.core.scene.files import make_folder, must_exist, replacing, save_tensors, seconds_since
from stages.core.scene.schema import read_json
from tests.limits import file_size_limit


def test_two_writers_of_one_file_do_not_mix(tmp_path):
    out = tmp_path / "a.txt"
    with replacing(out) as first:
        first.write_text("first")
        with replacing(out) as second:
            second.write_text("second")
        assert out.read_text() == "second"
    assert out.read_text() == "first"  # it finished last
    assert os.listdir(tmp_path) == ["a.txt"]


@pytest.mark.parametrize("letter", ["n", "图"])
def test_names_may_be_as_long_as_the_file_system_allows(tmp_path, letter):
    name = letter * ((255 - 4) // len(letter.encode())) + ".txt"
    with replacing(tmp_path / name) as part:
        assert part.suffix == ".txt"
        part.write_text("long")
    assert os.listdir(tmp_path) == [name]


def test_failure_keeps_the_old_file(tmp_path):
    (tmp_path / "a.txt").write_text("old")
    with pytest.raises(KeyboardInterrupt), replacing(tmp_path / "a.txt") as part:
        part.write_text("half")
        raise KeyboardInterrupt
    with pytest.raises(InputError, match="a.txt: cannot be written"), replacing(tmp_path / "a.txt"):
        raise OSError(28, "No space left on device")
    assert os.listdir(tmp_path) == ["a.txt"] and (tmp_path / "a.txt").read_text() == "old"


def test_next_run_deletes_what_a_killed_one_left_and_nothing_else(tmp_path, monkeypatch):
    code = "import os, sys, pathlib, stages.core.scene.files as f\n"
    code += "with f.replacing(pathlib.Path(sys.argv[1])) as part:\n part.write_text('half')\n os.kill(os.getpid(), 9)"
    subprocess.run([sys.executable, "-c", code, tmp_path / "a.txt"], check=False)
    (left,) = os.listdir(tmp_path)
    assert left.startswith(".part-")
    monkeypatch.setattr(files, "_swept", set())
    with replacing(tmp_path / "b.txt") as running:
        running.write_text("b")
        monkeypatch.setattr(files, "_swept", set())
        with replacing(tmp_path / "c.txt") as part:
            part.write_text("c")
    assert sorted(os.listdir(tmp_path)) == ["b.txt", "c.txt"]


def test_times_are_stored_only_where_asked_for(monkeypatch):
    monkeypatch.setattr(files.time, "monotonic", lambda: 12.04)
    monkeypatch.delenv("NGFF_TIMES", raising=False)
    assert seconds_since(10.0) == {}
    monkeypatch.setenv("NGFF_TIMES", "1")
    assert seconds_since(10.0) == {"seconds": 2.0}


def test_pipes_and_devices_are_neither_read_nor_replaced(tmp_path):
    pipe = tmp_path / "a.json"
    os.mkfifo(pipe)
    with pytest.raises(InputError, match="a device or a pipe"):
        must_exist(pipe, "a file")
    with pytest.raises(ValueError, match="not a file"):
        read_json(pipe)
    with pytest.raises(InputError, match="a device or a pipe"), replacing(pipe):
        pass
    assert not pipe.is_file() and os.listdir(tmp_path) == ["a.json"]


@pytest.mark.parametrize("size", [0, 1, 100, 5000, 20000])
def test_tensors_that_do_not_fit_on_the_disk_are_refused(tmp_path, size):
    with pytest.raises(InputError, match=r"a\.pt: cannot be written \(File too large\)"), file_size_limit(size):
        save_tensors(tmp_path / "a.pt", {"a": torch.zeros(1000), "b": [torch.zeros(5000)]})
    assert not os.listdir(tmp_path)


def test_what_a_full_disk_does_not_take_is_read_back_until_the_error_is_reported(tmp_path):
    with ErrorDeferringFile(tmp_path / "a", "w+b") as file:
        with file_size_limit(10):
            file.write(b"0123456")
            file.write(b"789abcdef")
            file.seek(20)
            file.write(b"xyz")
        file.seek(6)
        back = bytearray(20)
        assert file.readinto(back) == 20
        assert bytes(back) == b"6789abcdef" + bytes(4) + b"xyz" + bytes(3)
        with pytest.raises(OSError, match="File too large"):
            file.check()


def test_provenance_names_inputs_with_their_hashes_and_options_as_text(tmp_path):
    for name in ("a.txt", "b.txt"):
        (tmp_path / name).write_bytes(b"abc")
    facts = files.provenance("ngff x", [tmp_path / "a.txt", tmp_path], {"weights": tmp_path / "b.txt", "steps": 3})
    assert facts["command"] == "ngff x" and facts["options"] == {"weights": str(tmp_path / "b.txt"), "steps": 3}
    digest = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"  # from FIPS 180-2, B.1
    again = {"name": "b.txt", "sha256": digest}
    assert facts["inputs"] == [{"name": "a.txt", "sha256": digest}, {"name": tmp_path.name}, again]
    assert files.provenance("x", [])["options"] == {} and facts["ngff"] == files.ngff_version()
    with (tmp_path / "a.txt").open("rb") as file:
        assert files._digest(file) == digest


def test_what_must_exist_is_a_readable_file(tmp_path, monkeypatch):
    (tmp_path / "empty").touch()
    for name, message in (("absent", "no such file; a toy is expected"), ("", "is a folder; a toy is expected"),
                          ("empty", "is empty; a toy is expected")):  # fmt: skip
        with pytest.raises(InputError, match=message):
            must_exist(tmp_path / name, "a toy")
    (tmp_path / "empty").write_text("x")
    assert must_exist(tmp_path / "empty", "a toy") == tmp_path / "empty"
    monkeypatch.setattr(files.os, "access", lambda path, mode: False)  # file permissions do not apply to root
    with pytest.raises(InputError, match="empty: cannot be read; check its permissions"):
        must_exist(tmp_path / "empty", "a toy")


def test_an_interrupt_waits_until_hdf5_has_written(tmp_path, monkeypatch):
    """The reason is that HDF5 loses exceptions raised in the file object that it calls."""

    def interrupted(data):
        interrupt(signal.SIGINT, sys._getframe())
        return memoryview(data)

    before = signal.getsignal(signal.SIGALRM)
    with ErrorDeferringFile(tmp_path / "f", "w+b") as file:
        monkeypatch.setattr(error_deferring_file, "memoryview", interrupted, raising=False)
        try:
            with pytest.raises(KeyboardInterrupt):
                assert file.write(b"abc") == 3
                time.sleep(5)
        finally:
            signal.signal(signal.SIGALRM, before)
    assert (tmp_path / "f").read_bytes() == b"abc"


def test_folders_are_made_with_those_above_them(tmp_path, monkeypatch):
    assert make_folder(tmp_path / "a/b").is_dir() and make_folder(tmp_path / "a/b").is_dir()
    (tmp_path / "file").touch()
    for path in (tmp_path / "file", tmp_path / "file/a"):
        with pytest.raises(InputError, match=f"{path}: is not a folder and cannot be created"):
            make_folder(path)
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.W_OK)  # root may write everywhere
    with pytest.raises(InputError, match="a: is not writable"):
        make_folder(tmp_path / "a")
