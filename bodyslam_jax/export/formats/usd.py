"""Writes USD (UsdSkel, UsdGeom): skinned animated bodies, camera, map and ground.

It needs the extra `usd`. Time codes count frames at the video's mean rate, so that time
code divided by `timeCodesPerSecond` is the time from the first frame.
"""

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np

from bodyslam_jax.body import JOINT_NAMES, PARENTS
from bodyslam_jax.export.formats.glb import (
    OPENGL_FROM_OPENCV,
    color_of,
    quaternions,
    strongest,
)
from bodyslam_jax.export.formats.scene import (
    GROUND_GREY,
    GROUND_OPACITY,
    MAP_GREY,
    Scene,
)

_APERTURE_WIDTH = 36.0
"""Width of the film back, tenths of a world unit; only its ratio to the focal length
matters here."""


def is_installed() -> bool:
    """Returns whether usd-core is installed."""
    return importlib.util.find_spec("pxr") is not None


def write(path: Path, scene: Scene) -> None:
    """Writes one stage; `path` is a `.usdc` (binary), `.usda` (text) or `.usd`."""
    from pxr import Usd, UsdGeom, Vt  # pyright: ignore

    scene = scene.with_held_poses()
    rate = scene.result.fps
    codes = scene.seconds * rate
    stage: Any = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(
        stage, UsdGeom.Tokens.z if scene.up == "z" else UsdGeom.Tokens.y
    )
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(rate)
    stage.SetFramesPerSecond(rate)
    stage.SetStartTimeCode(float(codes[0]))
    stage.SetEndTimeCode(float(codes[-1]))
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    for h in range(len(scene.people)):
        _add_person(stage, scene, h, codes)
    _add_camera(stage, scene, codes)
    vectors = lambda x: Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(x, np.float32))
    if len(scene.result.landmarks):
        points = UsdGeom.Points.Define(stage, "/World/map")
        points.CreatePointsAttr(vectors(scene.result.landmarks))
        points.CreateWidthsAttr([0.02])
        points.SetWidthsInterpolation("constant")
        points.CreateDisplayColorAttr([3 * (MAP_GREY,)])
    if scene.ground is not None:
        ground = UsdGeom.Mesh.Define(stage, "/World/ground")
        ground.CreatePointsAttr(vectors(scene.ground))
        ground.CreateFaceVertexCountsAttr([4])
        ground.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
        ground.CreateSubdivisionSchemeAttr("none")
        ground.CreateDisplayColorAttr([3 * (GROUND_GREY,)])
        ground.CreateDisplayOpacityAttr([GROUND_OPACITY])
    stage.GetRootLayer().Save()


def _add_person(stage: Any, scene: Scene, h: int, codes: np.ndarray) -> None:
    from pxr import Gf, Sdf, UsdGeom, UsdSkel, Vt  # pyright: ignore

    result = scene.result
    root = f"/World/person_{scene.people[h]}"
    group = UsdSkel.Root.Define(stage, root)
    skeleton = UsdSkel.Skeleton.Define(stage, f"{root}/skeleton")
    names = [_path_of(k) for k in range(24)]
    rest = scene.rest[h]
    local = scene.offsets[h].copy()
    local[0] = rest[0]
    moved = lambda x: Gf.Matrix4d(1).SetTranslate(Gf.Vec3d(*x.tolist()))
    skeleton.CreateJointsAttr(names)
    skeleton.CreateBindTransformsAttr([moved(x) for x in rest])
    skeleton.CreateRestTransformsAttr([moved(x) for x in local])
    motion = UsdSkel.Animation.Define(stage, f"{root}/skeleton/motion")
    motion.CreateJointsAttr(names)
    motion.CreateScalesAttr([Gf.Vec3h(1, 1, 1)] * 24)
    turns = result.poses[h].reshape(-1, 24, 3)
    quaternion = np.stack([quaternions(turns[:, k]) for k in range(24)], axis=1)
    places, rotations = motion.CreateTranslationsAttr(), motion.CreateRotationsAttr()
    for k, code in enumerate(codes.tolist()):
        local[0] = scene.pelvis[h, k]
        places.Set(Vt.Vec3fArray.FromNumpy(local.astype(np.float32)), code)
        turn = [Gf.Quatf(w, x, y, z) for x, y, z, w in quaternion[k].tolist()]
        rotations.Set(Vt.QuatfArray(turn), code)
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets(
        [Sdf.Path(f"{root}/skeleton/motion")]
    )
    faces = np.asarray(scene.body.faces)
    mesh = UsdGeom.Mesh.Define(stage, f"{root}/body")
    skin = scene.vertices(h).astype(np.float32)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(skin))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray([3] * len(faces)))
    mesh.CreateFaceVertexIndicesAttr(
        Vt.IntArray.FromNumpy(np.ascontiguousarray(faces.reshape(-1), np.int32))
    )
    mesh.CreateSubdivisionSchemeAttr("none")
    mesh.CreateDisplayColorAttr([color_of(scene.people[h])])
    joint, weight = strongest(scene, np.asarray(scene.body.skin_joint).shape[1])
    width = joint.shape[1]
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateJointIndicesPrimvar(False, width).Set(
        Vt.IntArray.FromNumpy(np.ascontiguousarray(joint.reshape(-1), np.int32))
    )
    binding.CreateJointWeightsPrimvar(False, width).Set(
        Vt.FloatArray.FromNumpy(np.ascontiguousarray(weight.reshape(-1), np.float32))
    )
    binding.CreateGeomBindTransformAttr(Gf.Matrix4d(1))
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    if not result.present[h].all():
        visible = UsdGeom.Imageable(group.GetPrim()).CreateVisibilityAttr()
        for code, there in zip(codes.tolist(), result.present[h], strict=True):
            visible.Set("inherited" if there else "invisible", code)


def _add_camera(stage: Any, scene: Scene, codes: np.ndarray) -> None:
    from pxr import Gf, UsdGeom  # pyright: ignore

    result, (width, height) = scene.result, scene.size
    fx, fy, cx, cy = result.intrinsics[:4].tolist()
    camera = UsdGeom.Camera.Define(stage, "/World/camera")
    focal = _APERTURE_WIDTH * fx / width
    tall = focal * height / fy
    camera.CreateHorizontalApertureAttr(_APERTURE_WIDTH)
    camera.CreateVerticalApertureAttr(tall)
    # The film back is shifted by the offset of the principal point.
    camera.CreateHorizontalApertureOffsetAttr(
        _APERTURE_WIDTH * (0.5 - (cx + 0.5) / width)
    )
    camera.CreateVerticalApertureOffsetAttr(tall * ((cy + 0.5) / height - 0.5))
    camera.CreateClippingRangeAttr(Gf.Vec2f(0.01, 1000.0))
    length = camera.CreateFocalLengthAttr(focal)
    pose = camera.AddTransformOp()
    zooms = bool(np.ptp(scene.focal_factor) > 0)
    for k in np.flatnonzero(result.located):
        matrix = np.eye(4)
        matrix[:3, :3] = (
            result.T_WC[k, :3, :3] @ OPENGL_FROM_OPENCV
        ).T  # rows are axes
        matrix[3, :3] = result.T_WC[k, :3, 3]
        pose.Set(Gf.Matrix4d(matrix.tolist()), float(codes[k]))
        if zooms:
            length.Set(focal * float(scene.focal_factor[k]), float(codes[k]))


def _path_of(joint: int) -> str:
    """Returns a joint with its ancestors, such as `pelvis/left_hip/left_knee`."""
    name = JOINT_NAMES[joint]
    return name if joint == 0 else f"{_path_of(PARENTS[joint])}/{name}"
