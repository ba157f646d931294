"""A camera against experience needs proof: its prior, evidence and the people."""

import dataclasses

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation
from test_frontend_motion import CAMERA, path, scene

from bodyslam_jax.config import Structure
from bodyslam_jax.sfm import find_camera_model
from bodyslam_jax.sfm.bundle import Scene, Views
from bodyslam_jax.sfm.camera_model import DECISIVE_LOG_ODDS, is_decisive, prior_of
from bodyslam_jax.sfm.lens import OTHER_FOCAL_MODEL, Lens, examine_lens
from bodyslam_jax.sfm.sfm import Reconstruction
from bodyslam_jax.sfm.upright_people import plausibility
from bodyslam_jax.types import Keypoints, Tracks

# Bundle adjustment runs for longer than it compiles.
pytestmark = pytest.mark.usefixtures("optimised")

GUESS = dataclasses.replace(CAMERA, is_guess=True)
CENTRE, FOCAL = CAMERA.params[2:4], CAMERA.params[0]


def with_lasting_errors(tracks: Tracks, num: int, seed: int) -> Tracks:
    """Errors of 0.2 px that last for ten frames in each track, and as large ones that
    are common to neighbours in the image."""
    rng = np.random.default_rng(seed)
    lasting = lambda *shape: (
        gaussian_filter1d(rng.normal(size=(num, *shape)), 5.0, axis=0) * 4.2
    )
    own = lasting(int(tracks.landmark.max()) + 1, 2)
    waves, phase = rng.normal(size=(4, 2)) / 60, rng.uniform(0, 6, 4)
    field = lasting(4, 2) / np.sqrt(2)
    wave = np.cos(tracks.uv @ waves.T + phase)
    common = np.einsum("mw,mwi->mi", wave, field[tracks.frame])
    error = own[tracks.frame, tracks.landmark] + common
    return dataclasses.replace(tracks, uv=tracks.uv + 0.2 * error)


def examined(kind: str, seed: int, *, num=60, bend=lambda uv, frame: uv):
    """The cameras compared on tracks with lasting errors, from the true map."""
    tracks, T_WC = scene(kind, num=num, noise=0.2, seed=seed)
    clean, _ = scene(kind, num=num, noise=0.0, outliers=0.0, seed=seed)
    tracks = with_lasting_errors(tracks, num, seed)
    R_CW = np.swapaxes(T_WC[:, :3, :3], 1, 2)
    xy = (clean.uv - CENTRE) / FOCAL
    points = triangulated(R_CW, T_WC[:, :3, 3], clean, xy)
    uv = bend(tracks.uv, tracks.frame)
    often = np.bincount(tracks.landmark)[tracks.landmark] >= 3
    views = Views(tracks.frame, tracks.landmark, (uv - CENTRE) / FOCAL)
    return examine_lens(
        Scene(R_CW, T_WC[:, :3, 3].copy(), points),
        views[np.flatnonzero(often)],
        np.ones(num, bool),
        pixel=1 / FOCAL,
        rows=CAMERA.height / FOCAL,
        prior=prior_of(GUESS, Structure()),
    )


