"""Generation on a local Ray cluster of two workers gives the same files as without Ray."""

import os
from dataclasses import replace
from pathlib import Path

import pytest

from stages.core.errors import InputError, MissingPackage
from stages.lab.dataset import generate, ray_cluster
from tests.lab.small_world import OPTIONS, shrink

MOTIONS = replace(OPTIONS, groups="3_9,4", parts="motions,scenes", limit=2)


def test_missing_ray_is_reported_with_its_install_command(monkeypatch, tmp_path):
    monkeypatch.setitem(__import__("sys").modules, "ray", None)
    with pytest.raises(MissingPackage, match=r"pip install 'ngff\[ray\]'"):
        ray_cluster.run(tmp_path, MOTIONS, "local")


def test_the_number_of_a_gpu_is_refused(tmp_path):
    with pytest.raises(InputError, match="--device cuda:1: Ray gives each task a GPU of its own; give --device cuda"):
        ray_cluster.run(tmp_path, replace(MOTIONS, device="cuda:1"), "local")


@pytest.mark.slow
def test_two_workers_write_the_same_files_as_one_process(tmp_path, monkeypatch):
    ray = pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    shrink(monkeypatch.setattr, monkeypatch.setitem)
    root = str(Path(__file__).resolve().parents[3])
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    try:
        for _ in range(2):
            cluster.add_node(num_cpus=1)
        paths = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
        ray.init(address=cluster.address, runtime_env={
            "env_vars": {"PYTHONPATH": paths},
            "worker_process_setup_hook": "tests.lab.small_world.shrink_process",
        })  # fmt: skip
        ray_cluster.run(tmp_path / "ray", MOTIONS, "auto")
        assert len({n["NodeID"] for n in ray.nodes() if n["Alive"] and n["Resources"].get("CPU")}) == 2
    finally:
        ray.shutdown()
        cluster.shutdown()
    generate.run(tmp_path / "alone", MOTIONS)
    generate.check(tmp_path / "ray")
    made = {p.relative_to(tmp_path / "ray") for p in (tmp_path / "ray").rglob("*") if p.is_file()}
    assert made == {p.relative_to(tmp_path / "alone") for p in (tmp_path / "alone").rglob("*") if p.is_file()}
    for name in made:
        if name.name not in ("3_9.h5", "4.h5") and name.parent.name != "sums":  # these files contain the options
            assert (tmp_path / "ray" / name).read_bytes() == (tmp_path / "alone" / name).read_bytes(), name
