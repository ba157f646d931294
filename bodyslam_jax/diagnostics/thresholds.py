"""The table of thresholds of plausible results, with the source of each.

Thresholds of people are from motion capture, cut into pieces of 3 to 5 s, and from
simulated sequences; on both at most 2 % of the pieces are wrongly doubted.
`benchmarks/plausibility.md` has all figures, `tools/plausibility_thresholds.py` makes
them.
"""

from bodyslam_jax.diagnostics.checks import Check

_FIT_ADVICE = (
    "look at the overlay there: if keypoints are not on the person, give better ones; "
    "if they are and the body is not, give the focal length (--focal)"
)
_MOCAP = "motion capture"
_GROUND_ADVICE = (
    "if the ground is not like that, sizes and depths are off: give the focal length "
    "(--focal), or better keypoints where feet are beside the person's in the overlay"
)
_IDENTITY_ADVICE = (
    "look at the overlay there: keypoints may jump from one person to another, or "
    "front and back be confused; give keypoints with track ids, or cut the video there"
)
_CAMERA_ADVICE = (
    "if no vehicle carries the camera, look at the scene there: tracks follow moving "
    "things, or scale is off; give person masks, cut the video there (--start, --end), "
    "or take one with more texture"
)
_CARRIED_ADVICE = (
    "on wheels, on skates, on a moving walkway or carried, a person's motion tells no "
    "size: name the people whose steps do (--person, which leaves the others out), or "
    "take lengths as unknown where there is nobody else. If nothing carries the "
    "person, scale, focal length or frame rate are off"
)
PERSON_CHECKS: tuple[Check, ...] = (
    Check(
        "standing_foot_speed",
        "speed of the lower foot (its toe joint, median)",
        "m/s",
        0.4,
        "positions from frame to frame are not to be trusted: better keypoints, a "
        "known focal length, or a regressor's bodies (--bodies) help",
        source="given; motion capture of people who do not run: median 0.09, 99 % "
        "below 0.36",
    ),
    Check(
        "gliding",
        "speed of the foot that should stand, while the person advances,",
        "% of the person's",
        50.0,
        _CARRIED_ADVICE,
        source=_MOCAP + " of people who advance: at most 19",
    ),
    Check(
        "step_short_of_reach",
        "distance that a step carries the person, over how far it reaches,",
        "",
        0.6,
        "the person steps and hardly advances: on a treadmill or on the spot that is "
        "right, and steps tell no size. Otherwise scale or frame rate are off",
        source=_MOCAP + " of people who stride: at least 0.7",
        below=True,
    ),
    Check(
        "step_beyond_reach",
        "distance that a step carries the person, over how far it reaches,",
        "",
        1.4,
        _CARRIED_ADVICE,
        source=_MOCAP + " of people who walk: at most 1.23",
    ),
    Check(
        "step_beyond_reach_of_runner",
        "distance that a runner's step carries the person, over how far it reaches,",
        "",
        2.2,
        _CARRIED_ADVICE,
        source=_MOCAP + " of people who run: 1.6 to 1.86",
    ),
    Check(
        "quick_steps",
        "number of steps of somebody who walks",
        "a second",
        2.4,
        "children step so quickly: a child's body is given or fitted as an adult's, "
        "and every length is too large by as much; give the stature (--height). For "
        "an adult the frame rate is off",
        source=_MOCAP + " of people who walk: at most 2.22",
    ),
    Check(
        "turned_from_body",
        "angle, alike in all frames, between the person and the body given",
        "degrees",
        15.0,
        "on stairs, escalators and steep slopes people are tilted until they move as "
        "on level ground, and up with them; otherwise the bodies are of another camera",
        source="ten simulated sequences: regressed bodies are off by 2 to 8, with "
        "twice the usual errors by 5 to 17",
    ),
    Check(
        "feet_off_ground",
        "range of heights at which standing feet are, beside a slope",
        "m",
        0.12,
        "the person floats or sinks: " + _GROUND_ADVICE,
        source=_MOCAP + " of people who walk: 99 % below 0.07, on uneven terrain 0.15",
    ),
    Check(
        "ground_slope",
        "slope of the ground under standing feet",
        "degrees",
        6.0,
        "the person rises or sinks along the path: " + _GROUND_ADVICE,
        source=_MOCAP + " of people who walk: at most 5; streets rarely exceed 6",
    ),
    Check(
        "knee",
        "bend of both knees while walking (mean)",
        "degrees",
        52.0,
        "legs are too long for the keypoints, or the fit is wrong: " + _FIT_ADVICE,
        source=_MOCAP + " of people who walk: 98 % below 48, soccer 51",
    ),
    Check(
        "straighter_knee",
        "bend of the straighter knee while walking (mean)",
        "degrees",
        44.0,
        "legs are too long for the keypoints, or the fit is wrong: " + _FIT_ADVICE,
        source=_MOCAP + " of people who walk: 98 % below 40, soccer 43",
    ),
    Check(
        "hip_over_ankle",
        "height of the hips over the ankle, of the leg's length, while walking",
        "",
        0.84,
        "people crouch who do not: " + _FIT_ADVICE,
        source=_MOCAP + " of people who walk: at least 0.85",
        below=True,
    ),
    Check(
        "trunk_lean",
        "lean of the trunk while walking (mean)",
        "degrees",
        18.0,
        "nobody walks so: " + _FIT_ADVICE,
        source=_MOCAP + " of people who walk: below 15, but for basketball (19 and 32)",
    ),
    Check(
        "turn_of_walker",
        "fastest turn of somebody who walks",
        "degrees/s within 0.2 s",
        500.0,
        _IDENTITY_ADVICE,
        source=_MOCAP + " of people who walk: at most 170; dancing on the way 500",
    ),
    Check(
        "turn",
        "fastest turn",
        "degrees/s within 0.2 s",
        600.0,
        _IDENTITY_ADVICE,
        source=_MOCAP + ": at most 500, in a pirouette",
    ),
    Check(
        "velocity_jump_of_walker",
        "greatest change of speed of somebody who walks",
        "m/s within 0.2 s",
        1.8,
        _IDENTITY_ADVICE,
        source=_MOCAP + " of people who walk: at most 1.4",
    ),
    Check(
        "velocity_jump",
        "greatest change of speed",
        "m/s within 0.2 s",
        2.8,
        _IDENTITY_ADVICE,
        source=_MOCAP + ": at most 1.9, in a jump",
    ),
    Check(
        "joint_acceleration",
        "acceleration of joints (median)",
        "m/s²",
        22.0,
        "the person trembles: " + _FIT_ADVICE,
        source=_MOCAP + ": at most 18, in a run",
    ),
    Check(
        "speed",
        "speed (95th percentile)",
        "m/s",
        10.0,
        "nobody runs as fast: the frame rate, the focal length or scale is off",
        source="sprinters reach 10 to 12 m/s",
    ),
    Check(
        "stature",
        "stature",
        "m",
        2.2,
        "the scale, the frame rate or the body model is off",
        source="one adult in a million is taller",
    ),
    Check(
        "short_stature",
        "stature",
        "m",
        0.9,
        "the scale or the body model is off; children younger than three are no "
        "shape of the body model",
        source="adults and children from three years",
        below=True,
    ),
    Check(
        "keypoint_misfit",
        "greatest distance of keypoints from the body, for a third of a second",
        "% of the person's size in the image",
        3.5,
        _IDENTITY_ADVICE,
        source="simulated sequences: at most 2.4, nowhere twice as large as mostly",
    ),
    Check(
        "legs_inferred",
        "share of the frames about which most of the legs are hidden or out of the "
        "image",
        "%",
        15.0,
        "there legs are inferred, not measured, and err by twice as much as usual; a "
        "regressor's bodies guess them, too, and their steps tell no size. Leave these "
        "frames out (--start, --end; `inferred_frames` of the person in summary.json), "
        "or use no legs of them",
        source="a judgement on rendered people: posture errors in stretches with "
        "fewer than 55 % of knees and ankles measured are twice those of "
        "people in full view",
    ),
    Check(
        "seen_in_pieces",
        "share of the frames in pieces of less than a second, with gaps between",
        "%",
        50.0,
        "depths of the pieces do not agree, as little motion ties them: leave these "
        "frames out (--start, --end), or give keypoints of a detector that loses the "
        "person less often",
        source="a judgement: pieces shorter than a second mostly have no "
        "prediction by the motion model, which reads half a second",
    ),
    Check(
        "appears_within",
        "share of the person's region in the image that another person covers where "
        "the person first appears",
        "%",
        50.0,
        "two people may have been exchanged there, or one detected twice: look at the "
        "overlay; give keypoints with track ids, or name only the others (--person)",
        source="twenty rendered sequences: 95 where two people were exchanged, 89 "
        "where one was detected twice, else nobody appears so",
    ),
    Check(
        "speed_across_gap",
        "speed across a gap in which the person is not seen",
        "m/s",
        10.0,
        _IDENTITY_ADVICE,
        source="sprinters reach 10 to 12 m/s",
    ),
)
MEASURABLE_CHECKS: tuple[Check, ...] = (
    Check(
        "leg_in_image",
        "length of a leg in the image",
        "px",
        30.0,
        "people so small cannot be measured: a video of higher resolution, or from "
        "nearer by, or name only the others (--person)",
        source="detectors err by a pixel at least, which at this size is as much "
        "as their error on the body, 28 mm; rendered people of 15 to 27 px "
        "have twice the error of large ones",
        below=True,
    ),
    Check(
        "speed_error",
        "standard error of the speed, by noise of the depth,",
        "% of a walker's",
        20.0,
        "people so far away, seen so briefly, have no speed that could be measured: a "
        "longer clip, from nearer by, or name only the others (--person)",
        source="that of all lengths (`scale_sigma`)",
    ),
)
WORLD_CHECKS: tuple[Check, ...] = (
    Check(
        "floors_apart",
        "difference between the heights at which people stand",
        "m",
        0.18,
        "if they do not stand on different floors, sizes of people are off: check the "
        "focal length, or give their bodies (--bodies)",
        source="a judgement: a step or kerb is lower. True people of five simulated "
        "sequences are within 0.01; estimates from pixels of six rendered "
        "sequences with two people within 0.04, but for one: 0.19, a person 0.1 m off",
    ),
    Check(
        "up_against_trunks",
        "angle between up, as the ground tells it, and people's trunks",
        "degrees",
        7.5,
        "gravity and ground contradict the people: if the ground is not a hill, "
        "postures or focal length are off",
        source="ten simulated sequences: 0.7 to 5",
    ),
    Check(
        "lean_of_walkers",
        "angle between up and the mean line from supporting feet to the centre of mass "
        "of people who walk",
        "degrees",
        8.0,
        "people who lean so fall: up is wrong, or bodies lean along the view, which "
        "images hardly show; give the focal length (--focal), up (--gravity), or "
        "bodies (--bodies)",
        source="equilibrium: the centre of mass is at 0.55 of the stature and at most "
        "half of a foot, 0.152 of it long (Drillis and Contini, 1966), from the middle "
        "of the foot, 7.9; " + _MOCAP + " of people who walk: at most 6.5",
    ),
    Check(
        "up_in_image",
        "angle between up, as trunks of people who do not walk tell it, and the top of "
        "the image",
        "degrees",
        60.0,
        "people who lie, hang or stand on their hands are taken for upright, and the "
        "world is turned by as much, unless the video is turned or the camera looks "
        "straight down: turn the video, or use results in the camera's frame only",
        source="six simulated cameras: 6 to 13",
    ),
    Check(
        "slope_of_ground",
        "slope of the ground against people's trunks",
        "degrees",
        6.0,
        "gravity and ground contradict the people: if the ground is not a hill, "
        "postures or focal length are off",
        source="streets rarely exceed 6",
    ),
    Check(
        "camera_speed",
        "speed of the camera (95th percentile)",
        "m/s",
        10.0,
        _CAMERA_ADVICE,
        source="nobody runs as fast; simulated cameras at most 2.6",
    ),
    Check(
        "camera_acceleration",
        "acceleration of the camera over 0.1 s (greatest)",
        "m/s²",
        30.0,
        _CAMERA_ADVICE,
        source="simulated hand-held cameras: at most 7",
    ),
    Check(
        "camera_turning",
        "turning of the camera over 0.1 s (fastest)",
        "degrees/s",
        600.0,
        _CAMERA_ADVICE,
        source="simulated hand-held cameras: at most 70; whipping pans 400",
    ),
    Check(
        "scale_sigma",
        "standard error of all lengths",
        "%",
        20.0,
        "sizes are hardly known: a known focal length, more steps of legs in view, the "
        "ground in view, or a camera path in metres help; so do a regressor's bodies "
        "(--bodies) of people whose legs are in view",
        source="people differ by 5 to 6 %",
    ),
    Check(
        "scale_cues_apart",
        "factor between the sizes that people's motion and the ground tell",
        "",
        1.25,
        "look at the overlay: if bodies are larger than the people in the images, or "
        "their knees bent too much, give the focal length (--focal) or bodies "
        "(--bodies); if soles are not on the floor that the scene shows, people stand "
        "on something else than the map's ground; else check the frame rate (--fps)",
        source="estimates of 13 simulated sequences with bodies, 80 to 240 frames:"
        " at most 1.09; of 40 frames, or without bodies, up to 1.42, within"
        " their errors",
    ),
    Check(
        "ground_under_feet",
        "factor between the size of the map and that of the people on its ground",
        "",
        1.4,
        "people do not stand on the ground of the map: scale, postures or focal "
        "length are off, or they stand on something else",
        source="estimates of nine simulated sequences: within 1.02; the limit is a"
        " judgement",
    ),
    Check(
        "height_over_ground",
        "standard error of all lengths by the heights at which people stand over the "
        "ground of the map",
        "%",
        10.0,
        "people stand at different heights, as on a ladder, steps or a hill, and the "
        "size of the map follows from the lowest of them: somebody who stands on "
        "the ground or walks, or a camera path in metres, help",
        "a judgement: half of the limit of `scale_sigma`, as it rests on one "
        "assumption; without such heights 3 at eye level",
    ),
)
