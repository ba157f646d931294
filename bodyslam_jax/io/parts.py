"""Finds the files of a folder that are the parts of a sequence; no file is opened."""

import dataclasses
from pathlib import Path

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.video import VIDEO_SUFFIXES, list_images

_OVERLAYS = ("overlay.webm", "overlay.mp4")
"""Videos that a run writes, possibly into its own input folder."""


@dataclasses.dataclass(frozen=True)
class Parts:
    """Paths of the parts of a sequence; `None` for each that is absent."""

    name: str
    footage: Path | None = None
    """Video file or folder of images."""
    keypoints: Path | None = None
    bodies: Path | None = None
    camera: Path | None = None
    tracks: Path | None = None
    masks: Path | None = None
    groundtruth: Path | None = None


def find_parts(path: Path) -> Parts:
    """Returns the parts of a sequence folder; or a lone video file or folder of images.

    **Raises:** `InputError` if `path` does not exist, or holds several videos of which
    none is called `video`.
    """
    if not path.exists():
        raise InputError(f"{path}: no such file or folder.")
    if path.is_file():
        return Parts(name=path.stem, footage=path)
    within = lambda name: path / name if (path / name).exists() else None
    return Parts(
        name=path.resolve().name,
        footage=within("video.mp4") or within("images") or _other_footage(path),
        keypoints=within("keypoints") or within("keypoints.npz"),
        bodies=within("bodies.npz"),
        camera=within("camera.json"),
        tracks=within("tracks.npz"),
        masks=within("masks") or within("masks.npz"),
        groundtruth=within("groundtruth"),
    )


def _other_footage(folder: Path) -> Path | None:
    """Returns a video under another name, or the folder itself if images lie in it."""
    videos = sorted(
        file
        for file in folder.iterdir()
        if file.suffix.lower() in VIDEO_SUFFIXES
        and file.name not in _OVERLAYS
        and not file.name.startswith(".")
        and file.is_file()
    )
    candidates = [file for file in videos if file.stem == "video"] or videos
    if len(candidates) > 1:
        names = ", ".join(file.name for file in candidates[:4])
        raise InputError(f"{folder}: which video? {names}; give the file itself.")
    if candidates:
        return candidates[0]
    return folder if list_images(folder) else None
