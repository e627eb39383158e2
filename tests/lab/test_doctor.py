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
    bad = [line for line in examine() if "weights" in line]
    assert len(bad) == 1 and bad[0].startswith("--") and "ngff" in bad[0]
