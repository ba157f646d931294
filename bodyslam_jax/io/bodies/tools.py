"""Result files of the tools that regress bodies -> rows in the camera frame.

One function per tool, chosen by the keys in the file; the layouts are those of the
tools' own code. All positions follow one convention, `pelvis = J_0(β) + trans`; for
tools with another one, J_0 is approximated by the pelvis of the mean body (SMPL's or
SMPL-X's). SMPL-X's β have another basis than SMPL's and are left out.

SLAHMR fits shapes to a video, AMASS to markers; those of the other tools are regressed
by a network, also GLAMR's, which optimises trajectories only.
"""

from collections.abc import Callable

import numpy as np

from bodyslam_jax.io.bodies.amass import from_amass, is_amass
from bodyslam_jax.io.bodies.body_records import Rows, Video
from bodyslam_jax.io.bodies.cliff import from_cliff
from bodyslam_jax.io.bodies.parts import (
    PELVIS_SMPL,
    PELVIS_SMPLX,
    InvalidContent,
    as_rotvec,
    at_size,
    betas_of,
    focals,
    frames_of,
    frames_of_images,
    from_crops,
    join,
    middle,
    numbers_of,
    people_of,
    refocused,
)
from bodyslam_jax.io.bodies.perspective import turn_to_camera
from bodyslam_jax.io.bodies.slahmr import from_slahmr, is_slahmr
from bodyslam_jax.io.bodies.tool_focal import DEFAULT_FOCAL, default_focal
from bodyslam_jax.io.declared_size import factor_to


def from_spin(data: dict, video: Video) -> Rows:
    """SPIN: a row per frame; weak perspective in boxes, which SPIN does not write."""
    poses = numbers_of(data, "pose", (-1, 72))
    frame = frames_of(data, "frame", len(poses), video.num_frames)
    if "bbox" not in data:
        raise InvalidContent("`camera` needs `bbox` (m, 3: cx, cy, side px)")
    box, crop = (
        numbers_of(data, "bbox", (len(poses), 3)),
        numbers_of(data, "camera", (len(poses), 3)),
    )
    return from_crops(
        frame,
        people_of(data, len(poses)),
        poses,
        betas_of(data, "betas", len(poses)),
        crop,
        box,
        video.camera,
    )


def from_vibe(data: dict, video: Video) -> Rows:
    """VIBE: `{person: {...}}`, crops as boxes (cx, cy, w, h) with w = h."""
    rows = []
    for number, (_, one) in enumerate(sorted(data.items(), key=lambda kv: str(kv[0]))):
        poses = numbers_of(one, "pose", (-1, 72))
        n = len(poses)
        boxes = numbers_of(one, "bboxes", (n, 4))
        rows.append(
            from_crops(
                frames_of(one, "frame_ids", n, video.num_frames),
                np.full(n, number),
                poses,
                betas_of(one, "betas", n),
                numbers_of(one, "pred_cam", (n, 3)),
                boxes[:, :3],
                video.camera,
            )
        )
    return join(rows)


def from_wham(data: dict, video: Video) -> Rows:
    """WHAM: `{person: {...}}`; `pose` and `trans` are in the camera, whose focal length
    is not in the file; those in a world are named `_world`."""
    rows = []
    focal = default_focal("WHAM", video)
    for number, (_, one) in enumerate(sorted(data.items(), key=lambda kv: str(kv[0]))):
        poses = numbers_of(one, "pose", (-1, 72))
        n = len(poses)
        rows.append(
            Rows(
                frames_of(one, "frame_ids", n, video.num_frames),
                np.full(n, number),
                poses,
                betas_of(one, "betas", n),
                _of_default(numbers_of(one, "trans", (n, 3)), focal, video),
            )
        )
    return join(rows)


def _of_default(trans: np.ndarray, focal: float, video: Video) -> np.ndarray:
    """Positions of bodies that a tool put in a camera of focal length `focal` (px) with
    its principal point in the middle of the image."""
    return refocused(
        trans, np.full(len(trans), focal), middle(video.camera), video.camera
    )


def from_phalp(data: dict, video: Video) -> Rows:
    """4D-Humans / PHALP: `{image: {...}}`, lists over the people in it.

    Its camera has a focal length of 5000/256 of the longer side, and its rotations are
    relative to the crop's ray.
    """
    names = sorted(data)
    # If PHALP decoded a video itself, frames are named by the video and a time.
    called = [
        str(data[n].get("time", n[-1]) if isinstance(n, tuple) else n) for n in names
    ]
    numbered = frames_of_images(called, video, complete=True)
    factor = _phalp_factor(data, video)
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
    trans = _of_default(trans, DEFAULT_FOCAL["4D-Humans"](video.camera), video)
    root = turn_to_camera(poses[:, :3], box, video.camera)
    poses = np.concatenate([root, poses[:, 3:]], axis=-1)
    return Rows(np.asarray(frame), np.asarray(person), poses, betas, trans)


def _phalp_factor(data: dict, video: Video) -> float:
    """Pixels of the video per pixel of PHALP's images, whose `size` is (h, w)."""
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


def from_tram(data: dict, video: Video) -> Rows:
    """TRAM: one `hps_track_k.npy` is one person, with full-image translation."""
    poses = as_rotvec(numbers_of(data, "pred_rotmat", (-1, 24, 3, 3)), 24)
    n = len(poses)
    trans = numbers_of(data, "pred_trans", None).reshape(n, 3)
    if "img_focal" in data:
        focal = np.full(n, float(np.ravel(data["img_focal"])[0]))
        center = np.asarray(
            data.get("img_center", middle(video.camera)), dtype=np.float64
        )
        trans = refocused(trans, focal, center, video.camera)
    else:
        trans = _of_default(trans, default_focal("TRAM", video), video)
    return Rows(
        frames_of(data, "frame", n, video.num_frames),
        np.zeros(n, dtype=np.int64),
        poses.reshape(n, 72),
        betas_of(data, "pred_shape", n),
        trans,
    )


