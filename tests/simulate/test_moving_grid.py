"""The MPM grid that moves with its particles, compared with one fixed grid that contains all of the motion."""

import pytest
import torch

from stages.core.errors import InputError
from stages.core.kernels.mpm.grid import BLOCK
from stages.core.physics.mpm import solver
from stages.core.physics.mpm.domain import Box
from stages.core.physics.mpm.solver import ParticleMaterial, at_rest, join_particles
from stages.core.scene.scene import SceneObject
from stages.simulate import moving_grid
from stages.simulate.moving_grid import MARGIN, GridBodies, MovingGrid

DX, DT, STEPS = 0.05, 0.02, 20
OBJECTS = (SceneObject(1, "fast"), SceneObject(2, "slow"))


def cube(at: tuple, velocity: tuple):
    """27 particles of rubber at intervals of half a cell."""
    x = torch.cartesian_prod(*[torch.arange(3) * DX / 2] * 3) + torch.tensor(at)
    particles = at_rest(x, (DX / 2) ** 3, ParticleMaterial(1e5, 0.3, 1000.0, 0.0, 0.0))
    particles.v[:] = torch.tensor(velocity)
    return particles


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_grid_that_follows_changes_nothing_and_keeps_its_margin(device, sign):
    """Two bodies fly apart and upwards, with 5 and 2 m/s."""
    particles = join_particles([cube((0.0, 0.0, 0.5), (4.0 * sign, 3.0 * sign, 2.0)), cube((0.3, 0, 0.5), (0, 0, 2.0))])
    body = torch.arange(2).repeat_interleave(27)
    small, large = Box((-0.5, -0.5, 0.0), (0.9, 0.9, 1.2)), Box((-0.5 - 10 * BLOCK * DX,) * 2 + (0.0,), (3.0, 3.0, 3.0))
    bodies = GridBodies(body, OBJECTS)
    moving = MovingGrid(particles, small, DX, device, bodies, fixed=False)
    still = MovingGrid(particles, large, DX, device, bodies, fixed=True)
    boxes = {moving.box.low + moving.box.high}
    for _ in range(STEPS):
        before, highest = moving.box, moving.solver.particles.x.amax(0).cpu()
        for grid in (moving, still):
            grid.advance(DT, torch.zeros(54, 3))
        if moving.box != before:  # room for the current frame and ten more
            room = MARGIN * DX + 11 * DT * 29**0.5
            torch.testing.assert_close(torch.tensor(moving.box.high) - highest, torch.full((3,), room))
        x = moving.solver.particles.x.cpu()
        room = torch.cat([(x - torch.tensor(moving.box.low))[:, :2], torch.tensor(moving.box.high) - x], 1)
        assert float(room.min()) > MARGIN * DX - 1e-4
        boxes.add(moving.box.low + moving.box.high)
    torch.testing.assert_close(x, still.solver.particles.x.cpu(), rtol=0, atol=1e-4)
    assert still.box == large and moving.box.low[2] == 0
    assert 2 <= len(boxes) <= 3
    moved = (torch.tensor(moving.box.low) - torch.tensor(small.low))[:2] / (BLOCK * DX)
    torch.testing.assert_close(moved, moved.round(), rtol=0, atol=1e-3)  # both grids use the same lattice


def test_what_flies_away_is_the_object_farthest_from_the_others(device, monkeypatch, caplog):
    """It is not the one farthest from the origin."""
    monkeypatch.setattr(moving_grid.mpm, "max_contact_nodes", lambda device: 40_000)
    particles = join_particles([cube((x, 2.0, 0.5), (-v, 0.0, 0.0)) for x, v in ((2.0, 0), (0.8, 20), (2.3, 0))])
    objects = (*OBJECTS[1:], OBJECTS[0], SceneObject(3, "third"))
    bodies = GridBodies(torch.arange(3).repeat_interleave(27), objects)
    moving = MovingGrid(particles, Box((0.4, 1.5, 0.0), (2.8, 2.5, 1.0)), DX, device, bodies, fixed=False)
    moving.advance(DT, torch.zeros(81, 3))
    assert "object 1 (fast) moves too far away from the other objects" in caplog.text
    assert moving.box.low == (0.4, 1.5, 0.0)  # the grid does not move


def test_a_grid_for_many_bodies_begins_near_them_and_one_too_large_is_an_error(device, monkeypatch):
    particles, bodies = join_particles([cube((x, 0, 0.5), (0, 0, 0)) for x in (0.0, 1.0)]), GridBodies(
        torch.arange(2).repeat_interleave(27), OBJECTS)  # fmt: skip
    wide = Box((-3.0, -3.0, 0.0), (4.0, 3.0, 3.0))
    monkeypatch.setattr(moving_grid.mpm, "max_contact_nodes", lambda device: 200_000)
    near = MovingGrid(particles, wide, DX, device, bodies, fixed=False).box
    assert near.low[0] > -1 and near.high[0] < 2 and near.low[2] == 0
    for module, name in ((solver, "MAX_NODES"), (solver, "max_batch_nodes")):
        monkeypatch.setattr(module, name, 5_000 if name == "MAX_NODES" else lambda device: 5_000)
    for fixed, remedy in ((True, "smaller --box"), (False, "fewer objects")):
        with pytest.raises(InputError, match=f"--engine mpm: .*too large; .*{remedy}.*--quality"):
            MovingGrid(particles, wide, DX, device, bodies, fixed=fixed)


def test_frames_of_too_many_substeps_are_an_error_that_says_why(device):
    """Causes are a wrong scale of the scene, or a force that accelerates to unrealistic speeds."""
    particles, box = cube((0.0, 0.0, 0.5), (0.0, 0.0, 0.0)), Box((-0.5, -0.5, 0.0), (0.9, 0.9, 1.2))
    bodies = GridBodies(torch.zeros(27, dtype=torch.int64), OBJECTS[:1])
    grid = MovingGrid(particles, box, DX, device, bodies, fixed=True)
    for call in (grid.substeps, grid.advance):
        with pytest.raises(InputError, match=r"takes .*e\+\d+ substeps, .* 0.05 m and speeds reach 2e\+13 m/s"):
            call(DT, torch.full((27, 3), 1e15 / 3**0.5))
    assert 1 <= grid.substeps(DT, torch.zeros(27, 3)) < 200
