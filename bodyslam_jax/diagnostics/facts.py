"""Comparison of what a user gave with the estimate that was made without it.

A fact is a measurement with a standard deviation, and so is the estimate that the rest
of the input gives. Where they are apart by more than two combined standard deviations
there is a warning with both figures, and beyond three the result is doubtful: one of
the two is wrong, and which one cannot be told from here.

| fact | the estimate without it |
|---|---|
| stature | the posterior less the fact (`people.stature_without`) |
| focal length, principal point | self-calibration from the tracks |
| gravity | trunks, ground and edges (`ground.gravity`) |
| static camera | motion of the background's points |
| camera path in metres | people's steps and the ground under their feet |
| frame rate | the walk ratio of people's gait |

Bodies are compared with keypoints before anything is estimated
(`diagnostics.agreement`), and a camera path with the tracks by structure from motion.
"""

import dataclasses
from collections.abc import Sequence as Many
from typing import Any

import numpy as np

from bodyslam_jax.config import FOCAL_SIGMA, GRAVITY_SIGMA, Known
from bodyslam_jax.diagnostics.checks import Reason
from bodyslam_jax.diagnostics.gait import WALK_RATIO_SPREAD, Gait
from bodyslam_jax.ground.gravity import Upright
from bodyslam_jax.types import JointEstimate, Sequence, SfmResult

WARNING_SIGMAS, DOUBT_SIGMAS = 2.0, 3.0
"""Distance in combined standard deviations from which a warning, and a doubt, is
raised: by chance in 5 % and in 0.3 % of correct facts."""
CENTRE_SIGMA = 0.01
"""Standard deviation of a calibrated principal point, as a share of the image's longer
side: displacement by focus, temperature and a stabiliser's crop. Assumed."""
STILL_CAMERA_SIGMA_PX = 0.6
"""Standard deviation of the apparent motion of a static background due to tracking
errors, px at an image width of 640 px: the limit below which structure from motion
classifies a camera as static."""
_REFERENCE_WIDTH_PX = 640.0
"""Image width of the figure above; errors of tracking grow with the image."""


@dataclasses.dataclass(frozen=True)
class Fact:
    """A given quantity with its standard deviation, and its estimate made without
    it."""

    name: str
    """Name of the reason that it may become (`Reason.name`)."""
    what: str
    """The quantity as a noun phrase."""
    unit: str
    given: float
    given_sigma: float
    found: float
    found_sigma: float
    why: str
    """Likely reasons for a difference."""
    advice: str
    digits: int = 0
    person: int | None = None
    words: str = ""
    """Text with both values, if other than the default "... was given as ...; without
    it ... would be found"."""

    @property
    def sigmas(self) -> float:
        """Distance in combined standard deviations; 0 if either value is unknown."""
        sigma = np.hypot(self.given_sigma, self.found_sigma)
        apart = abs(self.given - self.found)
        return float(apart / sigma) if np.isfinite(apart) and sigma < np.inf else 0.0

    @property
    def message(self) -> str:
        """Sentence with both values, their distance and the likely reason."""
        places = f".{self.digits}f"
        figure = lambda x, s: f"{x:{places}} ± {s:{places}}" if s else f"{x:{places}}"
        unit = self.unit and f" {self.unit}"
        whose = "" if self.person is None else f"person {self.person}: "
        words = self.words or (
            f"{self.what} was given as {figure(self.given, self.given_sigma)}{unit}; "
            f"without it {figure(self.found, self.found_sigma)}{unit} would be found"
        )
        return (
            f"{whose}{words}, {self.sigmas:.1f} standard deviations away: {self.why}."
        )

    def to_dict(self) -> dict[str, Any]:
        """Returns the entry of `given` in `summary.json`; unknown numbers are
        `None`."""
        known = lambda x: float(x) if np.isfinite(x) else None
        return {
            "name": self.name,
            "unit": self.unit,
            "given": known(self.given),
            "given_sigma": known(self.given_sigma),
            "without": known(self.found),
            "without_sigma": known(self.found_sigma),
            "standard_deviations_apart": self.sigmas,
            **({} if self.person is None else {"person": self.person}),
        }


