"""Generation of the data set on a Ray cluster, one task per group of scenes.

A cluster needs a folder with the same path on all machines (NFS, Lustre, ...), and on each machine the same versions
of ngff and Python:

    ray start --head                        # on one machine; it prints the address
    ray start --address=HEAD:6379           # on each of the others
    ngff-lab dataset /shared/OUT --ray auto # on any of them; or --ray ray://HEAD:10001 from outside

With `--ray local` Ray is started on this machine alone, to use all its GPUs. Groups are independent and files are
written atomically, so the unfinished groups of a failed machine are repeated on another one.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from tqdm import tqdm

from stages.core.errors import InputError, MissingPackage
from stages.lab.dataset.disk_usage import missing_bytes, require_disk_space
from stages.lab.dataset.generate import DatasetGenerator
from stages.lab.dataset.options import DatasetOptions


def run(out: Path, options: DatasetOptions, address: str) -> None:
    """Write all missing files, like generate.run, with one task per group and one GPU per task if there are any.

    `address` is "local", "auto" or the address of a cluster. Raises MissingPackage without Ray, and InputError if the
    cluster does not answer, if it has no GPU for --device cuda, and for --device cuda:N.
    """
    if options.device.startswith("cuda:"):
        raise InputError(f"--device {options.device}: Ray gives each task a GPU of its own; give --device cuda")
    try:
        import ray
    except ImportError as error:
        raise MissingPackage("--ray: Ray is not installed; install it with `pip install 'ngff[ray]'`") from error
    out = Path(out).resolve()
    generator = DatasetGenerator(out, options)  # makes the inputs shared by all groups before the tasks start
    generator.make_shared()
    require_disk_space(out, missing_bytes(generator.layout, options))
    _ = generator.assets
    if not ray.is_initialized():
        try:
            ray.init(address=None if address == "local" else address, log_to_driver=True)
        except (ConnectionError, ValueError) as error:
            raise InputError(f"--ray {address}: no cluster responds ({error}); start one with `ray start --head`, or "
                             "use this machine alone with `--ray local`") from error  # fmt: skip
    gpus = float(options.device != "cpu" and ray.cluster_resources().get("GPU", 0) >= 1)
    if options.device == "cuda" and not gpus:
        raise InputError(f"--device cuda: no machine of the cluster {address} has a GPU; leave --device out")
    task = ray.remote(num_gpus=gpus, num_cpus=1, max_retries=3)(_make_group)
    pending = [task.remote(out, replace(options, groups=group, shard="1/1")) for group in options.shard_groups]
    with tqdm(total=len(pending), desc="groups", unit="group") as bar:
        while pending:
            done, pending = ray.wait(pending)
            ray.get(done)  # raises the error of a failed task
            bar.update(len(done))
    print(f"{out}: complete")


def _make_group(out: Path, options: DatasetOptions) -> None:
    """Task that makes one group; objects and backgrounds exist already."""
    DatasetGenerator(out, options).make_group(options.groups)