def triangulated(R_CW, centre, tracks, xy):
    """Points nearest to the true rays; 3 m ahead where a track has one view."""
    ray = np.concatenate([xy, np.ones((len(xy), 1))], axis=-1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    ray = np.einsum("mji,mj->mi", R_CW[tracks.frame], ray)
    across = np.eye(3) - ray[:, :, None] * ray[:, None]
    start = centre[tracks.frame]
    num = int(tracks.landmark.max()) + 1
    A, b = np.tile(1e-6 * np.eye(3), (num, 1, 1)), np.zeros((num, 3))
    np.add.at(A, tracks.landmark, across)
    np.add.at(b, tracks.landmark, np.einsum("mij,mj->mi", across, start))
    np.add.at(b, tracks.landmark, 1e-6 * (start + 3 * ray))
    return np.linalg.solve(A, b[..., None])[..., 0]


def of(lenses, *model):
    return next(lens for lens in lenses if lens.model == model)


@pytest.mark.slow
def test_standard_deviations_cover_the_truth_where_errors_are_common_and_last():
    z = []
    for kind in ("sideways", "orbit", "pan", "forward"):
        for seed in range(4):
            lenses = examined(kind, seed)
            aspect, radial = of(lenses, "aspect"), of(lenses, "radial")
            z += [aspect.aspect / aspect.aspect_sigma]
            z += [radial.radial / radial.radial_sigma]
    # 32 figures, partly of one scene: standard deviations right to a factor of 1.6.
    assert 0.6 < np.sqrt(np.mean(np.square(z))) < 1.6
    assert np.abs(z).max() < 5


@pytest.mark.parametrize(
    "kind", ["sideways", pytest.param("forward", marks=pytest.mark.slow)]
)
def test_an_ordinary_film_keeps_its_camera_at_ten_times_the_odds(kind):
    lenses = examined(kind, 1)
    assert len(lenses) >= 4
    for lens in lenses[1:]:
        assert lens.log_odds + len(lens.model) * np.log(10) < DECISIVE_LOG_ODDS


def zoomed(uv, frame):
    return CENTRE + (uv - CENTRE) * 1.4 ** (frame / 59)[:, None]


@pytest.mark.parametrize(
    ("model", "bend"),
    [
        ("aspect", lambda uv, frame: CENTRE + (uv - CENTRE) * [4 / 3, 1.0]),
        pytest.param("zoom", zoomed, marks=pytest.mark.slow),
    ],
)
def test_a_clear_deviation_is_decisive_at_a_tenth_of_the_odds(model, bend):
    lenses = examined("orbit", 2, bend=bend)
    best = max(lenses[1:], key=lambda lens: lens.log_odds)
    assert model in best.model
    assert best.log_odds - len(best.model) * np.log(10) > DECISIVE_LOG_ODDS


@pytest.mark.slow
def test_a_distorted_lens_is_decisive_and_its_standard_deviation_holds():
    def bend(uv, frame):
        q = (uv - CENTRE) / FOCAL
        return CENTRE + FOCAL * q * (1 - 0.2 * (q**2).sum(axis=-1, keepdims=True))

    lenses = examined("orbit", 3, bend=bend)
    best = max(lenses[1:], key=lambda lens: lens.log_odds)
    assert "radial" in best.model and best.log_odds > DECISIVE_LOG_ODDS
    assert abs(best.radial + 0.2) < 4 * best.radial_sigma < 0.1


@pytest.mark.slow
def test_a_rolling_shutter_is_no_stretched_video():
    """A camera that nods reads its rows 0.6 frames late at the bottom."""

    def bend(uv, frame):
        late = 0.6 * (uv[:, 1] / CAMERA.height - 0.5)
        nod = lambda t: 25.0 * np.sin(0.5 * t)
        shift = nod(frame + late) - nod(frame)
        return uv + np.stack([0 * shift, shift], axis=-1)

    lenses = examined("sideways", 4, bend=bend)
    assert all(lens.log_odds < DECISIVE_LOG_ODDS for lens in lenses[1:])


def test_a_deviation_must_beat_all_simpler_cameras_and_not_itself():
    """With a calibration, also that of another focal length."""
    numbers = dict.fromkeys([f.name for f in dataclasses.fields(Lens)][3:], 0.0)
    lens = lambda odds, *model: Lens(
        model, 0.0, odds, **numbers | {"zoom": np.zeros(3)}
    )
    ordinary, other = lens(0.0), lens(20.0, *OTHER_FOCAL_MODEL)
    aspect, radial, both = (
        lens(9.0, "aspect"),
        lens(18.0, "radial"),
        lens(25.0, "aspect", "radial"),
    )
    assert is_decisive(radial, (ordinary, aspect, radial, both))
    assert not is_decisive(radial, (ordinary, other, radial))
    assert is_decisive(both, (ordinary, aspect, radial, both))
    assert not is_decisive(both, (ordinary, lens(24.0, "radial"), both))


def test_a_calibration_is_doubted_less_than_a_guess():
    guess, known = (prior_of(c, Structure()) for c in (GUESS, CAMERA))
    given = prior_of(dataclasses.replace(CAMERA, focal_sigma=13.0), Structure())
    assert known.log_odds(("radial",)) < guess.log_odds(("radial",))
    assert known.focal[0] < given.focal[0] < guess.focal[0]
    assert given.focal[0] == pytest.approx(0.05)
    assert guess.log_odds(("aspect",)) == pytest.approx(np.log(1e-3))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["sideways", "forward", "pan"])
def test_a_short_film_keeps_its_camera(kind):
    tracks, _ = scene(kind, noise=0.2, seed=6)
    tracks = with_lasting_errors(tracks, 60, 6)
    model = find_camera_model(tracks, GUESS, 60, Structure())
    assert model.zoom is None and len(model.intrinsics.params) == 4
    assert model.intrinsics.params[0] == model.intrinsics.params[1]
    assert not any("used" in text for text in model.warnings)


def walker(num=40):
    """A map of a floor and somebody upright who walks over it, seen by `CAMERA`."""
    R, centre = path("sideways", num, np.random.default_rng(0))
    rng = np.random.default_rng(1)
    floor = rng.uniform([-5, 1.5, 2], [6, 1.5001, 10], (300, 3))
    s = np.linspace(0, 1, num)
    feet = np.stack([1 + s, np.full(num, 1.5), 4.5 + 2 * s], axis=-1)
    uv = np.zeros((1, num, 25, 2))
    confidence = np.zeros((1, num, 25))
    for joint, height in ((1, 1.45), (8, 0.95), (11, 0.08), (14, 0.08)):
        p_C = np.einsum("tji,tj->ti", R, feet - [0, height, 0] - centre)
        uv[0, :, joint] = CENTRE + FOCAL * p_C[:, :2] / p_C[:, 2:]
        confidence[0, :, joint] = 1.0
    T = np.tile(np.eye(4), (num, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R, centre
    none = np.zeros(0, np.int64)
    found = Reconstruction(
        "moving", T, np.ones(num, bool), floor, Tracks(none, none, np.zeros((0, 2))),
        np.zeros(0, bool), np.arange(300), np.zeros((300, 3, 3)), 0.3,
    )  # fmt: skip
    return found, Keypoints(uv, confidence)


def tilted(found: Reconstruction, turn: list[float]) -> Reconstruction:
    """The same map with the floor turned below the camera, as a bent map has it."""
    R, below = Rotation.from_rotvec(turn).as_matrix(), np.array([0, 1.5, 5.0])
    floor = (found.landmarks - below) @ R.T + below
    return dataclasses.replace(found, landmarks=floor)


def test_people_who_lean_or_change_in_size_speak_against_a_camera():
    found, people = walker()
    zoom = np.zeros(40)
    upright = plausibility(found, CAMERA, people, zoom)
    assert upright > -0.3
    rolled, pitched = tilted(found, [0, 0, 0.3]), tilted(found, [0.25, 0, 0])
    assert plausibility(rolled, CAMERA, people, zoom) < upright - 3
    assert plausibility(pitched, CAMERA, people, zoom) < upright - 1


def test_nobody_says_nothing_of_a_camera():
    found, _ = walker()
    assert plausibility(found, CAMERA, None, np.zeros(40)) == 0.0
