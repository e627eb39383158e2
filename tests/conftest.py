"""Fixtures for tiny scenes, devices and external programs, and skips for data and packages that may be missing."""

import gc
import logging
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from typer import testing

from stages.core.errors import MissingPackage
from stages.core.geometry.cameras import intrinsics, orbit
from stages.core.physics.skinning import Skinning
from stages.core.scene.cameras import Cameras
from stages.core.scene.gaussians import Gaussians, concatenate
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.trajectory import Binding, Keypoints
from tests import calls, made
from tests.browser import chromium, open_page  # noqa: F401 -- fixtures
from tests.chat_server import chat_server  # noqa: F401 -- a fixture
from tests.firefox import open_firefox  # noqa: F401 -- fixture

if "OMP_NUM_THREADS" not in os.environ:  # plugins import PyTorch earlier, so it is too late to set the variable
    torch.set_num_threads(1 if "PYTEST_XDIST_WORKER" in os.environ else 2)
DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
SHARED = Path(__file__).resolve().parents[1].parent / "shared"

gc.disable()  # until tests are collected, since the millions of objects of imported modules and tests are never freed


def pytest_collection_finish() -> None:
    """Enable garbage collection again, with a high threshold and without scanning the objects that exist already."""
    gc.freeze()
    gc.set_threshold(100_000, 20, 20)
    gc.enable()
    # pytest adds its handlers in each test to all loggers that do not propagate; PyTorch has seventy of them
    for name, logger in logging.root.manager.loggerDict.items():
        if name.startswith("torch") and isinstance(logger, logging.Logger):
            logger.propagate = True


def pytest_collection_modifyitems(items) -> None:
    """Select tests parametrised with a GPU by `-m gpu`, and skip tests that need a GPU if there is none."""
    for item in items:
        if item.get_closest_marker("gpu") and not torch.cuda.is_available():
            item.add_marker(pytest.mark.skip(reason="needs an NVIDIA GPU"))
        if hasattr(item, "callspec") and any(isinstance(p, str) and p == "cuda" for p in item.callspec.params.values()):
            item.add_marker(pytest.mark.gpu)


@contextmanager
def skipped_without_package() -> Iterator[None]:
    """Skip the test, naming the package, if an error is caused by a package that is not installed."""
    try:
        yield
    except Exception as error:
        cause = error
        while cause is not None and not isinstance(cause, MissingPackage):
            cause = cause.__cause__ or cause.__context__
        if cause is None:
            raise
        pytest.skip(str(cause))


class CliRunner(testing.CliRunner):
    """Runs commands; raises MissingPackage if a command failed because of a missing package, to skip the test."""

    def invoke(self, *args, **options):
        done = super().invoke(*args, **options)
        if isinstance(done.exception, SystemExit) and isinstance(done.exception.__context__, MissingPackage):
            raise done.exception.__context__
        return done


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup():
    calls.clear()
    made.clear()
    with skipped_without_package():
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call():
    with skipped_without_package():
        return (yield)


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Run PyTorch on one thread, which is faster for tiny tensors."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def with_threads() -> Iterator[Callable]:
    """A function that calls another function with a given number of PyTorch threads."""
    before = torch.get_num_threads()

    def call(threads, function, *arguments):
        torch.set_num_threads(threads)
        return function(*arguments)

    yield call
    torch.set_num_threads(before)


@pytest.fixture(scope="module", params=DEVICES)
def device(request) -> str:
    """The device of a test, which `--device auto`, the default of every command, selects while the test runs.

    Module-scoped fixtures run before this takes effect, and must pass the device to the commands that they call.
    """
    return request.param


@pytest.fixture(autouse=True)
def auto_picks_the_device_of_the_test(request) -> Iterator[None]:
    """Hide GPUs from tests on the CPU."""
    with pytest.MonkeyPatch.context() as patch:
        if "device" in request.fixturenames and request.getfixturevalue("device") == "cpu":
            patch.setattr(torch.cuda, "is_available", lambda: False)
        yield


@pytest.fixture
def shared() -> Path:
    """The folder with real photos and splats, which are not part of the repository."""
    if not (SHARED / "data").is_dir():
        pytest.skip("the shared data are not on this machine")
    return SHARED


def random_gaussians(n: int, seed: int = 0, degree: int = 0, size: float = 0.05) -> Gaussians:
    """Random Gaussians in the unit cube around the origin."""
    rng = torch.Generator().manual_seed(seed)
    quats = torch.nn.functional.normalize(torch.randn(n, 4, generator=rng), dim=1)
    return Gaussians(
        torch.rand(n, 3, generator=rng) - 0.5,
        quats,
        size * (0.2 + torch.rand(n, 3, generator=rng)),
        0.1 + 0.8 * torch.rand(n, generator=rng),
        0.3 * torch.randn(n, (degree + 1) ** 2, 3, generator=rng),
        torch.zeros(n, dtype=torch.int64),
    )


def deform(gaussians: Gaussians, binding: Binding, keypoints: Keypoints, positions: torch.Tensor) -> Gaussians:
    """The Gaussians deformed to one frame."""
    return Skinning(gaussians, binding, keypoints)(positions)


def ring(count: int = 6, size: int = 64, target: float = 0.0) -> Cameras:
    """A ring of cameras around the vertical axis through the origin, two units away."""
    viewmats = orbit(count, torch.tensor([0.0, 0, target]), radius=2.0, elevation=25.0)
    K = intrinsics(size, size, 1.5 * size)
    sizes = torch.full((count, 2), size)
    return Cameras(viewmats, K.expand(count, 3, 3).clone(), sizes, tuple(f"{i:02d}.png" for i in range(count)))


def ball(centre: tuple, radius: float, n: int, colour: tuple, object_id: int, seed: int = 0) -> Gaussians:
    """A shell of small opaque Gaussians."""
    rng = torch.Generator().manual_seed(seed)
    dirs = torch.nn.functional.normalize(torch.randn(n, 3, generator=rng), dim=1)
    sh = ((torch.tensor(colour) - 0.5) / 0.28209479177387814).expand(n, 1, 3).clone()
    return Gaussians(
        torch.tensor(centre) + radius * dirs, torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        torch.full((n, 3), 1.2 * radius * (4 / n) ** 0.5), torch.full((n,), 0.9), sh, torch.full((n,), object_id),
    )  # fmt: skip


@pytest.fixture
def two_balls() -> Scene:
    return two_balls_scene()


def two_balls_scene() -> Scene:
    """A red and a green ball above a grey floor at z = 0, and six cameras."""
    grid = torch.cartesian_prod(torch.linspace(-1, 1, 30), torch.linspace(-1, 1, 30))
    floor = Gaussians(
        torch.cat([grid, torch.zeros(900, 1)], 1), torch.tensor([[1.0, 0, 0, 0]]).repeat(900, 1),
        torch.tensor([[0.04, 0.04, 0.002]]).repeat(900, 1), torch.full((900,), 0.9), torch.zeros(900, 1, 3),
        torch.zeros(900, dtype=torch.int64),
    )  # fmt: skip
    red = ball((-0.3, 0.0, 0.15), 0.15, 400, (0.9, 0.1, 0.1), 1)
    green = ball((0.3, 0.0, 0.40), 0.12, 400, (0.1, 0.8, 0.1), 2, seed=1)
    objects = (SceneObject(1, "red ball", "rubber"), SceneObject(2, "green ball", "rubber"))
    return Scene(concatenate([floor, red, green]), objects, ring(target=0.1), 0.0)