def contradictions(facts: Many[Fact]) -> tuple[list[str], list[Reason]]:
    """Returns warnings for facts beyond two combined standard deviations from the
    estimate without them, and reasons to doubt the result for those beyond three."""
    warnings, reasons = [], []
    for fact in facts:
        if fact.sigmas > DOUBT_SIGMAS:
            reasons.append(
                Reason(
                    name=fact.name,
                    message=fact.message,
                    expected=f"at most {DOUBT_SIGMAS:g} standard deviations",
                    advice=fact.advice,
                    figure=fact.sigmas,
                    unit="standard deviations",
                    person=fact.person,
                )
            )
        elif fact.sigmas > WARNING_SIGMAS:
            warnings.append(fact.message)
    return warnings, reasons


def misfits_of_own_factors(joint: JointEstimate) -> tuple[list[str], list[Reason]]:
    """Returns warnings for the user's own factors whose residuals exceed two standard
    deviations (rms), and reasons to doubt the result for those beyond three."""
    warnings, reasons = [], []
    for factor in joint.own_factors:
        message = (
            f"the residuals of the factor {factor.name} are {factor.rms:.1f} of its "
            f"standard deviations (rms of {factor.residuals})."
        )
        if factor.rms > DOUBT_SIGMAS:
            reasons.append(
                Reason(
                    name="own_factor",
                    message=message,
                    expected="about 1",
                    advice="check its measurements, their units and frame, and its "
                    "sigmas; everything else contradicts it",
                    figure=factor.rms,
                    unit="standard deviations",
                )
            )
        elif factor.rms > WARNING_SIGMAS:
            warnings.append(message)
    return warnings, reasons


def given_facts(
    known: Known,
    sequence: Sequence,
    cameras: SfmResult,
    joint: JointEstimate,
    up: Upright,
    gaits: Many[Gait | None],
    length_error: float,
) -> list[Fact]:
    """Returns a fact for each given quantity that can be compared with an estimate.

    Args:
        length_error: relative standard error of all lengths; NaN counts as 0.
    """
    return [
        *_statures(joint),
        *_calibration(sequence, cameras),
        *_gravity(known, up, gaits),
        *_standing_camera(known, sequence, cameras),
        *_path(joint),
        *_frame_rate(known, sequence, gaits, length_error),
    ]


def _statures(joint: JointEstimate) -> list[Fact]:
    rows = [] if joint.statures is None else joint.statures
    return [
        Fact(
            name="given_stature",
            what="the stature",
            unit="m",
            given=float(given),
            given_sigma=float(given_sigma),
            found=float(found),
            found_sigma=float(found_sigma),
            why="the stature is somebody else's or in another unit, or bodies, path or "
            "focal length are off; or the person is a child, or much taller or shorter "
            "than most, which images alone do not show",
            advice="check --height and who is person 0, 1, ... in the overlay; for a "
            "child, or somebody unusually tall or short, the size is that of the "
            "stature given, and right if that is",
            digits=2,
            person=h,
        )
        for h, (given, given_sigma, found, found_sigma) in enumerate(rows)
        if np.isfinite(given)
    ]


def _calibration(sequence: Sequence, cameras: SfmResult) -> list[Fact]:
    lens = sequence.intrinsics
    if cameras.from_tracks is None or lens.is_guess:
        return []
    by_tracks = cameras.from_tracks
    given = [lens.params[0], *lens.params[2:4]]
    centre = CENTRE_SIGMA * max(lens.width, lens.height)
    sigma = [lens.focal_sigma or FOCAL_SIGMA * lens.params[0], centre, centre]
    of_file = (
        "the camera file is of another camera, zoom or resolution, or of the video "
        "before it was cropped"
    )
    names = ("given_focal", "given_centre", "given_centre")
    facts = [
        Fact(
            name=name,
            what=what,
            unit="px",
            given=float(value),
            given_sigma=float(error),
            found=float(found),
            found_sigma=float(found_error),
            why=of_file
            if name == "given_centre" or lens.focal_sigma is None
            else "it is of another camera, zoom or resolution",
            advice="check the camera file, or leave it out: the focal length is "
            "estimated then",
        )
        for name, what, value, error, (found, found_error) in zip(
            names,
            (
                "the focal length fx",
                "the principal point's x",
                "the principal point's y",
            ),
            given,
            sigma,
            by_tracks,
            strict=True,
        )
    ]
    # The coordinate with the larger deviation represents both.
    return [facts[0], max(facts[1:], key=lambda fact: fact.sigmas)]


