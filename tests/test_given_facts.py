"""What a user gives is in the result, and is compared with what is found without it."""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest
from estimates import standing_people, still_camera
from scipy.spatial.transform import Rotation
from test_frontend_motion import CAMERA, scene

from bodyslam_jax import io, people, pipeline, sfm, simulation
from bodyslam_jax.body import load_body_model, rest_joints
from bodyslam_jax.config import Config, Known, Measured, Simulation
from bodyslam_jax.diagnostics import Gait
from bodyslam_jax.diagnostics.accuracy import accuracy, guess_warning
from bodyslam_jax.diagnostics.facts import (
    Fact,
    contradictions,
    given_facts,
    misfits_of_own_factors,
)
from bodyslam_jax.diagnostics.statistics import stature
from bodyslam_jax.ground.gravity import Upright, level
from bodyslam_jax.io.camera.calibration import read_camera
from bodyslam_jax.io.camera.recognise import recognised
from bodyslam_jax.pipeline import sfm_stage
from bodyslam_jax.types import (
    Bodies,
    Intrinsics,
    OwnFactor,
    Result,
    ScaleStart,
    Sequence,
    Tracks,
)

FPS, T = 30.0, 40
LENS = Intrinsics(np.array([525.0, 525.0, 319.5, 239.5]), 640, 480)
LEVEL = Upright(np.array([0.0, 1, 0]), np.array([0.0, 1, 0]), 0.01, 0.0, 0.0)


@pytest.fixture(scope="module")
def body():
    return load_body_model(dtype=jnp.float64)


def somebody(body, shape=0.3, frames=4):
    T_CH = np.tile(np.eye(4), (1, frames, 1, 1))
    T_CH[0, :, :3, 3] = [0.5, 0.1, 4.0]
    present = np.ones((1, frames), bool)
    beta = np.full((1, 10), shape)
    return people.PersonState(present, T_CH, np.zeros((1, frames, 23, 3)), beta)


# Stature


def test_a_size_axis_resizes_the_whole_body(body):
    sized = people.with_size_axis(body)
    beta = np.linspace(-1, 1, 10)
    beta[-1] = 0.0
    small = np.append(0.6 * beta[:-1], (0.6 - 1) / 0.01)
    np.testing.assert_allclose(
        rest_joints(sized, small), 0.6 * np.asarray(rest_joints(body, beta)), atol=1e-12
    )
    assert stature(sized, small) == pytest.approx(0.6 * stature(body, beta))


@pytest.mark.parametrize("height", [1.08, 1.25, 1.9, 2.15])
def test_the_stature_that_is_given_is_the_one_that_starts(body, height):
    """However far it is from the body's: 5 mm, a quarter of its standard deviation."""
    used = body
    if people.beyond_reach(body, height):
        used = people.with_size_axis(body)
    assert used.sized == (height not in (1.9,))
    roots = somebody(used)
    before = people.linear_stature(body)
    tall = before.template + before.slope @ np.append(roots.shape[0, :-1], 0.0)
    given = {0: Measured(height, 0.02)}
    found = people.with_statures(roots, given, used, np.array([0.4]))
    linear = people.linear_stature(used)
    assert linear.template + linear.slope @ found.shape[0] == pytest.approx(
        height, abs=0.005
    )
    ratio = found.T_CH[0, :, :3, 3] / roots.T_CH[0, :, :3, 3]
    np.testing.assert_allclose(ratio, height / tall, rtol=0.01)
    # As the body model has it, for other programs: as tall, at nearly the same joints.
    plain = people.in_model(used, body, found.shape[0])
    assert before.template + before.slope @ plain == pytest.approx(height, abs=0.005)
    at = np.asarray(rest_joints(used, found.shape[0]))
    near = np.asarray(rest_joints(body, plain))
    error = np.linalg.norm((at - at[0]) - (near - near[0]), axis=1)
    assert error.mean() < 0.03


