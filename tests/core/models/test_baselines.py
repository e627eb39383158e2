"""Layers of the baselines, compared with independent implementations of the published formulas."""

import torch

from stages.core.models.baselines.gcn import RADIUS, GraphConv, adjacency
from stages.core.models.baselines.transformer import Transformer, features
from stages.core.models.checkpoints import build
from tests.core.models.dynamics_fixtures import add_padding, overlapping_objects


def test_graph_convolution_equals_the_published_formula():
    # x_i' = b + sum of W x_j / sqrt(d_i d_j) over the neighbours j of i and i itself; d_i counts node i too
    torch.manual_seed(0)
    initial = add_padding(overlapping_objects(1, 2, 15), 0, 3)
    points, valid = initial.points.flatten(1, 2), initial.valid.flatten(1)
    layer, x = GraphConv(4, 5).double(), torch.randn(1, points.shape[1], 4, dtype=torch.float64)
    out = layer(x, adjacency(points, valid))
    nodes = valid[0].nonzero()[:, 0].tolist()
    neighbours = {i: [j for j in nodes if i == j or (points[0, i] - points[0, j]).norm() < RADIUS] for i in nodes}
    assert any(len(js) > 2 for js in neighbours.values()) and any(len(js) < len(nodes) for js in neighbours.values())
    for i in nodes:
        expected = layer.bias.clone()
        for j in neighbours[i]:
            expected = expected + layer.linear.weight @ x[0, j] / (len(neighbours[i]) * len(neighbours[j])) ** 0.5
        torch.testing.assert_close(out[0, i], expected)


def test_adjacency_connects_points_within_the_radius():
    a = torch.tensor([[[0.0, 0, 0], [0.05, 0, 0], [0.3, 0, 0]]])
    A = adjacency(a, torch.ones(1, 3, dtype=torch.bool))
    torch.testing.assert_close(A[0], torch.tensor([[0.5, 0.5, 0], [0.5, 0.5, 0], [0, 0, 1]]))


def test_pointformer_applies_dropout_only_in_training():
    torch.manual_seed(0)
    model, initial = build("pointformer").double(), overlapping_objects()
    a, b = (model.train().rollout(initial, 3) for _ in range(2))
    assert not torch.equal(a, b)
    a, b = (model.eval().rollout(initial, 3) for _ in range(2))
    assert torch.equal(a, b)


def test_transformer_is_invariant_to_horizontal_translation():
    initial = overlapping_objects()
    model = Transformer(hidden=16, layers=2, heads=2).double()
    shift = torch.tensor([0.4, -0.3, 0.0]).double()
    moved = type(initial).of(initial.points + shift, mass=initial.mass, E=initial.E, nu=initial.nu,
    friction=initial.friction,
                           velocity=initial.velocity, spin=initial.spin)  # fmt: skip
    torch.testing.assert_close(model.rollout(moved, 5), model.rollout(initial, 5) + shift, rtol=0, atol=1e-10)


def test_features_are_of_order_one():
    initial = overlapping_objects()
    x = features(initial, Transformer(hidden=8, layers=1, heads=1).initial_state(initial))
    assert x.shape == (2, 3, 12, 29) and x.abs().max() < 4
