"""MMPose: the predictions of its inferencer, one entry per frame."""

import numpy as np

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.declared import as_whole
from bodyslam_jax.io.declared_size import size_in
from bodyslam_jax.io.formats import Source
from bodyslam_jax.io.keypoints.keypoint_format import (
    KeypointFormat,
    Listed,
    detector_in,
    has,
    part_names,
    person_in,
    points_of,
)


class MMPose(KeypointFormat):
    """`instance_info`, for each frame a list of `instances`."""

    name = "MMPose"

    def recognises(self, source: Source) -> bool:
        return has(source.content, "instance_info")

    def read(self, source: Source, num_frames: int | None) -> Listed:
        path, data = source.path, source.content
        rows, names = [], []
        try:
            for i, info in enumerate(data["instance_info"]):
                frame = as_whole(path, "frame_id", info.get("frame_id", i))
                names.append(str(frame))
                for person in info["instances"]:
                    xy = points_of(path, person["keypoints"])
                    score = points_of(path, person["keypoint_scores"])
                    if xy.shape != (len(score), 2):
                        raise InputError(
                            f"{path}: {xy.shape} keypoints, {len(score)} scores."
                        )
                    points = np.concatenate([xy, score[:, None]], axis=-1)
                    rows.append((names[-1], points, person_in(person, "track_id")))
        except (KeyError, TypeError, AttributeError) as error:
            raise InputError(f"{path}: incomplete MMPose result ({error!r}).") from None
        return Listed(
            rows,
            names,
            parts=part_names(data),
            size=size_in(path, data),
            detector=detector_in(data),
        )