def test_others_keep_their_size_beside_a_child(body):
    used = people.with_size_axis(body)
    roots = somebody(used)
    both = people.PersonState(
        *(np.concatenate([np.asarray(x)] * 2) for x in dataclasses.astuple(roots))
    )
    found = people.with_statures(both, {1: Measured(1.1, 0.02)}, used, np.ones(2))
    assert found.shape[0, -1] == 0 and found.shape[1, -1] < -20
    np.testing.assert_array_equal(found.T_CH[0], roots.T_CH[0])


@pytest.mark.parametrize("sized", [False, True])
def test_the_estimate_without_a_stature_is_the_one_that_never_had_it(body, sized):
    """The posterior of Gaussian factors with and without the fact, both in full."""
    used = people.with_size_axis(body) if sized else body
    rng = np.random.default_rng(3)
    linear = people.linear_stature(used)
    given, sigma = Measured(1.2 if sized else 1.95, 0.02), 0.4
    before = rng.normal(0, 0.5, 10)
    if sized:
        before[-1] = 0.0
    moved = before + rng.normal(0, 1.0, 10)
    A = rng.normal(0, 1.0, (4, 10))  # what the measurements see of the shape
    data, seen = A.T @ A, A.T @ rng.normal(0, 1.0, 4)
    prior, g = np.eye(10) / sigma**2, linear.slope
    fact = np.outer(g, g) / given.sigma**2
    moment = seen + prior @ moved + g * (given.value - linear.template) / 0.02**2
    covariance = np.linalg.inv(data + prior + fact)
    found = people.stature_without(
        used, given, covariance @ moment, covariance, (moved, sigma), before, 0.0
    )
    own = slice(0, 9) if sized else slice(None)
    alone = np.linalg.inv((data + prior)[own, own])
    shape = alone @ (seen + prior @ before)[own]
    assert found.value == pytest.approx(linear.template + g[own] @ shape, abs=1e-8)
    assert found.sigma == pytest.approx(np.sqrt(g[own] @ alone @ g[own]), rel=1e-8)
    vague = people.stature_without(
        used, given, covariance @ moment, covariance, (moved, sigma), before, 0.2
    )
    assert found.sigma < vague.sigma < 0.25


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.65, 0.8])
def test_a_child_of_a_given_stature_is_as_tall_and_the_path_as_long(share):
    """The world of a walk at a share of its size: no measurement tells it but time."""
    simulated = simulation.simulate(
        Simulation(sequence="M1", family="follow", length=60, noise="low")
    )
    tall = float(np.ptp(simulated.person.skin[:, 1])) * share
    result = pipeline.run(
        simulation.as_sequence(simulated), Config(height=(f"{tall:.3f}±0.02",))
    )
    person = result.summary["people"][0]
    assert person["stature_m"] == pytest.approx(tall, abs=0.03)
    true = simulated.T_WC[:, :3, 3] - simulated.T_WC[:, :3, 3].mean(axis=0)
    path = result.T_WC[:, :3, 3] - result.T_WC[:, :3, 3].mean(axis=0)
    size = np.linalg.norm(path) / np.linalg.norm(true)
    assert size == pytest.approx(share, rel=0.04)
    assert stature(load_body_model(), result.betas[0]) == pytest.approx(tall, abs=0.03)
    (fact,) = [g for g in result.summary["given"] if g["name"] == "given_stature"]
    assert fact["without"] == pytest.approx(tall / share, abs=0.12)
    names = {reason["name"] for reason in result.summary["reasons"]}
    assert "given_stature" in names
    assert ("stature_beyond_body_model" in names) == people.beyond_reach(
        load_body_model(), tall
    )


# Comparison


def a_fact(given, found, sigma=3.0, found_sigma=4.0):
    return Fact("x", "x", "m", given, sigma, found, found_sigma, "why", "what")