def _gravity(known: Known, up: Upright, gaits: Many[Gait | None]) -> list[Fact]:
    # People who do not walk may lie or hang, which is why gravity is given.
    walking = any(steps is not None for steps in gaits)
    if not known.gravity or not (walking or np.isfinite(up.edges)):
        return []
    away, sigma = np.degrees(up.unaided), np.degrees(up.unaided_sigma)
    return [
        Fact(
            name="given_gravity",
            what="gravity",
            unit="degrees",
            given=0.0,
            given_sigma=float(np.degrees(GRAVITY_SIGMA)),
            found=float(away),
            found_sigma=float(sigma),
            words=f"gravity was given (± {np.degrees(GRAVITY_SIGMA):.1f} degrees) at "
            f"{away:.1f} degrees from where people, ground and edges have it "
            f"(± {sigma:.1f} degrees)",
            why="it is in other axes than the first frame's camera (x right, y "
            "down, z forward), of another moment, or points up",
            advice="check --gravity: 0 1 0 for a level camera",
        )
    ]


def _standing_camera(
    known: Known, sequence: Sequence, cameras: SfmResult
) -> list[Fact]:
    if not known.static_camera:
        return []
    lens = sequence.intrinsics
    sigma = STILL_CAMERA_SIGMA_PX * max(
        max(lens.width, lens.height) / _REFERENCE_WIDTH_PX, 1.0
    )
    return [
        Fact(
            name="given_static",
            what="motion of the background",
            unit="px",
            given=0.0,
            given_sigma=0.0,
            found=cameras.wander,
            found_sigma=sigma,
            words="the camera was said to stand still, but points of the background "
            f"move by {cameras.wander:.1f} px, where errors of tracking make up to "
            f"{sigma:.1f} px",
            why="the camera moves, turns or zooms, or the points are of moving things",
            advice="leave --static-camera out, or give masks of what moves",
        )
    ]


def _path(joint: JointEstimate) -> list[Fact]:
    start = joint.start
    others = dataclasses.replace(start, path=1.0, path_error=float("inf"))
    if not np.isfinite(start.path_error) or not np.isfinite(others.standard_error):
        return []
    return [
        Fact(
            name="given_path",
            what="the length of the camera's path, relative to itself,",
            unit="",
            given=1.0,
            given_sigma=start.path_error / start.path,
            found=others.value / start.path,
            found_sigma=others.standard_error / start.path,
            why="the path is not in metres or of another scale, or people's sizes are "
            "off (children)",
            advice="leave --camera-path-metric out if the path's unit is not the "
            "metre, or give people's statures (--height)",
            digits=2,
        )
    ]


def _frame_rate(
    known: Known,
    sequence: Sequence,
    gaits: Many[Gait | None],
    length_error: float,
) -> list[Fact]:
    if known.fps is None:
        return []
    error = float(np.hypot(WALK_RATIO_SPREAD, np.nan_to_num(length_error) / 2))
    # In logarithms, in which the walk ratio is normal, the distance is log(k) / error.
    slope = lambda k: 1.0 if abs(k - 1) < 1e-6 else (k - 1) / float(np.log(k))
    return [
        Fact(
            name="given_fps",
            what="the frame rate",
            unit="1/s",
            given=sequence.fps,
            given_sigma=0.0,
            found=sequence.fps * steps.slowness,
            found_sigma=sequence.fps * slope(steps.slowness) * error,
            why="it is not the rate at which the video was taken (slow motion, or "
            "frames left out), or the person is no usual walker",
            advice="check --fps: speeds are off in proportion",
            digits=0,
            person=h,
        )
        for h, steps in enumerate(gaits)
        if steps is not None and steps.strides
    ]
