"""Checks that the values returned by readers satisfy their types; each raises AssertionError otherwise."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import fields

import torch

from stages.core.physics.forces import Force, ForcePrompts
from stages.core.physics.materials import MaterialChoice
from stages.core.scene.cameras import Cameras, LensDistortion, check_cameras
from stages.core.scene.scene import Scene
from stages.core.scene.trajectory import Trajectory
from stages.lab.clutter.examples import Example
from stages.lab.dataset.keypoint_motions import KeypointMotions
from stages.lab.dataset.scene_configs import SceneConfig
from stages.lab.questionnaire.answers import Answers
from stages.segment.prompts import ObjectPrompts
from stages.simulate.options import SimulateOptions


def check_scene(scene: Scene) -> None:
    """AssertionError unless the values of a scene satisfy their types."""
    g = scene.gaussians
    assert len(g) and all(len(getattr(g, f.name)) == len(g) for f in fields(g)), "lengths differ"
    assert all(getattr(g, f.name).isfinite().all() for f in fields(g)), "not finite"
    assert g.means.dtype == g.scales.dtype == g.sh.dtype == torch.float32 and g.object_id.dtype == torch.int64, "types"
    assert g.sh.shape[1] in (1, 4, 9, 16) and (g.scales >= 0).all() and (g.quats.norm(dim=1) > 0).all(), "Gaussians"
    assert g.object_id.min() >= 0 and g.object_id.max() < 1 << 16 and g.means.abs().max() < 1e10, "ranges"
    assert len({o.id for o in scene.objects}) == len(scene.objects), "objects"
    assert scene.floor is None or isinstance(scene.floor, float) and abs(scene.floor) < 1e10, "floor"
    assert 0 < scene.metres_per_unit < 1e10 and all(o.name.isprintable() for o in scene.objects), "header"
    if scene.cameras is not None:
        check_cameras_of(scene.cameras)


def check_cameras_of(cameras: Cameras) -> None:
    """AssertionError unless cameras are rigid and finite."""
    try:
        check_cameras(cameras)
    except ValueError as error:
        raise AssertionError(str(error)) from error


def check_trajectory(t: Trajectory) -> None:
    """AssertionError unless the values of a trajectory satisfy their types."""
    check_scene(t.scene)
    assert len(t) and t.positions.shape == (len(t), len(t.keypoints.rest), 3), "positions"
    assert all(x.isfinite().all() for x in (t.positions, t.com, t.rotation, t.binding.weight, t.keypoints.rest)), "nan"
    assert t.binding.index.shape == t.binding.weight.shape and int(t.binding.index.max()) < t.positions.shape[1], "bind"
    bound, sums = (t.binding.index >= 0).any(1), t.binding.weight.sum(1)
    assert ((sums - 1).abs()[bound] < 0.1).all() and (t.binding.weight[t.binding.index < 0].abs() < 0.1).all(), (
        "weights"
    )
    assert ((t.rotation.norm(dim=-1) - 1).abs() < 0.1).all(), "rotations"
    assert 0 < t.info.dt < 1e5 and all(abs(x) < 1e10 for x in t.info.gravity), "info"
    if t.field is not None:
        values = [x for x in vars(t.field).values() if isinstance(x, torch.Tensor)]
        assert all(x.float().isfinite().all() for x in values), "field"
        assert len(t.field.points) == len(t.keypoints.rest) and len(t.field.mass) == len(t.scene.objects), "field"


def check_lenses(found: tuple[Cameras, LensDistortion]) -> None:
    """AssertionError unless cameras are rigid and finite, and lens coefficients finite."""
    check_cameras_of(found[0])
    assert found[1].coefficients.isfinite().all() and found[1].coefficients.abs().max() < 1e10, "lens"


def check_forces(forces: Sequence[Force]) -> None:
    """AssertionError unless forces are finite and act for some time."""
    for f in forces:
        assert 0 <= f.start < f.end and f.start < 1e10 and f.object_id in (1, 2), "times"
        assert all(abs(x) < 1e10 for x in (*f.force, *f.torque, *(f.at or ()))), "vectors"


def check_force_prompts(prompts: ForcePrompts) -> None:
    """AssertionError unless all prompts of a simulation are finite and refer to known objects."""
    check_forces(prompts.forces)
    assert all(abs(x) < 1e10 for v in prompts.velocity.values() for x in v), "velocity"
    assert all(abs(x) < 1e10 for x in prompts.lift.values()), "lift"
    ids = {*prompts.pinned, *prompts.velocity, *prompts.lift, *(c.object_id for c in prompts.changes)}
    assert ids <= {1, 2, None} and all(0 <= c.start < 1e10 for c in prompts.changes), "objects"


def check_simulate_options(options: SimulateOptions) -> None:
    """AssertionError unless options have the types of their fields."""
    texts = (options.engine, options.quality, options.integrator, options.box or "", *options.material)
    assert all(isinstance(x, str) for x in texts) and 0 < options.steps < 1e6 and 0 < options.dt <= 1, "options"
    numbers = (options.gravity, options.floor or 0.0, options.friction or 0.0, options.keypoints or 8, options.seed)
    assert all(isinstance(x, (int, float)) and abs(x) < 1e10 for x in numbers), "numbers"


def check_materials(found: dict[int, MaterialChoice]) -> None:
    """AssertionError unless all materials have values in a plausible range."""
    for part in (part for choice in found.values() for part in choice.parts):
        m = part.material
        assert 1e-4 < m.E < 1e14 and 1e-4 < m.density < 1e6 and -0.5 < m.nu < 0.5 and 0 <= m.friction < 1e3, "material"
        assert 0 <= m.loss < 10 and all(math.isfinite(x) for x in m.plastic), "loss"


def check_prompts(p: ObjectPrompts) -> None:
    """AssertionError unless prompts are finite and named."""
    for values in (p.boxes, p.points):
        assert values is None or values.isfinite().all() and len(values) == len(p.names), "prompts"
    assert all(isinstance(name, str) and name.isprintable() and len(name) <= 200 for name in p.names), "names"


def check_names(names: dict[int, object]) -> None:
    """AssertionError unless numbers are valid labels and names are printable text."""
    assert all(isinstance(i, int) and 0 <= i < 1 << 16 for i in names), "labels"
    texts = [getattr(name, "name", name) for name in names.values()]
    assert all(text.isprintable() and len(text) <= 200 for text in texts), "text"


def check_configs(configs: dict[str, SceneConfig]) -> None:
    """AssertionError unless scenes have objects with finite positions and positive scales."""
    for c in configs.values():
        assert len(c.ids) == len(c.translation) == len(c.scale) > 0 and min(c.ids) >= 0 < min(c.scale), "lengths"
        assert all(abs(x) < 1e6 for p in (*c.translation, c.scale) for x in p) and "/" not in c.name, "values"


def check_parameters(model: torch.nn.Module) -> None:
    """AssertionError unless all parameters are finite, on the CPU and in single precision."""
    for p in (*model.parameters(), *model.buffers()):
        assert p.device.type == "cpu" and (not p.is_floating_point() or p.dtype == torch.float32), "type"
        assert p.isfinite().all(), "not finite"


def check_motions(m: KeypointMotions) -> None:
    """AssertionError unless shapes agree and all values are finite."""
    s, t, o, n, _ = m.points.shape
    assert s and t and o and n and len(m.names) == s and m.objects.shape == (s, o), "shapes"
    for name in ("mass", "E", "nu", "friction", "solidity"):
        assert getattr(m, name).shape == (s, o) and getattr(m, name).isfinite().all(), name
    assert m.points.isfinite().all() and m.points.abs().max() < 1e10 and 0 < m.dt < 1e5, "values"
    assert all(abs(x) < 1e10 for x in (*m.gravity, *m.box[0], *m.box[1])), "box"


def check_images(images: Iterable[torch.Tensor]) -> None:
    """AssertionError unless images are RGB from 0 to 1, or labels."""
    for image in images:
        assert image.numel() and image.isfinite().all() and image.min() >= 0, "pixels"
        assert image.ndim == 2 or image.shape[2] == 3, "channels"


def check_labelled(scene: Scene) -> None:
    """AssertionError unless a labelled scene satisfies its types and lists an object for each id of its Gaussians."""
    check_scene(scene)
    assert {o.id for o in scene.objects} >= set(scene.gaussians.object_id.unique().tolist()) - {0}, "objects"


def check_example(example: Example) -> None:
    """AssertionError unless surfels are finite and each has a label."""
    values = vars(example.surfels).values()
    assert all(x.dtype == torch.float32 and x.isfinite().all() and len(x) == len(example.labels) for x in values)
    assert example.labels.dtype == torch.int64, "labels"


def check_points(x: torch.Tensor) -> None:
    """AssertionError unless points are finite."""
    assert x.shape[1:] == (3,) and x.dtype == torch.float32 and x.isfinite().all(), "points"


def check_answers(answers: Answers) -> None:
    """AssertionError unless ratings are on the scale, or 0 for none."""
    for table in answers.ratings.values():
        assert table.shape == (1, len(answers.films)) and table.min() >= 0 and table.max() <= answers.points, "ratings"


def check_sums(sums: dict[str, str]) -> None:
    """AssertionError unless digests have the right length."""
    assert all(len(digest) == 64 for digest in sums.values()), "digests"


def check_message(message: dict) -> None:
    """AssertionError unless the numbers of a message are finite."""
    values = [v for value in message.values() for v in (value if isinstance(value, tuple) else (value,))]
    assert all(abs(v) < 1e10 for v in values if isinstance(v, (int, float))), "numbers"
