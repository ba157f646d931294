"use strict";
// One run as objects of three.js: camera, images, map, people, ground.
// The world is that of the run: metres, y up. A camera has OpenCV's axes: x right,
// y down, z forward.

const TYPES = {
  float32: Float32Array, int16: Int16Array, uint8: Uint8Array, uint16: Uint16Array,
  uint32: Uint32Array,
};

function bytes(text) {
  return Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
}

function decode(array) {
  return new TYPES[array.type](bytes(array.data).buffer);
}

function floats(array, unit) {
  return Float32Array.from(decode(array), (x) => x / unit);
}

const QUATERNION_UNIT = 32767, SKIN_UNIT = 10000; // as in scene_data.py
const FRUSTUM = 0.5; // m, from the camera to its image
const FAR_IMAGE = 60; // m, to the image that fills the camera's own view
const ROD = 0.6; // m, from a person to the measuring rod beside
const LIFT = 0.006; // m, of what lies on the ground, against flicker

class Run {
  constructor(data, index, style) {
    this.data = data;
    this.ghost = index > 0; // A run to compare with is drawn fainter.
    this.style = style;
    this.times = decode(data.times);
    this.root = new THREE.Group();
    this.layers = {};
    this.labels = [];
    this.lines = []; // Paths, which grow with time.
    this.aside = new THREE.Vector3(1, 0, 0); // Where the measuring rods stand.
    this.addCamera(data.camera);
    this.addImages(data.images);
    if (data.map.points.shape[0]) this.addMap(data.map);
    this.people = data.people.map((person) => this.addPerson(person, data.body));
    if (data.scale_sigma !== null && data.metric) this.addUncertainty(data.scale_sigma);
  }

  layer(name) {
    if (!this.layers[name]) {
      this.layers[name] = new THREE.Group();
      this.root.add(this.layers[name]);
    }
    return this.layers[name];
  }

  // ---- camera

  addCamera(camera) {
    this.position = decode(camera.position);
    this.rotation = floats(camera.rotation, QUATERNION_UNIT);
    this.located = decode(camera.located);
    const [fx, fy] = camera.focal, [cx, cy] = camera.centre, [w, h] = camera.size;
    // The image's edges at depth 1; pixel centres are whole numbers.
    this.edges = {
      left: (-0.5 - cx) / fx, right: (w - 0.5 - cx) / fx,
      top: (-0.5 - cy) / fy, bottom: (h - 0.5 - cy) / fy,
    };
    const { left, right, top, bottom } = this.edges;
    const corners = [[left, top, 1], [right, top, 1], [right, bottom, 1], [left, bottom, 1]];
    const points = [];
    corners.forEach((corner, i) => {
      points.push(0, 0, 0, ...corner, ...corner, ...corners[(i + 1) % 4]);
    });
    this.eye = new THREE.Group();
    this.frustum = fatLines(points, this.style.camera, 2, this.ghost ? 0.5 : 1);
    this.frustum.scale.setScalar(FRUSTUM);
    this.eye.add(this.frustum);
    this.plumb = fatLines([0, 0, 0, 0, -1, 0], this.style.camera, 1, 0.5);
    this.layer("camera").add(this.eye, this.plumb);
    this.layer("camera").add(this.path(this.position, this.located, this.style.camera));
    this.cameraName = this.named("camera", this.style.camera);
  }

  label(text, color) {
    this.labels.push(label(text, color));
    return this.labels.at(-1);
  }

  // A name; a run to compare with has none, as its names would cover the others.
  named(text, color) {
    const name = this.label(text, color);
    if (!this.ghost) this.layer("names").add(name);
    return name;
  }

  // A line through points of frames that follow one another, the future fainter.
  path(points, present, color, y = null, dash = null) {
    const steps = [], ends = [];
    for (let k = 1; k < present.length; k++) {
      if (!present[k] || !present[k - 1]) continue;
      for (const i of [k - 1, k]) {
        steps.push(points[3 * i], y ?? points[3 * i + 1], points[3 * i + 2]);
      }
      ends.push(k);
    }
    const group = new THREE.Group();
    if (!steps.length) return group;
    const whole = fatLines(steps, color, 1.5, 0.3, dash);
    const past = fatLines(steps, color, this.ghost ? 2 : 3, this.ghost ? 0.6 : 1, dash);
    group.add(whole, past);
    this.lines.push({ past, ends });
    return group;
  }