def test_two_standard_deviations_are_a_warning_and_three_a_doubt():
    facts = [a_fact(0.0, 9.9), a_fact(0.0, 10.1), a_fact(0.0, -15.1)]
    warnings, reasons = contradictions(facts)
    assert warnings == [facts[1].message] and [r.figure for r in reasons] == [
        pytest.approx(3.02)
    ]
    assert "0 ± 3 m" in warnings[0] and "10 ± 4 m" in warnings[0]
    assert "why" in warnings[0] and reasons[0].advice == "what"
    unknown = [a_fact(0.0, np.nan), a_fact(0.0, 5.0, found_sigma=np.inf)]
    assert contradictions(unknown) == ([], [])
    assert json.loads(json.dumps(unknown[1].to_dict()))["without_sigma"] is None


def walker_input(known=Known(), **of_cameras):
    t = np.arange(T) / FPS
    at = np.zeros((1, T, 72))
    bodies = Bodies(np.ones((1, T), bool), at, np.zeros((1, T, 10)), at[..., :3])
    sequence = Sequence("a", None, t, LENS, bodies=bodies)
    cameras = dataclasses.replace(still_camera(sequence), **of_cameras)
    return known, sequence, cameras, standing_people(sequence)


def compared(known=Known(), up=LEVEL, gait=None, start=None, lens=LENS, **of_cameras):
    known, sequence, cameras, joint = walker_input(known, **of_cameras)
    sequence = dataclasses.replace(sequence, intrinsics=lens)
    if start is not None:
        joint = dataclasses.replace(joint, start=start)
    facts = given_facts(known, sequence, cameras, joint, up, [gait], 0.0)
    warnings, reasons = contradictions(facts)
    return {fact.name for fact in facts}, warnings, [r.name for r in reasons]


@pytest.mark.parametrize("rms, warned, doubted", [(1.2, 0, 0), (2.5, 1, 0), (7, 0, 1)])
def test_a_factor_that_does_not_fit_is_told(rms, warned, doubted):
    own = OwnFactor("Tape", residuals=3, cost=1.5 * rms**2, rms=float(rms))
    joint = dataclasses.replace(walker_input()[3], own_factors=(own,))
    lines, reasons = misfits_of_own_factors(joint)
    assert (len(lines), len(reasons)) == (warned, doubted)
    assert all("Tape" in reason.message for reason in reasons)


def test_nothing_given_is_compared_with_nothing():
    assert compared() == (set(), [], [])


@pytest.mark.parametrize(
    ("focal", "centre", "doubts"),
    [
        (530.0, (318.0, 241.0), []),
        (1050.0, (318.0, 241.0), ["given_focal"]),
        (530.0, (239.0, 320.0), ["given_centre"]),
    ],
)
def test_a_calibration_is_compared_with_that_of_the_tracks(focal, centre, doubts):
    by_tracks = np.array([[focal, 20.0], [centre[0], 10.0], [centre[1], 10.0]])
    names, warnings, found = compared(from_tracks=by_tracks)
    assert names == {"given_focal", "given_centre"} and found == doubts
    assert warnings == []
    guess = dataclasses.replace(LENS, is_guess=True)
    assert compared(from_tracks=by_tracks, lens=guess)[0] == set()
    # A vague focal length that was given is contradicted by less.
    vague = dataclasses.replace(LENS, focal_sigma=500.0)
    assert "given_focal" not in compared(from_tracks=by_tracks, lens=vague)[2]


def test_a_frame_rate_is_compared_with_steps():
    usual = Gait(1.9, 0.85, 0.85)  # of steps as long as usual at that rate
    right = 1.9 * np.sqrt(0.85 / 9.81) * 1.7
    usual = dataclasses.replace(usual, step=float(right))
    assert compared(Known(fps=30.0), gait=usual)[1:] == ([], [])
    for factor in (2.0, 0.5):
        other = dataclasses.replace(usual, frequency=1.9 / factor)
        assert compared(Known(fps=30.0), gait=other)[2] == ["given_fps"]
        assert compared(gait=other) == (set(), [], [])  # not given: not judged here
    slower = dataclasses.replace(usual, frequency=1.9 / 1.4)
    names, warnings, reasons = compared(Known(fps=30.0), gait=slower)
    assert len(warnings) == 1 and reasons == [] and "42" in warnings[0]


