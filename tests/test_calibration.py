"""`experiment calibration`: people whom no prior knows, and errors over claims."""

import numpy as np
import pytest

from bodyslam_jax.body import load_body_model
from bodyslam_jax.config import Experiment
from bodyslam_jax.experiments import calibration
from bodyslam_jax.simulation.posing import Person


@pytest.fixture(scope="module")
def body():
    return load_body_model()


def test_a_limb_is_as_long_as_asked_and_nothing_else_changes(body):
    plain = Person(body, np.zeros(10))
    person = calibration.with_limbs(
        Person(body, np.zeros(10)), np.array([1.1, 1.0, 0.9, 1.0])
    )
    length = lambda p, a, b: np.linalg.norm(p.rest[b] - p.rest[a])
    for a, b, factor in ((1, 4, 1.1), (5, 8, 1.0), (16, 18, 0.9), (19, 21, 1.0)):
        expected = factor * length(plain, a, b)
        assert length(person, a, b) == pytest.approx(expected, rel=1e-12)
    # Soles stay under their feet: the mesh is as much taller as the thigh is longer.
    longer = plain.rest[1, 1] - plain.rest[4, 1]
    taller = np.ptp(person.skin[:, 1]) - np.ptp(plain.skin[:, 1])
    assert taller == pytest.approx(0.1 * longer, rel=0.05)


@pytest.mark.slow
def test_statures_are_those_of_the_population(body):
    person = Person(body, np.zeros(10))
    rng = np.random.default_rng(0)
    statures = [
        np.ptp(calibration.of_population(person, rng).skin[:, 1]) for _ in range(60)
    ]
    means = np.mean([mean for mean, _ in calibration.POPULATION])
    assert np.mean(statures) == pytest.approx(means, abs=0.04)
    assert 0.07 < np.std(statures) < 0.15


def test_people_are_the_same_in_every_run_and_differ():
    draw = lambda seed: calibration.drawn(seed, Experiment(), "bodies")
    assert draw(3) == draw(3) and draw(3) != draw(4)
    floors = [draw(seed)[1][0] for seed in range(80)]
    assert floors.count("level") > 25 and {"slope", "uneven"} < set(floors)


def test_errors_as_large_as_claimed_have_the_coverage_of_a_normal_distribution(
    tmp_path,
):
    rng = np.random.default_rng(1)
    rows = [
        {
            "sequence": str(i),
            "input": "bodies",
            "status": "ok",
            "z_scale": rng.standard_normal(),
            "z_stature": 2 * rng.standard_normal(),
            "z_up": np.sqrt((rng.standard_normal(2) ** 2).mean()),
            "z_joints": None,
            "joints_within_68": None,
            "joints_within_95": None,
        }
        for i in range(2000)
    ]
    files = calibration.write_calibration(tmp_path, rows, about="Simulated.")
    lines = files[0].read_text().splitlines()
    cells = lambda name: [
        float(x.split(" ")[0])
        for x in next(s for s in lines if s.startswith(f"| {name} | all")).split(" | ")[
            3:
        ]
        for x in [x.strip(" |")]
    ]
    for name in ("scale", "up"):
        rms, one, two = cells(name)
        assert rms == pytest.approx(1, abs=0.05)
        assert one == pytest.approx(0.68, abs=0.03)
        assert two == pytest.approx(0.95, abs=0.02)
    assert cells("stature")[0] == pytest.approx(2, abs=0.1)
    assert not any(line.startswith("| joints") for line in lines)
