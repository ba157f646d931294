"""COCO's two kinds of files: annotations, and results, which AlphaPose writes too."""

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.declared_size import size_in
from bodyslam_jax.io.formats import Source
from bodyslam_jax.io.keypoints.keypoint_format import (
    KeypointFormat,
    Listed,
    detector_in,
    has,
    part_names,
    person_in,
    triples,
)


class CocoResults(KeypointFormat):
    """A list with one entry per person: `image_id` and `keypoints`."""

    name = "AlphaPose"

    def recognises(self, source: Source) -> bool:
        data = source.content
        is_list = isinstance(data, list) and len(data) > 0
        return is_list and all(has(e, "image_id", "keypoints") for e in data)

    def read(self, source: Source, num_frames: int | None) -> Listed:
        rows = [
            (
                str(e["image_id"]),
                triples(source.path, e["keypoints"]),
                person_in(e, "idx", "track_id"),
            )
            for e in source.content
        ]
        if all(who == 0 for _, _, who in rows):
            # AlphaPose numbers everybody 0 if it does not track.
            rows = [(name, points, -1) for name, points, _ in rows]
        return Listed(rows, [name for name, _, _ in rows], complete=False)


class CocoAnnotations(KeypointFormat):
    """`images` have numbers and names, of which the name counts."""

    name = "COCO"

    def recognises(self, source: Source) -> bool:
        return has(source.content, "annotations", "images")

    def read(self, source: Source, num_frames: int | None) -> Listed:
        path, data = source.path, source.content
        try:
            name = {i["id"]: str(i.get("file_name", i["id"])) for i in data["images"]}
            rows = [
                (
                    name[a["image_id"]],
                    triples(path, a["keypoints"]),
                    person_in(a, "track_id"),
                )
                for a in data["annotations"]
                if "keypoints" in a
            ]
        except (KeyError, TypeError) as error:
            raise InputError(
                f"{path}: incomplete COCO annotations ({error})."
            ) from None
        return Listed(
            rows,
            list(name.values()),
            parts=part_names(data),
            size=size_in(path, data),
            detector=detector_in(data),
        )