def test_a_camera_that_was_said_to_stand_still_is_compared_with_the_background():
    still = Known(static_camera=True)
    assert compared(still, wander=0.5)[1:] == ([], [])
    assert len(compared(still, wander=1.5)[1]) == 1
    assert compared(still, wander=40.0)[2] == ["given_static"]


@pytest.mark.parametrize("moves", [False, True])
def test_the_background_of_a_moving_camera_moves(moves):
    rng = np.random.default_rng(0)
    frame, landmark = (x.ravel() for x in np.indices((40, 60)))
    uv = rng.uniform(50, 400, (60, 2))[landmark] + rng.normal(0, 0.4, (2400, 2))
    uv[:, 0] += moves * 0.5 * frame
    motion = sfm.background_motion(Tracks(frame, landmark, uv), LENS)
    assert (motion > 10) == moves and motion > 0


def test_a_path_in_metres_is_compared_with_steps_and_ground():
    start = ScaleStart(2.1, 0.2, 2.05, 0.1, 2.0, 0.02)
    assert compared(start=start)[1:] == ([], [])
    in_feet = dataclasses.replace(start, path=2.0 / 0.3048, path_error=0.06)
    assert compared(start=in_feet)[2] == ["given_path"]
    alone = ScaleStart(path=2.0, path_error=0.02)
    assert compared(start=alone)[0] == set()


@pytest.mark.parametrize("tilt", [0.0, 40.0])
def test_gravity_is_compared_with_up_without_it(tilt):
    """Two people who walk upright before a level camera."""
    t = np.arange(90)
    T_WC = np.tile(np.eye(4), (90, 1, 1))
    T_WH = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (2, 90, 1, 1))
    T_WH[..., 0, 3] = t / 30
    T_WH[0, :, 2, 3], T_WH[1, :, 2, 3] = 4.0, 6.0
    feet = np.repeat(T_WH[..., None, :3, 3], 2, axis=2) + [0.0, 1.0, 0.0]
    gravity = Rotation.from_euler("x", tilt, degrees=True).apply([0.0, 1.0, 0.0])
    present = np.ones((2, 90), bool)
    _, up = level(
        T_WC,
        T_WH[..., :3, 1],
        feet,
        present,
        np.zeros((0, 3)),
        FPS,
        np.zeros(2, bool),
        tuple(gravity),
    )
    assert np.degrees(up.unaided) == pytest.approx(tilt, abs=3)
    walks = Gait(1.9, 0.8, 0.85)
    found = compared(Known(gravity=tuple(gravity)), up=up, gait=walks)
    assert found[2] == (["given_gravity"] if tilt else [])
    # Who does not walk may lie, which is what gravity is given for.
    assert compared(Known(gravity=tuple(gravity)), up=up)[0] == set()


@pytest.mark.slow
def test_the_tracks_tell_a_calibration_that_is_wrong():
    tracks, _ = scene("orbit", num=24)
    for factor, right in ((1.0, True), (0.75, False)):
        lens = dataclasses.replace(
            CAMERA, params=CAMERA.params * [factor, factor, 1, 1]
        )
        given = Sequence("a", None, np.arange(24) / 30, lens, tracks=tracks)
        cameras = sfm_stage.estimate(given, tracks, Config())
        assert cameras.from_tracks is not None
        apart = np.abs(cameras.from_tracks[:, 0] - CAMERA.params[[0, 2, 3]])
        assert (apart < 3 * cameras.from_tracks[:, 1]).all()
        # It is held all the same: what is given is used.
        np.testing.assert_array_equal(cameras.intrinsics[:2], lens.params[:2])
        facts = given_facts(
            Known(), given, cameras, walker_input()[3], LEVEL, [None], 0.0
        )
        doubted = [reason.name for reason in contradictions(facts)[1]]
        assert ("given_focal" in doubted) != right


# Files


