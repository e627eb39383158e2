"""Damaged and hostile files end in a right result or one clear sentence."""

from collections import Counter

import h5py
import pytest

from stages.core.errors import InputError
from stages.core.scene.schema import MAX_JSON_DEPTH, parse_json, quote
from stages.core.scene.trajectory import read_trajectory
from stages.lab.fuzz import KINDS, result_of, run, write_trajectory


def test_two_thousand_damaged_files(tmp_path):
    counts, failures = run(tmp_path, 2001)
    assert not failures, "\n".join(failures[:5])
    per_kind = Counter()
    for (kind, result), count in counts.items():
        per_kind[kind] += count
        assert result in ("right", "clear error")
    assert per_kind == {kind.name: 667 for kind in KINDS}
    assert all(counts[kind.name, "right"] > 20 for kind in KINDS)  # the changes are not all fatal


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_valid_files_are_right(kind, tmp_path):
    kind.write(tmp_path / kind.name)
    assert result_of(kind, tmp_path / kind.name) == ("right", "")


@pytest.mark.parametrize("dtype", ["f2", "f8", ">f4", ">f8"])
def test_other_float_types_are_converted(tmp_path, dtype):
    write_trajectory(tmp_path / "t.h5")
    with h5py.File(tmp_path / "t.h5", "a") as file:
        for name in ("gaussians/means", "cameras/viewmats", "keypoints/positions", "binding/weight"):
            values = file[name][()]
            del file[name]
            file[name] = values.astype(dtype)
    assert read_trajectory(tmp_path / "t.h5").positions.dtype.is_floating_point


@pytest.mark.parametrize("target", [h5py.SoftLink("/gaussians/means"), h5py.ExternalLink("/etc/hostname", "/")])
def test_links_are_not_followed(tmp_path, target):
    write_trajectory(tmp_path / "t.h5")
    with h5py.File(tmp_path / "t.h5", "a") as file:
        del file["gaussians/means"]
        file["gaussians/means"] = target
    with pytest.raises(InputError, match="gaussians/means is a link"):
        read_trajectory(tmp_path / "t.h5")


def test_json_is_bounded_and_quoted_text_too():
    assert parse_json("[" * (MAX_JSON_DEPTH - 1) + "]" * (MAX_JSON_DEPTH - 1))
    for text in ("[" * (MAX_JSON_DEPTH + 1) + "]" * (MAX_JSON_DEPTH + 1), "[" * 10**5, "NaN", "1e999", "9" * 30):
        with pytest.raises(ValueError) as caught:
            parse_json(text)
        assert len(str(caught.value)) < 120
    assert quote("\x1b[31m\n" + "x" * 100) == "?[31m?" + "x" * 71 + "..."
