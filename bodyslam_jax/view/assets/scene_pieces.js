"use strict";
// Lines, marks and texts that a scene is made of, and how a person is drawn by status.

// Share of white in a body's colour, its opacity, and the dashes of the path, m.
const LOOKS = {
  doubtful: { white: 0.62, opacity: 1, dash: [0.16, 0.12] },
  not_measurable: { white: 0.7, opacity: 0.4, dash: [0.04, 0.1] },
};
const OK = { white: 0.35, opacity: 1, dash: null };
const PALE = 0.85; // Share of white in the colour of a limb that was hidden.

function lookOf(person) {
  return LOOKS[person.status] ?? OK;
}

function mix(a, b, share) {
  return new THREE.Color(a).lerp(new THREE.Color(b), share);
}

// `dash`: metres that are drawn and left out; without it one line.
function fatLines(points, color, width, opacity, dash = null) {
  const geometry = new THREE.LineSegmentsGeometry();
  geometry.setPositions(points);
  const material = new THREE.LineMaterial({
    color: new THREE.Color(color).getHex(), linewidth: width, transparent: opacity < 1,
    opacity, dashed: !!dash, dashSize: dash?.[0] ?? 1, gapSize: dash?.[1] ?? 1,
  });
  const lines = new THREE.LineSegments2(geometry, material);
  if (dash) lines.computeLineDistances();
  lines.frustumCulled = false;
  return lines;
}

function flat(geometry, color, opacity) {
  const material = new THREE.MeshBasicMaterial({
    color, transparent: true, opacity, side: THREE.DoubleSide, depthWrite: false,
  });
  const mesh = new THREE.Mesh(geometry, material);
  mesh.rotation.x = -Math.PI / 2;
  return mesh;
}

function disc(radius, color, opacity) {
  return flat(new THREE.CircleGeometry(radius, 32), color, opacity);
}

function ring(radius, color) {
  return flat(new THREE.RingGeometry(0.8 * radius, radius, 32), color, 0.8);
}

// A text that faces the viewer, of the same size on the screen at any distance.
function label(text, color) {
  const canvas = document.createElement("canvas");
  const height = 64, font = "600 40px system-ui, sans-serif";
  let pen = canvas.getContext("2d");
  pen.font = font;
  canvas.width = Math.ceil(pen.measureText(text).width) + 24;
  canvas.height = height;
  pen = canvas.getContext("2d"); // A new size clears the canvas and its font.
  pen.font = font;
  pen.textBaseline = "middle";
  pen.lineWidth = 9;
  pen.lineJoin = "round";
  pen.strokeStyle = "rgba(255, 255, 255, .85)";
  pen.strokeText(text, 12, height / 2);
  pen.fillStyle = `#${mix(color, "#000000", 0.25).getHexString()}`;
  pen.fillText(text, 12, height / 2);
  const texture = new THREE.CanvasTexture(canvas);
  texture.colorSpace = THREE.SRGBColorSpace;
  const sprite = new THREE.Sprite(new THREE.SpriteMaterial({
    map: texture, sizeAttenuation: false, depthTest: false, transparent: true,
  }));
  sprite.userData.aspect = canvas.width / height; // The view sets the size.
  sprite.renderOrder = 10;
  return sprite;
}
