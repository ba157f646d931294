"use strict";
// The canvas: ground, light, and the viewer's own camera.

const MARGIN = 1.5; // m, of ground around everybody
const LABEL = 24; // px, of a name's height
const SHARE = 0.88; // of the canvas that everybody's way may fill
const LEAST = 0.4; // of the canvas's width or height that a free part of it has
const REACH = 0.6; // m, from a person's pelvis to the side

class View {
  // `boxes`: elements at the canvas's edges that cover a part of it.
  constructor(canvas, runs, boxes) {
    this.canvas = canvas;
    this.runs = runs;
    this.boxes = boxes;
    this.part = { x: 0, y: 0 }; // of the canvas, whose middle is the middle of the view
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.scene = new THREE.Scene();
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0x9a9a90, 2.0));
    const sun = new THREE.DirectionalLight(0xffffff, 1.6);
    sun.position.set(-2, 5, -3);
    this.scene.add(sun);
    for (const run of runs) this.scene.add(run.root);
    this.measure();
    for (const run of runs) run.aside.copy(this.along);
    this.ground = this.makeGround();
    this.scene.add(this.ground);
    this.camera = new THREE.PerspectiveCamera(45, 1, 0.03, 2000);
    this.controls = new THREE.OrbitControls(this.camera, canvas);
    this.controls.listenToKeyEvents(canvas);
    this.controls.addEventListener("change", () => this.draw());
    this.mode = "free";
    this.recolor();
    const dark = window.matchMedia("(prefers-color-scheme: dark)");
    dark.addEventListener("change", () => this.recolor());
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.resize();
  }

  // Extent of everybody's way on the ground, and the direction it mostly has.
  measure() {
    const shown = this.runs.filter((run) => !run.data.hidden);
    const places = shown.flatMap((run) => run.places());
    if (!places.length) places.push([0, 0, 0]);
    const range = (a) => {
      const all = places.map((p) => p[a]).sort((x, y) => x - y);
      return [all[0], all[all.length - 1]];
    };
    this.range = [range(0), range(1), range(2)];
    const middle = this.range.map(([low, high]) => (low + high) / 2);
    this.middle = new THREE.Vector3(middle[0], Math.max(middle[1] * 0.7, 0.5), middle[2]);
    let xx = 0, xz = 0, zz = 0;
    for (const [x, , z] of places) {
      xx += (x - middle[0]) ** 2;
      xz += (x - middle[0]) * (z - middle[2]);
      zz += (z - middle[2]) ** 2;
    }
    const angle = 0.5 * Math.atan2(2 * xz, xx - zz);
    this.along = new THREE.Vector3(Math.cos(angle), 0, Math.sin(angle));
    // The viewer is on the camera's side of the people, who go to the right.
    this.across = new THREE.Vector3(-this.along.z, 0, this.along.x);
    const [run] = this.runs, first = run.people.find((p) => p.present.includes(1));
    if (!first) return;
    const mean = (points, present) => {
      const sum = new THREE.Vector3(), at = new THREE.Vector3();
      present.forEach((there, k) => there && sum.add(at.fromArray(points, 3 * k)));
      return sum.divideScalar(present.reduce((n, there) => n + there, 0) || 1);
    };
    const towards = mean(run.position, run.located).sub(mean(first.pelvis, first.present));
    if (towards.dot(this.across) < 0) {
      this.across.negate();
      this.along.negate();
    }
  }

  makeGround() {
    const group = new THREE.Group();
    const [x0, x1] = this.range[0], [z0, z1] = this.range[2];
    const length = Math.max(x1 - x0, z1 - z0);
    this.step = [1, 2, 5, 10, 20, 50, 100].find((s) => length / s <= 60) ?? length / 60;
    const cells = ([low, high]) => [
      Math.floor((low - MARGIN) / this.step), Math.ceil((high + MARGIN) / this.step),
    ];
    const [a, b] = cells([x0, x1]), [c, d] = cells([z0, z1]), s = this.step;
    this.plane = flat(new THREE.PlaneGeometry((b - a) * s, (d - c) * s), "#fff", 1);
    const plane = this.plane;
    plane.position.set(((a + b) * s) / 2, -LIFT, ((c + d) * s) / 2);
    plane.renderOrder = -2;
    const thin = [], strong = [];
    for (let i = a; i <= b; i++) (i % 5 ? thin : strong).push(i * s, 0, c * s, i * s, 0, d * s);
    for (let j = c; j <= d; j++) (j % 5 ? thin : strong).push(a * s, 0, j * s, b * s, 0, j * s);
    group.add(plane);
    this.paint = [[plane.material, "--plane"]];
    for (const [points, color] of [[thin, "--line"], [strong, "--line-strong"]]) {
      if (!points.length) continue;
      const lines = fatLines(points, "#888", 1, 1);
      group.add(lines);
      this.paint.push([lines.material, color]);
    }
    return group;
  }

  recolor() {
    const css = getComputedStyle(document.documentElement);
    const color = (name) => new THREE.Color(css.getPropertyValue(name).trim());
    this.renderer.setClearColor(color("--ground"));
    for (const [material, name] of this.paint) material.color.copy(color(name));
    this.draw();
  }

  resize() {
    const { clientWidth, clientHeight } = this.canvas;
    if (!clientWidth || !clientHeight) return;
    this.renderer.setSize(clientWidth, clientHeight, false);
    this.camera.aspect = clientWidth / clientHeight;
    this.centre();
    if (["start", "side", "above"].includes(this.mode)) this.look(this.mode);
    this.draw();
  }

  // ---- where it is seen from

  // free (as it is), start, side, above, camera (the estimated one), person-0 ...
  look(mode) {
    const was = this.mode;
    this.mode = mode;
    this.controls.enabled = mode !== "camera";
    const across = this.across;
    const directions = {
      start: across.clone().multiplyScalar(0.85).addScaledVector(this.along, 0.45)
        .add(new THREE.Vector3(0, 0.5, 0)),
      side: across.clone().add(new THREE.Vector3(0, 0.06, 0)),
      above: new THREE.Vector3(0, 1, 0).addScaledVector(across, 1e-3),
    };
    if (was === "camera" && mode !== "camera") this.leaveCamera();
    if (directions[mode]) this.place(this.middle, directions[mode]);
    const followed = this.followed();
    if (followed) {
      const at = this.centreOf(followed);
      if (at) {
        const offset = this.camera.position.clone().sub(this.controls.target);
        offset.setLength(Math.min(Math.max(offset.length(), 2.5), 5));
        this.controls.target.copy(at);
        this.camera.position.copy(at).add(offset);
      }
    }
    const inside = mode === "camera";
    this.plane.visible = !inside;
    for (const run of this.runs) run.seenFromInside(inside);
    this.follow();
    this.draw();
  }

  // Parts of the canvas that no box covers: between the boxes, below all of them, and
  // below the right one, right of the left one. In clip coordinates, -1 to 1.
  freeParts() {
    const width = Math.max(this.canvas.clientWidth, 1);
    const height = Math.max(this.canvas.clientHeight, 1);
    const [header, panel, footer] = this.boxes.map((box) => box.getBoundingClientRect());
    const left = header.width ? header.right : 0, right = panel.width ? panel.left : width;
    const foot = footer.height ? footer.top : height;
    const parts = [
      [left, right, 0, foot], [0, width, Math.max(header.bottom, panel.bottom), foot],
      [left, width, panel.bottom, foot], [0, right, header.bottom, foot],
    ].filter(([a, b, c, d]) => b - a > LEAST * width && d - c > LEAST * height);
    if (!parts.length) parts.push([0, width, 0, foot]);
    return parts.map(([a, b, c, d]) => ({
      x: (a + b) / width - 1, y: 1 - (c + d) / height, w: (b - a) / width, h: (d - c) / height,
    }));
  }

  // Everybody's way is in view from a direction, in the free part where it is largest.
  place(target, direction) {
    const back = direction.clone().normalize();
    const right = new THREE.Vector3(0, 1, 0).cross(back).normalize();
    const up = back.clone().cross(right);
    const half = Math.tan((this.camera.fov * Math.PI) / 360);
    const [xs, ys, zs] = this.range, { aspect } = this.camera;
    const needed = (part) => {
      let distance = 2.5;
      for (const x of xs) for (const z of zs) for (const y of [0, Math.max(ys[1], 1.9)]) {
        const p = new THREE.Vector3(x, y, z).sub(target);
        const aside = (Math.abs(p.dot(right)) + REACH) / (aspect * part.w);
        const high = (Math.abs(p.dot(up)) + 0.3) / part.h;
        distance = Math.max(distance, Math.max(aside, high) / (half * SHARE) + p.dot(back));
      }
      return distance;
    };
    const parts = this.freeParts().map((part) => [needed(part), part]);
    const [distance, part] = parts.reduce((a, b) => (b[0] < a[0] ? b : a));
    this.part = part;
    this.centre();
    this.controls.target.copy(target);
    this.camera.position.copy(this.controls.target).addScaledVector(back, distance);
    this.controls.update();
  }

  // What the viewer's camera looks at is in the middle of the free part.
  centre() {
    const { clientWidth: w, clientHeight: h } = this.canvas, { x, y } = this.part;
    this.camera.setViewOffset(w, h, (-x * w) / 2, (y * h) / 2, w, h);
  }

  followed() {
    const number = /^person-(\d+)$/.exec(this.mode)?.[1];
    return number === undefined ? null : this.runs[0].people[Number(number)];
  }

  centreOf(p) {
    if (!p.present[this.runs[0].frame]) return null;
    return new THREE.Vector3().fromArray(p.pelvis, 3 * this.runs[0].frame);
  }

  // After a change of time: the view moves with whom it follows.
  follow() {
    if (this.mode === "camera") return this.asCamera();
    const followed = this.followed(), at = followed && this.centreOf(followed);
    if (!at) return;
    this.camera.position.add(at.clone().sub(this.controls.target));
    this.controls.target.copy(at);
    this.controls.update();
  }

  // The estimated camera's own view: its image fills the canvas as far as it fits.
  asCamera() {
    const run = this.runs[0], near = 0.05, { left, right, top, bottom } = run.edges;
    const turned = new THREE.Quaternion(1, 0, 0, 0); // From OpenCV's axes.
    this.camera.position.copy(run.eye.position);
    this.camera.quaternion.copy(run.eye.quaternion).multiply(turned);
    this.camera.updateMatrixWorld();
    const wide = right - left, high = bottom - top, aspect = this.canvas.clientWidth
      / Math.max(this.canvas.clientHeight, 1);
    const grow = [Math.max(1, (high * aspect) / wide), Math.max(1, wide / aspect / high)];
    const x = (left + right) / 2, y = -(top + bottom) / 2;
    this.camera.projectionMatrix.makePerspective(
      near * (x - (wide / 2) * grow[0]), near * (x + (wide / 2) * grow[0]),
      near * (y + (high / 2) * grow[1]), near * (y - (high / 2) * grow[1]), near, 2000,
    );
    this.camera.projectionMatrixInverse.copy(this.camera.projectionMatrix).invert();
  }

  leaveCamera() {
    this.camera.updateProjectionMatrix();
    this.place(this.middle, this.across.clone().add(new THREE.Vector3(0, 0.5, 0)));
  }

  // ---- drawing

  sizeLabels() {
    const high = 2 / this.camera.projectionMatrix.elements[5]; // of the view at depth 1
    const { clientWidth, clientHeight } = this.canvas;
    const size = (LABEL * high) / Math.max(clientHeight, 1);
    for (const label of this.runs.flatMap((run) => run.labels)) {
      label.scale.set(size * label.userData.aspect, size, 1);
    }
    this.spreadNames(clientWidth / 2, clientHeight / 2);
  }

  // Names that would cover one another are moved up.
  spreadNames(halfWidth, halfHeight) {
    this.camera.updateMatrixWorld();
    const names = this.runs[0].layers.names?.children.filter((name) => name.visible) ?? [];
    const at = names.map((name) => name.position.clone().project(this.camera));
    const order = names.map((_, i) => i).filter((i) => Math.abs(at[i].z) < 1);
    order.sort((i, j) => at[i].y - at[j].y || i - j);
    const taken = [];
    for (const i of order) {
      const x = at[i].x * halfWidth, aside = (LABEL * names[i].userData.aspect) / 2;
      const start = at[i].y * halfHeight;
      let y = start;
      for (const other of taken) { // From the lowest on.
        if (Math.abs(other.x - x) < other.aside + aside && Math.abs(other.y - y) < LABEL) {
          y = other.y + LABEL;
        }
      }
      names[i].center.set(0.5, 0.5 - (y - start) / LABEL);
      taken.push({ x, y, aside });
      taken.sort((a, b) => a.y - b.y);
    }
  }

  draw() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      if (this.mode === "camera") this.asCamera();
      this.sizeLabels();
      this.renderer.render(this.scene, this.camera);
    });
  }
}
