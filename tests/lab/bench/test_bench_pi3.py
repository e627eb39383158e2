import pytest
import torch
import torch.nn.functional as F

from stages.core.errors import InputError
from stages.core.models.pi3.network import Pi3
from stages.lab.bench import pi3 as bench_pi3
from stages.lab.bench.pi3 import measure, naive_attention, run, set_attention
from stages.lab.bench.speed_options import Pi3BenchOptions
from tests.core.models.pi3.test_network import TINY, random_weights, views
from tests.core.models.pi3.test_splat import TINY_SPLAT

pytestmark = pytest.mark.usefixtures("one_thread")


@torch.no_grad()
def test_naive_attention_equals_fused_attention():
    q, k, v = torch.randn(3, 2, 4, 9, 16, generator=torch.Generator().manual_seed(0)).unbind()
    torch.testing.assert_close(naive_attention(q, k, v), F.scaled_dot_product_attention(q, k, v))
    model = random_weights(Pi3(TINY))
    ours = model(views())
    set_attention(model, naive_attention)
    torch.testing.assert_close(model(views()).points, ours.points, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("splats", [pytest.param(False, marks=pytest.mark.slow), True])
def test_report_has_a_line_per_view_count_and_baseline(splats, device):
    lines = list(run(None, Pi3BenchOptions(device, (1, 2), 28, 1, splats), TINY_SPLAT))
    assert len(lines) == 6 and lines[1].startswith("Pi3Splat" if splats else "Pi3,")
    assert all("unfused attention" in line for line in lines[3::2])


def test_out_of_memory_is_reported(monkeypatch, device):
    """First the scores of all token pairs exceed the memory, then everything does."""

    def table(*_):
        raise torch.OutOfMemoryError

    monkeypatch.setattr(bench_pi3, "naive_attention", table)
    lines = list(run(None, Pi3BenchOptions(device, (1,), 28, 1), TINY))[2:]
    assert " s " in lines[0] and lines[1].endswith("unfused attention: out of memory")
    monkeypatch.setattr(bench_pi3, "measure", table)
    (line,) = list(run(None, Pi3BenchOptions(device, (3,), 28, 1), TINY))[2:]
    assert line.startswith("views   3  out of memory (estimate") and "nan" not in line


def test_time_and_memory_are_measured(device):
    model = random_weights(Pi3(TINY)).to(device)
    few, many = (measure(model, n, 56, 8, device, 3) for n in (1, 40))
    assert few[0] > 0 and many[0] > 0
    # on a GPU, kernel launches take most of the time
    assert many[0] > few[0] if device == "cpu" else many[1] > few[1] > 0


def test_sizes_must_be_multiples_of_a_patch():
    with pytest.raises(InputError, match="multiple of 14"):
        Pi3BenchOptions(size=450)
