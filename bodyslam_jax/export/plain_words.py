"""Words the reasons to doubt a result without technical terms."""

from collections.abc import Mapping
from typing import Any

_PERSON_SENTENCES = {
    "standing_foot_speed": "The feet of {who} slide over the ground while they stand.",
    "gliding": "{Who} glides: the foot that should stand moves along.",
    "step_short_of_reach": "{Who} steps, but hardly advances.",
    "step_beyond_reach": "{Who} advances further with each step than legs can reach.",
    "step_beyond_reach_of_runner": (
        "{Who} advances further with each step than a runner does."
    ),
    "quick_steps": "{Who} takes steps as quickly as only children do.",
    "turned_from_body": "{Who} is tilted against the bodies that were given.",
    "feet_off_ground": "{Who} floats above the ground, or sinks into it.",
    "ground_slope": "{Who} rises or sinks along the path, as on a steep slope.",
    "knee": "{Who} walks with knees bent as nobody's are.",
    "straighter_knee": "{Who} walks without ever stretching a knee.",
    "hip_over_ankle": "{Who} walks as if crouching.",
    "trunk_lean": "{Who} leans over more than people who walk do.",
    "turn_of_walker": "{Who} turns around faster than people who walk can.",
    "turn": "{Who} turns around faster than people can.",
    "velocity_jump_of_walker": "{Who} changes speed faster than people who walk can.",
    "velocity_jump": "{Who} changes speed faster than people can.",
    "joint_acceleration": "{Who} trembles or jerks.",
    "speed": "{Who} is faster than people can be.",
    "stature": "{Who} is too tall for a person.",
    "short_stature": "{Who} is too short for an adult.",
    "keypoint_misfit": "The body of {who} is away from the person in the images.",
    "legs_inferred": (
        "The legs of {who} are hidden or out of the image for a while; what is shown "
        "there is a guess."
    ),
    "seen_in_pieces": "{Who} is seen in short pieces only, which do not fit together.",
    "appears_within": (
        "{Who} appears in front of or behind somebody else: the two may be exchanged, "
        "or be one."
    ),
    "speed_across_gap": (
        "{Who} is gone for a moment and back too far away to be the same person."
    ),
    "given_stature": "{Who} looks taller or shorter than the stature that was given.",
    "given_fps": (
        "{Who} takes steps more slowly or quickly than people do at the frame rate "
        "that was given."
    ),
    "stature_beyond_body_model": (
        "{Who} is smaller or taller than the body model can be, and has an adult's "
        "proportions."
    ),
    "leg_in_image": "{Who} is too small in the video to be measured.",
    "speed_error": "{Who} is too far away, for too short a time, to be measured.",
}
_WHOLE_SENTENCES = {
    "floors_apart": "People stand at different heights, as if on different floors.",
    "up_against_trunks": "The ground is tilted against the people on it.",
    "up_in_image": "The scene is tilted against the images.",
    "slope_of_ground": "The ground slopes against the people on it.",
    "camera_speed": "The camera moves faster than somebody can carry it.",
    "camera_acceleration": "The camera's way jerks more than a hand can.",
    "camera_turning": "The camera turns faster than a hand can turn it.",
    "given_focal": "The images contradict the focal length that was given.",
    "given_centre": "The images contradict the camera's centre that was given.",
    "given_gravity": "People and ground contradict the gravity that was given.",
    "given_static": "The camera was said to stand still, but the background moves.",
    "given_path": "People's sizes contradict the camera's path that was given.",
    "own_factor": "Everything else contradicts a factor that was added.",
    "input_contradicts_itself": "The files that were given contradict each other.",
    "scale_sigma": "All sizes and distances are hardly known.",
    "scale_cues_apart": (
        "People's steps and the ground they stand on disagree about the size of the "
        "scene."
    ),
    "ground_under_feet": "People do not stand on the ground of the map.",
    "height_over_ground": (
        "People climb, and how high over the ground they are is hardly known; nor is "
        "the size of the scene."
    ),
    "not_finite": "The computation failed.",
    "camera_motion": "It was not found how the camera moved.",
    "people": "Nobody was found in the video, so sizes are unknown.",
    "frames_used": "Only a part of the video could be used.",
    "scale_sign": "People move against the direction that they walk in.",
    "scale_unknown": "Nothing in the video tells how large the scene is.",
}


def in_plain_words(reason: Mapping[str, Any], num_people: int = 1) -> str:
    """Returns a sentence for an entry of `reasons` in `summary.json`; its own message
    if there is no plainer one."""
    name = str(reason.get("name"))
    if name in _WHOLE_SENTENCES:
        return _WHOLE_SENTENCES[name]
    if name not in _PERSON_SENTENCES:
        return str(reason.get("message", name))
    number = reason.get("person")
    who = "the person" if number is None or num_people < 2 else f"person {number}"
    return _PERSON_SENTENCES[name].format(who=who, Who=who[0].upper() + who[1:])