def read(tmp_path, camera, size=(640, 480)):
    uv = np.random.default_rng(0).uniform(0.02, 0.98, (2000, 2)) * size
    frame, landmark = (x.ravel() for x in np.indices((20, 100)))
    np.savez(tmp_path / "tracks.npz", frame=frame, landmark=landmark, uv=uv)
    plain = {"model": "PINHOLE", "width": size[0], "height": size[1], "fps": 30.0}
    (tmp_path / "camera.json").write_text(json.dumps(plain | camera))
    return io.read_sequence(tmp_path)


@pytest.mark.parametrize(
    ("model", "params", "size"),
    [
        ("PINHOLE", [525, 525, 239.5, 319.5], (640, 480)),
        ("PINHOLE", [1400, 1400, 961.0, 538.0], (1080, 1920)),
        ("SIMPLE_RADIAL", [525, 236.0, 322.0, 0.01], (640, 480)),
        ("OPENCV", [800, 801, 362.0, 637.0, 0.1, 0, 0, 0], (1280, 720)),
    ],
)
def test_exchanged_coordinates_of_the_principal_point_are_put_back(
    tmp_path, model, params, size
):
    found = read(tmp_path, {"model": model, "params": params}, size)
    at = 1 if model == "SIMPLE_RADIAL" else 2
    assert found.intrinsics.params[2:4].tolist() == params[at : at + 2][::-1]
    (text,) = found.warnings
    assert "camera.json" in text and "cx and cy exchanged" in text


@pytest.mark.parametrize(
    ("camera", "text"),
    [
        (
            {"params": [0.82, 1.094, 0.5, 0.5]},
            r"units of the image.* 525 525 319.5 239",
        ),
        (
            {"model": "SIMPLE_RADIAL", "params": [0.82, 0.5, 0.5, 0.0]},
            "units of the image",
        ),
        ({"params": [26, 26, 319.5, 239.5]}, "171 degrees: is it in mm.* 462 px"),
        ({"params": [4.2, 4.2, 319.5, 239.5]}, "in mm"),
        ({"params": [525, 525, 0.5, 0.5]}, r"\(0.5, 0.5\) px is the corner"),
        ({"params": [525, 525, 0, 0]}, "relative to the middle"),
        ({"params": [1050, 1050, 639.5, 479.5]}, "image of 1280x960 px.* 525 525 px"),
        ({"params": [260, 260, 159.5, 119.5]}, "image of 320x240 px.* 520 520 px"),
        ({"params": [1500, 1500, 959.5, 539.5]}, "middle of an image of 1920x1080"),
        ({"params": [525, 600, 239.5, 319.5]}, r"fx and fy \(525, 600\) differ"),
        ({"params": [90000, 90000, 319.5, 239.5]}, "view of 0.41 degrees"),
        (
            {"params": [525, 525, 319.5, 239.5], "width": 480, "height": 640},
            "exchanged",
        ),
    ],
)
def test_a_calibration_that_is_of_no_such_image_is_refused_by_name(
    tmp_path, camera, text
):
    with pytest.raises(ValueError, match=text) as error:
        read(tmp_path, camera)
    assert "camera" in str(error.value) and "\n" not in str(error.value)


def from_the_corner(path, numbers):
    """COLMAP's or nerfstudio's file of a camera, read: they count pixels from the
    corner of the image, half a pixel before the centre of the first."""
    keys = ("w", "h", "fl_x", "fl_y", "cx", "cy")
    data = dict(zip(keys, [640, 480, *numbers], strict=True)) | {"frames": []}
    text = f"1 PINHOLE 640 480 {' '.join(map(str, numbers))}\n"
    path.write_text(text if path.suffix == ".txt" else json.dumps(data))
    return read_camera(path, (640, 480))[0]


@pytest.mark.parametrize("name", ["cameras.txt", "transforms.json"])
def test_exchanged_coordinates_that_count_from_the_corner_are_put_back(tmp_path, name):
    said: list[str] = []
    camera = from_the_corner(tmp_path / name, [525, 525, 240, 320])
    found = recognised(name, camera, said.append)
    assert found.params[2:4].tolist() == [319.5, 239.5]
    assert len(said) == 1 and "cx and cy exchanged" in said[0]


