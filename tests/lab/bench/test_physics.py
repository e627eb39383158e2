"""Textbook experiments: the rigid engine agrees with theory; the benchmark stores rows and writes a page."""

import json
import math
from dataclasses import replace

import pytest
import torch
from scipy.special import ellipk

from stages.core.errors import InputError
from stages.core.physics import solid_surface
from stages.lab.bench.experiments.catalogue import experiments
from stages.lab.bench.experiments.friction import ladder_angle, leaning_angle
from stages.lab.bench.experiments.impacts import flip_time
from stages.lab.bench.motion_options import PhysicsBenchOptions
from stages.lab.bench.physics import chosen, measure, run
from stages.simulate.options import QUALITIES, MpmQuality

ALL = experiments()
QUICK = (
    "slope/25deg friction=0.3",
    "torque/ball",
    "collision/momentum",
    "roll/25deg",
    "rocking/12deg",
    "bounce/friction=0.1 loss=0.02",
    "bounce/friction=0.5 loss=0.15",
)  # experiments that tests/simulate/test_rigid.py does not include in small form
BOXES = [name for name in ALL if name.startswith("boxes/")]


@pytest.fixture(autouse=True)
def small_bodies(monkeypatch, request):
    """Use few particles, which only decide whether a body stands on the floor, and bodies of half the resolution."""
    monkeypatch.setitem(QUALITIES, "draft", MpmQuality(particles=1200, step=0.015))
    if not request.node.get_closest_marker("slow"):
        monkeypatch.setattr(solid_surface, "VOXELS_ALONG", 24)


@pytest.mark.parametrize("name", [*QUICK, *(pytest.param(n, marks=pytest.mark.slow) for n in ALL if n not in QUICK)])
def test_rigid_bodies_agree_with_theory(name):
    row = measure(ALL[name], "rigid", PhysicsBenchOptions())
    assert row["passes"], row


def test_a_box_on_a_slope_within_its_friction_creeps_no_faster_in_two_seconds_than_it_may_in_ten():
    creep = ALL["creep/15deg friction=0.3 loss=0.02"]
    short = replace(creep.runs[0], options={**creep.runs[0].options, "steps": 101})
    row = measure(replace(creep, runs=(short,)), "rigid", PhysicsBenchOptions())
    assert abs(row["value"]) < (2 - 0.5) / (10 - 0.5)  # share of the limit of 1e-4 sides between 0.5 and 10 s


def test_names_say_the_case_and_tolerances_exclude_failures():
    assert len(BOXES) == 60
    boxes, slide = ALL[BOXES[0]], ALL["slide/friction=0.3"]
    assert slide.value == pytest.approx(2**2 / (2 * 0.3 * 9.81))
    assert boxes.passes("ngff", 0.04) and not boxes.passes("ngff", -0.04) and not boxes.passes("rigid", 0.06)
    assert slide.passes("rigid", 1.04 * slide.value) and not slide.passes("rigid", 1.06 * slide.value)


def test_a_slightly_leaning_block_turns_as_a_linear_pendulum_upside_down():
    """For small angles, slenderness - angle = (slenderness - start) cosh(p t), with p^2 = 3 g / (4 R)."""
    slender, p = math.atan2(0.01, 1.0), math.sqrt(0.75 * 9.81 / (math.hypot(0.01, 1.0) / 2))
    expected = slender - (slender - 0.005) * math.cosh(0.2 * p)
    assert leaning_angle(0.01, 1.0, 0.005, 0.2) == pytest.approx(expected, abs=1e-6)


def test_a_thin_ladder_slides_as_a_rod():
    """angle'' = -3 g / (2 length) cos(angle), which integrates to rate^2 = 3 g (sin(start) - sin(angle))."""
    time, dt = 0.2, 1e-5
    angle = [ladder_angle(1.0, 0.0, 1.0, t) for t in (time - dt, time + dt)]
    rate = (angle[1] - angle[0]) / (2 * dt)
    assert rate**2 == pytest.approx(3 * 9.81 * (math.sin(1.0) - math.sin(sum(angle) / 2)), rel=1e-3)


def test_measured_rows_are_kept_and_the_page_marks_failures(tmp_path):
    options = PhysicsBenchOptions(only="fall/gravity=25", engines=("rigid",))
    (line, total) = run(tmp_path / "p.json", options)
    assert line.startswith("ok") and total == "rigid: 1 of 1 agree with theory"
    facts = json.loads((tmp_path / "p.json").read_text())
    facts["rows"]["fall/gravity=25"]["rigid"] |= {"value": 9.0, "passes": False}
    (tmp_path / "p.json").write_text(json.dumps(facts))
    (line, total) = run(tmp_path / "p.json", options)
    assert line.startswith("--") and "9.000" in line and total == "rigid: 0 of 1 agree with theory"
    more = PhysicsBenchOptions(only="fall/gravity=9.81", engines=("rigid",))
    list(run(tmp_path / "p.json", more))
    page = (tmp_path / "p.md").read_text()
    assert "| fall/gravity=25 | fall [m] | 0.180 | (9.000) |" in page and "`rigid` 1 of 2" in page
    with pytest.raises(InputError, match="p.json: contains rows measured with --quality draft"):
        list(run(tmp_path / "p.json", PhysicsBenchOptions(engines=("rigid",), quality="normal")))


def test_auto_is_measured_with_the_engine_that_it_takes(tmp_path):
    (line, total) = run(tmp_path / "p.json", PhysicsBenchOptions(only="fall/gravity=25", engines=("auto",)))
    row = json.loads((tmp_path / "p.json").read_text())["rows"]["fall/gravity=25"]["auto"]
    assert row["passes"] and row["engines"] == ["rigid"] and " auto rigid " in line and total.startswith("auto: 1 of 1")
    assert "| `auto` |" in (tmp_path / "p.md").read_text()


def test_experiments_are_chosen_by_groups_and_patterns():
    assert not any("," in name for name in ALL)  # commas separate names in --only
    names = [e.name for e in chosen("roll, tower/3*")]
    assert names == ["roll/10deg", "roll/25deg", "roll/groove", "tower/3 for 2s"]
    assert len(chosen("")) == len(ALL)


def test_unknown_experiments_and_engines_are_errors():
    with pytest.raises(InputError, match="groups are bounce, boxes, collision"):
        chosen("slide,jump")
    with pytest.raises(InputError, match="--engine warp"):
        PhysicsBenchOptions(engines=("warp",))


def test_a_body_that_spins_about_its_middle_axis_flips_after_a_time_given_by_elliptic_integrals():
    """Moments 1, 2, 3 and momentum (l, m, 0), with L^2 < 2 E I_2: its middle component is that of Jacobi's sn, at a
    maximum at first and 0 after a quarter of a period. Source: Landau and Lifshitz, "Mechanics", section 37.
    """
    square, twice_energy = 0.1**2 + 2.0**2, 0.1**2 / 1 + 2.0**2 / 2
    rate = math.sqrt((2 - 1) * (3 * twice_energy - square) / (1 * 2 * 3))
    modulus = (3 - 2) * (square - 1 * twice_energy) / ((2 - 1) * (3 * twice_energy - square))
    found = flip_time(torch.tensor([1.0, 2.0, 3.0]), torch.tensor([0.1, 2.0, 0.0]))
    assert found == pytest.approx(float(ellipk(modulus)) / rate, rel=1e-3)
