"""Makes `bodyslam_jax/view/assets/three.js` from three.js of the npm registry.

Needs npm and a connection; run once per version:

    python tools/make_viewer_library.py

esbuild bundles what the viewer uses (the list below) into one minified script without
imports, so that `scene.html` opens from a file.
"""

import subprocess
import tempfile
from pathlib import Path

THREE, ESBUILD = "0.180.0", "0.25.10"
TARGET = Path(__file__).parents[1] / "bodyslam_jax" / "view" / "assets" / "three.js"
ENTRY = """
export {
  Bone, BufferAttribute, BufferGeometry, CanvasTexture, CircleGeometry, Color,
  DirectionalLight, DoubleSide, Group, HemisphereLight, LinearFilter,
  Matrix4, Mesh, MeshBasicMaterial, MeshLambertMaterial,
  PerspectiveCamera, PlaneGeometry, Points, PointsMaterial, Quaternion, RingGeometry,
  Scene, Skeleton, SkinnedMesh, Sprite, SpriteMaterial, SRGBColorSpace, Texture,
  Vector3, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
export { LineMaterial } from "three/examples/jsm/lines/LineMaterial.js";
export { LineSegments2 } from "three/examples/jsm/lines/LineSegments2.js";
export { LineSegmentsGeometry } from "three/examples/jsm/lines/LineSegmentsGeometry.js";
"""


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        run = lambda *words: subprocess.run(words, cwd=folder, check=True)
        run("npm", "init", "-y")
        run("npm", "install", f"three@{THREE}", f"esbuild@{ESBUILD}")
        (Path(folder) / "entry.js").write_text(ENTRY)
        options = ("--bundle", "--minify", "--format=iife", "--global-name=THREE")
        target = f"--outfile={TARGET}"
        run("npx", "esbuild", "entry.js", *options, "--legal-comments=none", target)
        # The licence asks for its text in all copies, so also in each `scene.html`.
        notice = (Path(folder) / "node_modules" / "three" / "LICENSE").read_text()
        TARGET.write_text(f"/*! three.js {THREE}\n\n{notice}*/\n{TARGET.read_text()}")


if __name__ == "__main__":
    main()
