"""Removal of false positives: texture of the table becomes background, thin objects are kept."""

from dataclasses import replace

import pytest
import torch

from stages.core.perception.false_positives import remove_false_positives
from stages.core.perception.support import find_support
from tests.segment.tabletop import block, scene_of, table_gaussians, three_apart


def left(scene, ids):
    labelled = replace(scene, gaussians=replace(scene.gaussians, object_id=ids))
    return remove_false_positives(labelled, find_support(scene)).object_id


@pytest.fixture(scope="module")
def truth():
    return three_apart(noise=0.001)


def test_sparse_texture_becomes_background(truth):
    g = truth.gaussians
    near = torch.cdist(g.means[:, :2], g.means[g.object_id > 0][:, :2]).amin(1) < 0.05
    patch = (g.object_id == 0) & ~near & (g.means[:, :2].norm(dim=1) < 0.4)
    threads = patch & (torch.arange(len(patch)) % 3 == 0)
    found = left(truth, torch.where(threads, 4, g.object_id))
    assert threads.sum() > 100 and torch.equal(found, g.object_id)


def test_stripe_of_texture_becomes_background(truth):
    g = truth.gaussians
    stripe = (g.object_id == 0) & ((g.means[:, 1] + 0.3).abs() < 0.01) & (g.means[:, 0].abs() < 0.15)
    found = left(truth, torch.where(stripe, 4, g.object_id))
    assert stripe.sum() > 20 and torch.equal(found, g.object_id)


@pytest.mark.parametrize("size", [(0.2, 0.014, 0.014), (0.14, 0.07, 0.009), (0.14, 0.07, 0.006)],
                         ids=["rope", "phone", "card"])  # fmt: skip
def test_thin_objects_are_kept(size):
    scene = scene_of(table_gaussians(), block((0.0, 0.0), size, (0.8, 0.1, 0.1), 1), noise=0.0005)
    assert torch.equal(left(scene, scene.gaussians.object_id), scene.gaussians.object_id)


def test_partially_labelled_phone_is_kept():
    """Its unlabelled Gaussians lie at its own height all over it and must not count as table."""
    scene = scene_of(table_gaussians(), block((0.0, 0.0), (0.14, 0.07, 0.009), (0.8, 0.1, 0.1), 1), noise=0.0005)
    true = scene.gaussians.object_id
    ids = torch.where(torch.arange(len(true)) % 5 == 0, 0, true)
    assert (ids != true).sum() > 20 and torch.equal(left(scene, ids), ids)


def test_scene_without_table_or_objects_is_unchanged(truth):
    none = torch.zeros_like(truth.gaussians.object_id)
    assert not left(truth, none).any()
    assert torch.equal(left(truth, none + 1), none + 1)
