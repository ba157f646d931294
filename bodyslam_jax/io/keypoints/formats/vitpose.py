"""easy_ViTPose: a list of frames, in each the keypoints of people by their number."""

from bodyslam_jax.io.declared_size import size_in
from bodyslam_jax.io.formats import Source
from bodyslam_jax.io.keypoints.keypoint_format import (
    KeypointFormat,
    Listed,
    detector_in,
    part_names,
    person_in,
    triples,
)


class EasyViTPose(KeypointFormat):
    """`keypoints`, for each frame `{person: [[y, x, score], ...]}`.

    The order of the points depends on the model, and is named in `skeleton`.
    """

    name = "easy_ViTPose"

    def recognises(self, source: Source) -> bool:
        data = source.content
        frames = data.get("keypoints") if isinstance(data, dict) else None
        return isinstance(frames, list) and all(isinstance(f, dict) for f in frames)

    def read(self, source: Source, num_frames: int | None) -> Listed:
        path, data = source.path, source.content
        rows = [
            (str(k), triples(path, points), person_in({"id": person}, "id"))
            for k, found in enumerate(data["keypoints"])
            for person, points in found.items()
        ]
        return Listed(
            rows,
            [str(k) for k in range(len(data["keypoints"]))],
            parts=part_names(data),
            row_first=True,
            size=size_in(path, data),
            detector=detector_in(data) or "vitpose",
        )
