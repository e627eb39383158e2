from stages.lab.doctor import examine


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


def test_networks_of_reconstruct_are_looked_for(monkeypatch, tmp_path):
    monkeypatch.setenv("NGFF_WEIGHTS", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "pi3.safetensors").write_bytes(bytes(10**8))
    told = {line[4:16].strip(): line for line in examine()}
    assert told["pi3"].startswith("ok") and "pi3.safetensors, 0.1 GB" in told["pi3"]
    assert told["pi3-splat"].startswith("--") and "lishiqianhugh/Pi3_splat" in told["pi3-splat"]
