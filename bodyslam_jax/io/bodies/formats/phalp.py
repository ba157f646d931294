"""4D-Humans, which writes the results of PHALP, the tracker in it."""

import numpy as np

from bodyslam_jax.io.bodies.body_format import BodyFormat
from bodyslam_jax.io.bodies.parts import (
    Rows,
    Video,
    as_rotvec,
    frames_of_images,
    middle,
    refocused,
    turn_to_camera,
)
from bodyslam_jax.io.declared_size import factor_to
from bodyslam_jax.io.formats import Source
from bodyslam_jax.io.frame_index import InvalidContent
from bodyslam_jax.types import Intrinsics


class Phalp(BodyFormat):
    """4D-Humans / PHALP: `{image: {...}}`, lists over the people in it, whose rotations
    are relative to the crop's ray."""

    name = "4D-Humans"
    layout = ("smpl", "camera", "bbox", "tid")
    by_entry = True

    def focal(self, camera: Intrinsics) -> float:
        """Returns 5000 px for a crop of 256 px, so 5000/256 of the longer side
        (`EXTRA.FOCAL_LENGTH / MODEL.IMAGE_SIZE * img_size.max()`, `demo.py`)."""
        # HMR2's focal length for its crop of 256 px.
        return 5000 / 256 * max(camera.width, camera.height)

    def read(self, source: Source, video: Video) -> Rows:
        data = source.content
        names = sorted(data)
        # If PHALP decoded a video itself, frames are named by the video and a time.
        called = [
            str(data[n].get("time", n[-1]) if isinstance(n, tuple) else n)
            for n in names
        ]
        numbered = frames_of_images(called, video, complete=True)
        factor = _factor(data, video)
        frame, person, poses, betas, trans, box = [], [], [], [], [], []
        for number, name in zip(numbered, names, strict=True):
            found = data[name]
            since_detection = found.get("tracked_time", [])
            for i, body in enumerate(found["smpl"]):
                if i < len(since_detection) and np.ravel(since_detection[i])[0] != 0:
                    continue  # predicted, not detected
                x, y, w, h = factor * np.ravel(found["bbox"][i])[:4]
                parts = [
                    as_rotvec(np.asarray(body[key]), joints).ravel()
                    for key, joints in (("global_orient", 1), ("body_pose", 23))
                ]
                frame.append(number)
                person.append(int(np.ravel(found["tid"][i])[0]))
                poses.append(np.concatenate(parts))
                betas.append(np.ravel(body["betas"])[:10])
                trans.append(np.ravel(found["camera"][i])[:3])
                box.append((x + w / 2, y + h / 2, max(w, h)))
        if not frame:
            raise InvalidContent("no body in any frame")
        stacked = [np.asarray(a, dtype=np.float64) for a in (poses, betas, trans, box)]
        poses, betas, trans, box = stacked
        focal, center = self.focal(video.camera), middle(video.camera)
        trans = refocused(trans, np.full(len(trans), focal), center, video.camera)
        root = turn_to_camera(poses[:, :3], box, video.camera)
        poses = np.concatenate([root, poses[:, 3:]], axis=-1)
        return Rows(np.asarray(frame), np.asarray(person), poses, betas, trans)


def _factor(data: dict, video: Video) -> float:
    """Returns pixels of the video per pixel of PHALP's images, whose `size` is (h,
    w)."""
    sizes = {
        tuple(np.ravel(size)[:2].tolist())
        for found in data.values()
        for size in found.get("size", [])
    }
    if not sizes:
        return 1.0
    if len(sizes) > 1:
        raise InvalidContent(f"images of several sizes: {sorted(sizes)[:3]}")
    height, width = sizes.pop()
    size = (video.camera.width, video.camera.height)
    declared = (float(width), float(height))
    return factor_to(declared, size, np.zeros((0, 2)), "bodies", video.warn)