  // ---- images

  addImages(images) {
    this.imageFrames = images.frame;
    this.jpeg = images.jpeg;
    this.shown = -1;
    if (!images.frame.length || this.ghost) return;
    const { left, right, top, bottom } = this.edges;
    const geometry = new THREE.BufferGeometry();
    const corners = [left, top, 1, right, top, 1, right, bottom, 1, left, bottom, 1];
    geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(corners), 3));
    const uv = new Float32Array([0, 1, 1, 1, 1, 0, 0, 0]);
    geometry.setAttribute("uv", new THREE.BufferAttribute(uv, 2));
    geometry.setIndex([0, 1, 2, 0, 2, 3]);
    this.texture = new THREE.CanvasTexture(document.createElement("canvas"));
    this.texture.colorSpace = THREE.SRGBColorSpace;
    this.texture.generateMipmaps = false;
    this.texture.minFilter = THREE.LinearFilter;
    this.image = new THREE.Mesh(geometry, new THREE.MeshBasicMaterial({
      map: this.texture, side: THREE.DoubleSide, transparent: true, opacity: 0.95,
    }));
    this.image.visible = false;
    this.image.frustumCulled = false;
    const holder = new THREE.Group(); // Follows `eye`, but is a layer of its own.
    holder.add(this.image);
    this.imageHolder = holder;
    this.layer("images").add(holder);
  }

  // Decodes the newest image up to a frame; resolves to whether it has changed.
  async showImage(frame) {
    if (!this.image) return false;
    let k = this.imageFrames.findLastIndex((f) => f <= frame);
    k = Math.max(k, 0);
    if (k === this.shown) return false;
    this.shown = k;
    const blob = new Blob([bytes(this.jpeg[k])], { type: "image/jpeg" });
    const bitmap = await createImageBitmap(blob);
    if (k !== this.shown) return false; // Another frame was asked for meanwhile.
    const canvas = this.texture.image;
    if (canvas.width !== bitmap.width || canvas.height !== bitmap.height) {
      canvas.width = bitmap.width;
      canvas.height = bitmap.height;
      this.texture.dispose();
    }
    canvas.getContext("2d").drawImage(bitmap, 0, 0);
    this.texture.needsUpdate = true;
    this.image.visible = true;
    return true;
  }

  // In the camera's own view its image is the background, and bodies let it through.
  seenFromInside(inside) {
    this.frustum.visible = !inside;
    for (const { skin, person } of this.people) {
      const opacity = this.opacity(person) * (inside && !this.ghost ? 0.7 : 1);
      skin.material.opacity = opacity;
      skin.material.transparent = opacity < 1;
      skin.material.needsUpdate = true;
    }
    if (!this.image) return;
    this.image.scale.setScalar(inside ? FAR_IMAGE : FRUSTUM);
    this.image.renderOrder = inside ? -5 : 0;
    const { material } = this.image;
    material.depthTest = material.depthWrite = material.transparent = !inside;
    material.needsUpdate = true;
  }

  // ---- map

  addMap(map) {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(decode(map.points), 3));
    const linear = Float32Array.from(decode(map.colors), (c) => (c / 255) ** 2.2);
    geometry.setAttribute("color", new THREE.BufferAttribute(linear, 3));
    const material = new THREE.PointsMaterial({
      vertexColors: true, size: this.ghost ? 2.5 : 4, sizeAttenuation: false,
      transparent: this.ghost, opacity: this.ghost ? 0.5 : 1,
    });
    this.layer("map").add(new THREE.Points(geometry, material));
  }

  // ---- people

  opacity(person) {
    return this.ghost ? 0.45 : lookOf(person).opacity;
  }

  addPerson(person, body) {
    const present = decode(person.present), pelvis = decode(person.pelvis);
    const bones = body.parents.map(() => new THREE.Bone());
    const rest = decode(person.rest);
    body.parents.forEach((parent, j) => {
      if (parent < 0) return;
      bones[parent].add(bones[j]);
      bones[j].position.set(...[0, 1, 2].map((a) => rest[3 * j + a] - rest[3 * parent + a]));
    });
    const inverses = bones.map((_, j) =>
      new THREE.Matrix4().makeTranslation(-rest[3 * j], -rest[3 * j + 1], -rest[3 * j + 2]));
    const look = lookOf(person), opacity = this.opacity(person);
    const inferred = person.inferred ? decode(person.inferred) : null;
    const color = mix(person.color, "#ffffff", look.white);
    const skin = new THREE.SkinnedMesh(this.skin(person, body), new THREE.MeshLambertMaterial({
      color: inferred ? "#ffffff" : color, vertexColors: !!inferred,
      transparent: opacity < 1, opacity,
    }));
    if (inferred) {
      const colors = new Float32Array(3 * body.joints.shape[0]);
      skin.geometry.setAttribute("color", new THREE.BufferAttribute(colors, 3));
    }
    skin.frustumCulled = false;
    skin.add(bones[0]);
    skin.bind(new THREE.Skeleton(bones, inverses), new THREE.Matrix4());
    this.layer("people").add(skin);
    this.layer("paths").add(this.path(pelvis, present, person.color, LIFT, look.dash));
    const words = person.words ? `, ${person.words}` : "";
    const name = this.named(`person ${person.number}${words}`, person.color);
    const rod = this.rod(person);
    const marks = body.feet.map(() => disc(0.11, person.color, 0.75));
    const prints = person.footprints.map(([frame, x, z]) => {
      const mark = ring(0.075, person.color);
      mark.position.set(x, LIFT, z);
      mark.userData.frame = frame;
      return mark;
    });
    if (person.footprints.length) this.layer("contacts").add(...marks, ...prints);
    return {
      person, present, pelvis, bones, skin, name, rod, marks, prints, inferred, color,
      rotations: floats(person.rotations, QUATERNION_UNIT),
      stands: decode(person.stands), feet: body.feet,
    };
  }

  // Triangles and weights are the same for everybody; the shape is each person's own.
  skin(person, body) {
    const geometry = new THREE.BufferGeometry();
    if (!this.shared) {
      const weights = Float32Array.from(decode(body.weights), (w) => w / 255);
      for (let i = 0; i < weights.length; i += 4) { // Rounded: they must sum to 1.
        const sum = weights[i] + weights[i + 1] + weights[i + 2] + weights[i + 3];
        for (let k = i; k < i + 4; k++) weights[k] /= sum;
      }
      this.shared = {
        faces: new THREE.BufferAttribute(decode(body.faces), 1),
        joints: new THREE.BufferAttribute(decode(body.joints), 4),
        weights: new THREE.BufferAttribute(weights, 4),
      };
    }
    geometry.setIndex(this.shared.faces);
    geometry.setAttribute("skinIndex", this.shared.joints);
    geometry.setAttribute("skinWeight", this.shared.weights);
    geometry.setAttribute("position", new THREE.BufferAttribute(floats(person.skin, SKIN_UNIT), 3));
    geometry.computeVertexNormals();
    return geometry;
  }

  // The colours of a skin whose hidden limbs are pale; `bits` are these bones.
  paint(p, bits) {
    if (p.painted === bits) return;
    p.painted = bits;
    const pale = mix(p.person.color, "#ffffff", PALE);
    const { array: joints } = this.shared.joints, { array: weights } = this.shared.weights;
    const colors = p.skin.geometry.attributes.color, mixed = new THREE.Color();
    for (let v = 0; v < colors.count; v++) {
      let share = 0;
      for (let k = 4 * v; k < 4 * v + 4; k++) if ((bits >> joints[k]) & 1) share += weights[k];
      mixed.lerpColors(p.color, pale, share).toArray(colors.array, 3 * v);
    }
    colors.needsUpdate = true;
  }

  // ---- uncertainty

  // A measuring rod as high as the person, with two standard deviations at its top.
  rod(person) {
    const rod = new THREE.Group();
    const high = person.stature, sigma = person.stature_sigma;
    if (sigma === null || sigma === undefined || person.status === "not_measurable") return rod;
    const ends = [high - 2 * sigma, high + 2 * sigma];
    const points = [0, 0, 0, 0, ends[1], 0];
    for (const y of [...ends, high]) points.push(-0.12, y, 0, 0.12, y, 0);
    rod.add(fatLines(points, person.color, 2, 1));
    const text = this.label(`${(100 * high).toFixed(0)} ± ${(100 * sigma).toFixed(0)} cm`, person.color);
    text.position.y = ends[1] + 0.12;
    rod.add(text);
    this.layer("uncertainty").add(rod);
    return rod;
  }

  // The camera's path and people's, were all lengths two standard deviations shorter
  // or longer, about the place where the first person starts.
  addUncertainty(sigma) {
    const first = this.people.find((p) => p.present.includes(1));
    const at = first ? 3 * first.present.indexOf(1) : 0;
    const centre = first ? [first.pelvis[at], 0, first.pelvis[at + 2]] : [0, 0, 0];
    const paths = [[this.position, this.located, this.style.camera, null]];
    for (const p of this.people) paths.push([p.pelvis, p.present, p.person.color, LIFT]);
    for (const factor of [1 - 2 * sigma, 1 + 2 * sigma]) {
      for (const [points, present, color, y] of paths) {
        const steps = [];
        for (let k = 1; k < present.length; k++) {
          if (!present[k] || !present[k - 1]) continue;
          for (const i of [k - 1, k]) for (const a of [0, 1, 2]) {
            const x = centre[a] + factor * (points[3 * i + a] - centre[a]);
            steps.push(a === 1 && y !== null ? y : x);
          }
        }
        if (steps.length) this.layer("uncertainty").add(fatLines(steps, color, 1.5, 0.8, [0.12, 0.08]));
      }
    }
  }

  // ---- time

  frameAt(seconds) {
    const t = this.times;
    let k = t.findIndex((x) => x >= seconds - 1e-6);
    if (k < 0) k = t.length - 1;
    if (k > 0 && seconds - t[k - 1] < t[k] - seconds) k -= 1;
    return k;
  }

  update(frame) {
    this.frame = frame;
    const at = new THREE.Vector3().fromArray(this.position, 3 * frame);
    const turn = new THREE.Quaternion().fromArray(this.rotation, 4 * frame).normalize();
    this.eye.position.copy(at);
    this.eye.quaternion.copy(turn);
    this.eye.visible = this.plumb.visible = this.cameraName.visible = !!this.located[frame];
    this.plumb.position.copy(at);
    this.plumb.scale.y = Math.max(at.y, 1e-3);
    this.cameraName.position.copy(at).y += 0.2;
    if (this.imageHolder) {
      this.imageHolder.position.copy(at);
      this.imageHolder.quaternion.copy(turn);
      this.imageHolder.visible = !!this.located[frame];
    }
    for (const { past, ends } of this.lines) {
      let shown = ends.findIndex((k) => k > frame);
      if (shown < 0) shown = ends.length;
      past.visible = shown > 0;
      past.geometry.instanceCount = shown;
    }
    for (const p of this.people) this.pose(p, frame);
  }

  pose(p, frame) {
    const there = !!p.present[frame];
    for (const object of [p.skin, p.name, p.rod]) object.visible = there;
    for (const mark of p.prints) mark.visible = mark.userData.frame <= frame;
    for (const mark of p.marks) mark.visible = false;
    if (!there) return;
    if (p.inferred) this.paint(p, p.inferred[frame]);
    p.bones[0].position.fromArray(p.pelvis, 3 * frame);
    p.bones.forEach((bone, j) => {
      bone.quaternion.fromArray(p.rotations, 4 * (24 * frame + j)).normalize();
    });
    p.skin.updateMatrixWorld(true);
    const place = new THREE.Vector3();
    p.feet.forEach((joint, side) => {
      p.marks[side].visible = !!(p.stands[frame] & (1 << side));
      place.setFromMatrixPosition(p.bones[joint].matrixWorld);
      p.marks[side].position.set(place.x, 2 * LIFT, place.z);
    });
    place.setFromMatrixPosition(p.bones[15].matrixWorld); // head
    p.name.position.copy(place).y += 0.35;
    p.rod.position.copy(p.bones[0].position).addScaledVector(this.aside, ROD).y = 0;
  }

  // All places of cameras and people, for the ground and the first view.
  places() {
    const found = [];
    const add = (points, present) => present.forEach((there, k) => {
      if (there) found.push([points[3 * k], points[3 * k + 1], points[3 * k + 2]]);
    });
    add(this.position, this.located);
    for (const p of this.people) add(p.pelvis, p.present);
    return found;
  }
}
