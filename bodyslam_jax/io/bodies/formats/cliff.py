"""CLIFF's results -> rows for the frames of a video."""

import numpy as np

from bodyslam_jax.io.bodies.body_format import BodyFormat, diagonal
from bodyslam_jax.io.bodies.parts import (
    Rows,
    Video,
    betas_of,
    frames_of,
    frames_of_images,
    middle,
    numbers_of,
    pose_of,
    refocused,
    tell_apart,
)
from bodyslam_jax.io.formats import Source
from bodyslam_jax.io.frame_index import InvalidContent
from bodyslam_jax.types import Intrinsics


class Cliff(BodyFormat):
    """CLIFF: full-image translation for its own focal length, image names.

    Its bodies have no identities: people are tracked here, and those detected in a few
    frames only are left out.
    """

    name = "CLIFF"
    layout = ("pose", "shape", "global_t")

    def focal(self, camera: Intrinsics) -> float:
        """Returns the diagonal (`estimate_focal_length`, `common/utils.py`), where the
        file has no `focal_l`."""
        return diagonal(camera)

    def read(self, source: Source, video: Video) -> Rows:
        data = source.content
        poses = pose_of(data)
        n = len(poses)
        if "imgname" in data:
            names = [str(name) for name in np.ravel(data["imgname"])]
            image = _image_of_each(data, n, len(names))
            frame = frames_of_images(names, video, complete=image is not None)
            if image is not None:
                frame = frame[image]
        else:
            frame = frames_of(data, "frame", n, video.num_frames)
        trans = numbers_of(data, "global_t", (n, 3))
        if "focal_l" in data:
            focal = np.broadcast_to(np.ravel(numbers_of(data, "focal_l", None)), (n,))
            trans = refocused(trans, focal, middle(video.camera), video.camera)
        else:
            trans = self.refocused(trans, video)
        person = tell_apart(frame, trans, video)
        _, which, count = np.unique(person, return_inverse=True, return_counts=True)
        least = video.frames_in(video.config.min_duration)
        keep = count[which] >= min(least, count.max(initial=0))
        if len(count) > 1:
            video.warn(
                "bodies without identities: "
                f"{len(np.unique(person[keep]))} people tracked by position, "
                f"{int((~keep).sum())} bodies left out."
            )
        betas = betas_of(data, "shape", n)
        return Rows(frame[keep], person[keep], poses[keep], betas[keep], trans[keep])


def _image_of_each(data: dict, n: int, images: int) -> np.ndarray | None:
    """Returns the image of each of `n` bodies, if images are named once: the first
    column of `detection_all`. `None` if each body has an image name of its own."""
    if "detection_all" in data:
        rows = numbers_of(data, "detection_all", None)
        image = rows.reshape(len(rows), -1)[:, 0] if rows.size else np.zeros(0)
        within = (image >= 0) & (image < images) & (image == np.round(image))
        if len(image) == n and within.all():
            return image.astype(np.int64)
    if images != n:
        raise InvalidContent(f"{images} image names for {n} bodies")
    return None