@pytest.mark.parametrize("name", ["cameras.txt", "transforms.json"])
def test_units_of_the_image_that_count_from_the_corner_are_told(tmp_path, name):
    camera = from_the_corner(tmp_path / name, [0.8203, 1.09375, 0.5, 0.5])
    with pytest.raises(ValueError, match=r"units of the image.* 525 525 319.5 239.5"):
        recognised(name, camera, lambda text: None)


@pytest.mark.parametrize("centre", [(319.5, 239.5), (331.0, 228.0), (420.0, 290.0)])
def test_other_principal_points_are_kept(centre):
    lens = dataclasses.replace(LENS, params=np.array([525.0, 525.0, *centre]))
    said: list[str] = []
    assert recognised("a file", lens, said.append) is lens
    assert len(said) == (centre[0] == 420) and all("cropped" in text for text in said)


def test_a_focal_length_in_mm_is_refused(tmp_path):
    read(tmp_path, {"params": [525, 525, 319.5, 239.5]})
    with pytest.raises(ValueError, match="focal: focal length 26 px .*mm"):
        io.read_sequence(tmp_path, known=Known(focal="26"))


# What is claimed


def seen_by_a_tripod(direction, pitch=0.0):
    """A walk of a metre across the view (0) or along it (1), y up."""
    T_WC = np.tile(np.diag([-1.0, -1.0, 1.0, 1.0]), (T, 1, 1))
    R = Rotation.from_rotvec([pitch, 0, 0]).as_matrix()
    T_WC[:, :3, :3] = R @ T_WC[:, :3, :3]
    joints = np.zeros((1, T, 24, 3))
    joints[..., 2] = 5.0
    joints[..., 1] = -5.0 * np.tan(pitch)
    joints[0, :, :, 2 * direction] += np.linspace(-0.5, 0.5, T)[:, None]
    return Result(
        timestamps=np.arange(T) / FPS,
        T_WC=T_WC,
        scale=1.0,
        intrinsics=LENS.params,
        landmarks=np.zeros((0, 3)),
        poses=np.zeros((1, T, 72)),
        trans=np.zeros((1, T, 3)),
        betas=np.zeros((1, 10)),
        joints=joints,
        present=np.ones((1, T), bool),
    )


@pytest.mark.parametrize("direction", [0, 1])
def test_what_follows_from_a_guessed_focal_length_is_no_better_known(direction):
    known, sequence, cameras, _ = walker_input()
    guess = dataclasses.replace(LENS, is_guess=True)
    guessed = dataclasses.replace(sequence, intrinsics=guess)
    structure, walk = Config().structure, seen_by_a_tripod(direction, pitch=0.3)
    found = accuracy(guessed, cameras, walk, LEVEL, [0.012], structure)
    assert found.across == 0.012 and found.along == pytest.approx(0.2, abs=0.001)
    expected = found.along if direction else found.across
    assert found.people[0].speed == pytest.approx(expected, rel=0.15, abs=0.01)
    assert found.up == pytest.approx(0.2 * np.sin(0.3) * np.cos(0.3), rel=0.05)
    (text,) = guess_warning(guessed, cameras, found)
    assert "--focal" in text and "± 20 %" in text and "± 1 %" in text
    calibrated = accuracy(sequence, cameras, walk, LEVEL, [0.012], structure)
    assert calibrated.along == 0.012 and calibrated.up == LEVEL.sigma
    assert guess_warning(sequence, cameras, calibrated) == []
    refined = dataclasses.replace(cameras, focal_sigma=0.06 * 525)
    path = accuracy(guessed, refined, walk, LEVEL, [0.012], structure)
    assert path.focal == pytest.approx(0.06)
    assert (
        "estimated from the camera's path" in guess_warning(guessed, refined, path)[0]
    )
    given = dataclasses.replace(guess, is_guess=False, focal_sigma=0.02 * 525)
    given_ = dataclasses.replace(sequence, intrinsics=given)
    assert accuracy(
        given_, cameras, walk, LEVEL, [0.012], structure
    ).focal == pytest.approx(0.02)
