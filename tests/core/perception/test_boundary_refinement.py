"""Boundary refinement corrects wrong labels near boundaries and changes no others."""

from dataclasses import replace

import pytest
import torch

from stages.core.perception.boundary_refinement import MIN_VISIBLE_WEIGHT, refine_boundaries
from stages.core.perception.support import find_support
from stages.core.perception.visibility import summed_view_directions
from tests.segment.tabletop import block, scene_of, table_gaussians, three_apart


def relabelled(scene, ids):
    return replace(scene, gaussians=replace(scene.gaussians, object_id=ids))


def shown(scene):
    return summed_view_directions(scene.gaussians, scene.cameras).norm(dim=1) > MIN_VISIBLE_WEIGHT


def iou(a, b):
    return float((a & b).sum() / (a | b).sum())


@pytest.fixture(scope="module")
def truth():
    return three_apart(noise=0.001)


def skirted(scene, width):
    """Labels in which the table within `width` [m] of each object has the label of that object."""
    g, ids = scene.gaussians, scene.gaussians.object_id.clone()
    for n in (1, 2, 3):
        near = torch.cdist(g.means[:, :2], g.means[g.object_id == n][:, :2]).amin(1) < width
        ids[near & (ids == 0)] = n
    return ids


def test_table_labelled_as_object_is_corrected(truth):
    wrong, true = skirted(truth, 0.02), truth.gaussians.object_id
    found = refine_boundaries(relabelled(truth, wrong), find_support(truth)).object_id
    seen = shown(truth)
    taken = (wrong > 0) & (true == 0) & seen  # without the Gaussians under an object, which no photo shows
    assert taken.sum() > 200 and (found[taken] == 0).float().mean() > 0.99
    assert min(iou((found == n) & seen, (true == n) & seen) for n in (1, 2, 3)) > 0.99


def test_object_labelled_as_table_is_corrected(truth):
    true, ids = truth.gaussians.object_id, truth.gaussians.object_id.clone()
    ids[(true == 1) & (truth.gaussians.means[:, 2] < 0.012)] = 0
    lost = (ids == 0) & (true == 1) & shown(truth)
    found = refine_boundaries(relabelled(truth, ids), find_support(truth)).object_id
    assert lost.sum() > 50 and (found[lost] == 1).float().mean() > 0.9


def test_table_of_another_colour_is_corrected():
    patch = table_gaussians()
    stained = (patch.means[:, 0] > 0.05) & (patch.means[:, 1].abs() < 0.12)
    patch.sh[stained, 0] -= 0.8  # a dark patch that extends from the block to where the table is certain
    scene = scene_of(patch, block((0.0, 0.0), (0.1, 0.1, 0.08), (0.8, 0.1, 0.1), 1), noise=0.0005)
    true = scene.gaussians.object_id
    ids = torch.where((true == 0) & (scene.gaussians.means[:, 0] - 0.1).abs().lt(0.06)
                      & (scene.gaussians.means[:, 1].abs() < 0.05), 1, true)  # fmt: skip
    found = refine_boundaries(relabelled(scene, ids), find_support(scene)).object_id
    assert (ids != true).sum() > 40 and iou(found == 1, true == 1) > 0.97


def test_true_labels_and_invisible_gaussians_are_unchanged(truth):
    support = find_support(truth)
    found = refine_boundaries(truth, support).object_id
    assert (found == truth.gaussians.object_id).float().mean() > 0.998
    below = truth.gaussians.means.clone()
    buried = torch.nonzero(truth.gaussians.object_id == 1)[:5, 0]
    below[buried] = torch.tensor([0.3, 0.3, -0.05])  # under the table, which hides it
    hidden = replace(truth, gaussians=replace(truth.gaussians, means=below))
    assert (refine_boundaries(hidden, support).object_id[buried] == 1).all()
    blind = relabelled(replace(truth, cameras=None), skirted(truth, 0.02))
    assert torch.equal(refine_boundaries(blind, support).object_id, blind.gaussians.object_id)


def test_no_gaussian_changes_between_objects():
    scene = scene_of(
        table_gaussians(), block((-0.05, 0.0), (0.1, 0.1, 0.08), (0.8, 0.1, 0.1), 1),
        block((0.055, 0.0), (0.1, 0.1, 0.08), (0.8, 0.15, 0.1), 2),
    )  # fmt: skip
    found, true = refine_boundaries(scene, find_support(scene)).object_id, scene.gaussians.object_id
    assert not ((found > 0) & (true > 0) & (found != true)).any()
