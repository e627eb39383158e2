"""Batches of scenes: independence, exact sums and failures."""

import pytest
import torch

from stages.core.physics.mpm import solver as mpm
from stages.core.physics.mpm.batch import Batch
from tests.conftest import DEVICES
from tests.core.physics.test_mpm import block

BOX, DX, SUBSTEPS, GRAVITY = mpm.Box((-0.3, -0.3, 0.0), (0.5, 0.5, 0.6)), 0.05, 40, (0.0, 0.0, -9.81)
ORDERS = [("cpu", "split"), ("cpu", "fused")] + [("cuda", "fused")] * (len(DEVICES) > 1)


def scenes() -> dict[str, mpm.Particles]:
    """Three scenes of different size, height, stiffness and speed."""
    made = {
        "low": block((0.2, 0.2, 0.1), 0.025, low=(0, 0, 0.01)),
        "tall": block((0.1, 0.1, 0.3), 0.025, E=3e4, low=(0.1, 0.1, 0.05)),
        "fast": block((0.1, 0.2, 0.1), 0.025, E=2e5, low=(0.0, 0.0, 0.2)),
    }
    made["fast"].v[:] = torch.tensor([1.0, 0.5, -2.0])
    return made


@pytest.mark.parametrize("device, schedule", ORDERS)
def test_scenes_of_a_batch_are_independent(device, schedule):
    # equal up to rounding, because sums are split at other particles
    batch = Batch(scenes(), BOX, DX, device)
    together = [frame for frame in batch.frames(7, 0.02, SUBSTEPS, GRAVITY)][-1]
    for name, particles in scenes().items():
        alone = mpm.Solver(particles, BOX, DX, device, mpm.SolverOptions(schedule=schedule))
        for _ in range(6):
            alone.advance(0.02, torch.tensor(GRAVITY).repeat(len(particles), 1), SUBSTEPS)
        torch.testing.assert_close(together.of(name).x, alone.particles.x, rtol=0, atol=2e-5)
        torch.testing.assert_close(together.of(name).F, alone.particles.F, rtol=0, atol=2e-3)
    assert batch.failures() == {}


@pytest.mark.parametrize("device", DEVICES)
def test_exact_sums_do_not_depend_on_batch_and_order(device):
    def last(made: dict[str, mpm.Particles]):
        batch = Batch(made, BOX, DX, device, mpm.SolverOptions(schedule="exact"))
        return list(batch.frames(5, 0.02, SUBSTEPS, GRAVITY))[-1]

    made = scenes()
    together = last(made)
    for name in made:
        alone = last({name: made[name]})
        assert torch.equal(alone.x, together.of(name).x) and torch.equal(alone.F, together.of(name).F)
    low = made["low"]
    backwards = last({"low": mpm.Particles(*(getattr(low, f).flip(0) for f in low.__dataclass_fields__))})
    assert torch.equal(backwards.x.flip(0), together.of("low").x)
    # exact sums agree with floating-point sums up to rounding
    rough = list(Batch(made, BOX, DX, device).frames(5, 0.02, SUBSTEPS, GRAVITY))[-1]
    torch.testing.assert_close(together.x, rough.x, rtol=0, atol=2e-5)


@pytest.mark.parametrize("device", DEVICES)
def test_failed_scenes_are_named_and_others_finish(device):
    good = Batch(scenes(), BOX, DX, device)
    expected = list(good.frames(5, 0.02, SUBSTEPS, GRAVITY))[-1]
    bad = scenes()
    bad["tall"].v[17] = torch.nan
    bad["lonely"] = block((0.05, 0.05, 0.05), 0.025, low=(0.3, 0.3, 0.3))
    bad["lonely"].v[:, 0] = 2000.0  # it passes the wall in one substep
    batch = Batch(bad, BOX, DX, device)
    last = list(batch.frames(5, 0.02, SUBSTEPS, GRAVITY))[-1]
    assert set(batch.failures()) == {"tall", "lonely"}
    assert "frame 1" in batch.failures()["lonely"]
    assert bool(last.x.isfinite().all())  # lost particles stay in place
    for name in ("low", "fast"):
        torch.testing.assert_close(last.of(name).x, expected.of(name).x, rtol=0, atol=2e-5)


def test_a_loss_of_the_first_particle_is_a_failure_at_its_first_frame():
    made = {"one": block((0.1, 0.1, 0.1), 0.05, low=(0, 0, 0.2)), "two": block((0.1, 0.1, 0.1), 0.05, low=(0, 0, 0.2))}
    made["one"].v[0, 2] = -2000.0
    made["two"].v[[3, 5]] = torch.nan
    batch = Batch(made, BOX, DX, "cpu")
    list(batch.frames(3, 0.02, SUBSTEPS, GRAVITY))
    particle, frame = batch.lost()
    assert particle.tolist() == [0, 3] and frame.tolist() == [1, 1]
    assert {name: text.split(" left")[0] for name, text in batch.failures().items()} == {
        "one": "particle 0", "two": "particle 3"
    }  # fmt: skip


def test_number_of_scenes_that_fit_into_the_memory_of_a_gpu(monkeypatch):
    """Twice the memory holds twice as many scenes; a device with too little memory still gets one scene."""
    fits = []
    for free in (0, 1 << 30, 1 << 31, 1 << 50):
        monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device, free=free: (free, free))
        fits.append(Batch.fits(BOX, DX, 100_000, "cuda"))
    assert fits[0] == 1 < fits[1] and fits[2] == pytest.approx(2 * fits[1], abs=1)
    assert fits[3] == (2**31 - 1) // mpm.make_grid(BOX, DX).count  # indices have 31 bits


def test_number_of_scenes_that_fit_on_a_cpu():
    count = mpm.make_grid(BOX, DX).count
    fits = Batch.fits(BOX, DX, 1000, "cpu")
    assert fits > 1 and fits * count < 2**31
    assert Batch.fits(BOX, DX, 1000, "cpu", exact=True) == fits // 2  # sums have 64 bits
    with pytest.raises(ValueError, match="too many"):
        one = block((0.05, 0.05, 0.05), 0.05)
        mpm.Solver(mpm.join_particles([one] * 40), mpm.Box((-4, -4, 0), (4, 4, 4)), 0.02, sizes=[len(one)] * 40)
