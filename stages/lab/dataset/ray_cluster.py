"""The data set made by the machines of a Ray cluster, a group of scenes each at a time.

A cluster needs a folder that all machines see under the same path (NFS, Lustre, ...), and on each of them the same
version of ngff and of Python:

    ray start --head                        # on one machine; it prints the address
    ray start --address=HEAD:6379           # on each of the others
    ngff-lab dataset /shared/OUT --ray auto # on any of them; or --ray ray://HEAD:10001 from outside

With `--ray local` Ray is started on this machine alone, for its GPUs. Groups are independent, and what a lost machine
had not finished is made again by another: every file appears whole or not at all.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from tqdm import tqdm

from stages.core.errors import InputError
from stages.lab.dataset.disk_usage import missing_bytes, require_disk_space
from stages.lab.dataset.generate import DatasetGenerator
from stages.lab.dataset.options import DatasetOptions


def run(out: Path, options: DatasetOptions, address: str) -> None:
    """As dataset.run, with a task for each group; each takes a GPU where the cluster has some."""
    try:
        import ray
    except ImportError as error:
        raise InputError("--ray: Ray is not installed; `pip install 'ngff[ray]'` brings it") from error
    out = Path(out).resolve()
    maker = DatasetGenerator(out, options)  # what all groups need is made once, here
    maker.shared()
    require_disk_space(out, missing_bytes(maker.layout, options))
    _ = maker.things
    if not ray.is_initialized():
        try:
            ray.init(address=None if address == "local" else address, log_to_driver=True)
        except (ConnectionError, ValueError) as error:
            raise InputError(f"--ray {address}: no cluster answers ({error}); `ray start --head` starts one, "
                             "`--ray local` uses this machine alone") from error  # fmt: skip
    gpus = float(options.device != "cpu" and ray.cluster_resources().get("GPU", 0) >= 1)
    if options.device == "cuda" and not gpus:
        raise InputError(f"--device cuda: no machine of the cluster {address} has a GPU; leave --device out")
    task = ray.remote(num_gpus=gpus, num_cpus=1, max_retries=3)(_group)
    waiting = [task.remote(out, replace(options, groups=group, shard="1/1")) for group in options.mine]
    with tqdm(total=len(waiting), desc="groups", unit="group") as bar:
        while waiting:
            done, waiting = ray.wait(waiting)
            ray.get(done)  # raises what went wrong there
            bar.update(len(done))
    print(f"{out}: complete")


def _group(out: Path, options: DatasetOptions) -> None:
    """On a worker: one group; objects and backgrounds are there."""
    DatasetGenerator(out, options).group(options.groups)