def from_gvhmr(data: dict, video: Video) -> Rows:
    """GVHMR: SMPL-X in the camera of `K_fullimg`, a row per frame."""
    body = data["smpl_params_incam"]
    root = numbers_of(body, "global_orient", (-1, 3))
    n = len(root)
    trans = numbers_of(body, "transl", (n, 3)) + PELVIS_SMPLX - PELVIS_SMPL
    if "K_fullimg" in data:
        K = np.broadcast_to(numbers_of(data, "K_fullimg", None), (n, 3, 3))
        K = at_size(K, video)
        trans = refocused(trans, focals(K), K[:, :2, 2], video.camera)
    else:
        trans = _of_default(trans, default_focal("GVHMR", video), video)
    poses = np.concatenate(
        [root, numbers_of(body, "body_pose", (n, 63)), np.zeros((n, 6))], -1
    )
    frame = frames_of(data, "frame", n, video.num_frames)
    return Rows(frame, np.zeros(n, np.int64), poses, np.zeros((n, 10)), trans)


def from_prompthmr(data: dict, video: Video) -> Rows:
    """PromptHMR: SMPL-X per person, in the camera of `img_focal`, `img_center`."""
    world = data.get("camera_world", data.get("camera", {}))
    rows = []
    for number, (_, one) in enumerate(
        sorted(data["people"].items(), key=lambda kv: str(kv[0]))
    ):
        body = one["smplx_cam"]
        if "pose" in body:
            pose = numbers_of(body, "pose", None)
        else:
            pose = as_rotvec(numbers_of(body, "rotmat", None), None)
        n = len(pose)
        pose = pose.reshape(n, -1)[:, :66]
        if pose.shape[1] != 66:
            raise InvalidContent(f"`pose` of {pose.shape[1]} numbers, not 66 or more")
        trans = numbers_of(body, "trans", (n, 3)) + PELVIS_SMPLX - PELVIS_SMPL
        if "img_focal" in world:
            focal = np.full(n, float(np.ravel(world["img_focal"])[0]))
            center = np.asarray(
                world.get("img_center", middle(video.camera)), np.float64
            )
            trans = refocused(trans, focal, center, video.camera)
        rows.append(
            Rows(
                frames_of(one, "frames", n, video.num_frames),
                np.full(n, number),
                np.concatenate([pose, np.zeros((n, 6))], axis=-1),
                np.zeros((n, 10)),
                trans,
            )
        )
    return join(rows)


def from_glamr(data: dict, video: Video) -> Rows:
    """GLAMR: `root_trans_cam` is the pelvis itself, in the camera of `cam_K`."""
    people = data["person_data"] if "person_data" in data else {0: data}
    rows = []
    for number, (_, one) in enumerate(
        sorted(people.items(), key=lambda kv: str(kv[0]))
    ):
        root = numbers_of(one, "smpl_orient_cam", (-1, 3))
        n = len(root)
        trans = numbers_of(one, "root_trans_cam", (n, 3)) - PELVIS_SMPL
        if "cam_K" in one:
            K = np.broadcast_to(numbers_of(one, "cam_K", None), (n, 3, 3))
            K = at_size(K, video)
            pelvis = refocused(
                trans + PELVIS_SMPL, focals(K), K[:, :2, 2], video.camera
            )
            trans = pelvis - PELVIS_SMPL
        poses = np.concatenate([root, numbers_of(one, "smpl_pose", (n, 69))], axis=-1)
        visible = np.asarray(one.get("visible", np.ones(n))).astype(bool)
        frame = frames_of(one, "frames", n, video.num_frames)
        rows.append(
            Rows(
                frame[visible],
                np.full(int(visible.sum()), number),
                poses[visible],
                betas_of(one, "smpl_beta", n)[visible],
                trans[visible],
            )
        )
    return join(rows)


def _has(*keys: str) -> Callable[[dict], bool]:
    return lambda data: set(keys) <= set(data)


def _each(*keys: str) -> Callable[[dict], bool]:
    def test(data: dict) -> bool:
        people = list(data.values())
        good = [isinstance(p, dict) and set(keys) <= set(p) for p in people]
        return len(good) > 0 and all(good)

    return test


Reader = Callable[[dict, Video], Rows]

READERS: list[tuple[str, Callable[[dict], bool], Reader]] = [
    ("SPIN", _has("pose", "betas", "camera"), from_spin),
    ("CLIFF", _has("pose", "shape", "global_t"), from_cliff),
    ("SLAHMR", is_slahmr, from_slahmr),
    ("GVHMR", _has("smpl_params_incam"), from_gvhmr),
    ("PromptHMR", _has("people"), from_prompthmr),
    ("TRAM", _has("pred_rotmat", "pred_trans", "pred_shape"), from_tram),
    ("GLAMR", _has("person_data"), from_glamr),
    ("GLAMR", _has("smpl_orient_cam", "root_trans_cam", "smpl_pose"), from_glamr),
    ("WHAM", _each("pose", "trans", "betas", "pose_world"), from_wham),
    ("VIBE", _each("pose", "pred_cam", "betas", "bboxes"), from_vibe),
    ("4D-Humans", _each("smpl", "camera", "bbox", "tid"), from_phalp),
    ("AMASS", is_amass, from_amass),
]
"""Name of the tool, test of a file's content, reader."""
