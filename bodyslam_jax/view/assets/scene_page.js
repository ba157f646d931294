"use strict";
// The page around the canvas: timeline, layers, views. `window.bodyslam` is for
// programs that steer the page.

const LAYERS = {
  people: "People", names: "Names", camera: "Camera", images: "Its images",
  paths: "Paths on the ground", map: "Map", ground: "Grid", contacts: "Standing feet",
  uncertainty: "Uncertainty",
};
const OFF_AT_FIRST = ["uncertainty"];
const ROOMY = 1000; // px, from which on a window has room for open boxes

function start() {
  const element = (id) => document.getElementById(id);
  const data = [...document.querySelectorAll("script.run")].map((e) => JSON.parse(e.textContent));
  const css = getComputedStyle(document.documentElement);
  const style = { camera: css.getPropertyValue("--camera").trim() };
  const runs = data.map((run, i) => new Run(run, i, style));
  const boxes = ["header", "#panel", "footer"].map((box) => document.querySelector(box));
  const view = new View(element("scene"), runs, boxes);
  const times = runs[0].times, last = times.length - 1;
  const state = { frame: 0, playing: false, speed: 1, ready: false };

  const first = data[0], unit = first.metric ? "m" : "units";

  // ---- time

  function show(frame) {
    state.frame = Math.min(Math.max(Math.round(frame), 0), last);
    const seconds = times[state.frame];
    for (const run of runs) run.update(run === runs[0] ? state.frame : run.frameAt(seconds));
    element("time").value = state.frame;
    element("clock").textContent =
      `${seconds.toFixed(2)} s · ${state.frame + 1} of ${last + 1}`;
    view.follow();
    view.draw();
    const asked = state.frame;
    return runs[0].showImage(asked).then((changed) => {
      state.decoded = asked;
      if (changed) view.draw();
    });
  }

  let origin = 0;
  function play(on) {
    state.playing = on && last > 0;
    element("play").setAttribute("aria-pressed", state.playing);
    element("play").setAttribute("aria-label", state.playing ? "Pause" : "Play");
    if (!state.playing) return;
    if (state.frame === last) show(0);
    origin = performance.now() - (1000 * times[state.frame]) / state.speed;
    requestAnimationFrame(tick);
  }
  function tick(now) {
    if (!state.playing) return;
    let seconds = ((now - origin) / 1000) * state.speed;
    if (seconds > times[last] + 0.5) { // A short rest at the end, then again.
      origin = now;
      seconds = 0;
    }
    const frame = runs[0].frameAt(Math.max(seconds, 0));
    if (frame !== state.frame) show(frame);
    requestAnimationFrame(tick);
  }

  element("time").max = last;
  element("time").addEventListener("input", (e) => { play(false); show(Number(e.target.value)); });
  element("play").addEventListener("click", () => play(!state.playing));
  element("speed").addEventListener("change", (e) => {
    state.speed = Number(e.target.value);
    play(state.playing);
  });
  window.addEventListener("keydown", (e) => {
    if (e.target.matches("input, select, button, summary")) return;
    const steps = { ".": 1, ",": -1, "End": last, "Home": -last };
    if (e.key === " ") play(!state.playing);
    else if (e.key in steps) { play(false); show(state.frame + steps[e.key]); }
    else return;
    e.preventDefault();
  });

  // ---- what is shown

  function group(name) {
    if (name === "ground") return [view.ground];
    return runs.map((run) => run.layers[name]).filter(Boolean);
  }
  function toggle(name, on) {
    for (const object of group(name)) object.visible = on;
    const box = element("layers").querySelector(`input[name="${name}"]`);
    if (box) box.checked = on;
    view.draw();
  }
  function addBox(name, text, on, color, change) {
    const box = document.createElement("label"), input = document.createElement("input");
    input.type = "checkbox";
    input.name = name;
    input.checked = on;
    input.addEventListener("change", () => change(input.checked));
    box.append(input, " ");
    if (color) box.append(dot(color));
    box.append(text);
    element("layers").append(box);
  }
  function dot(color) {
    const mark = document.createElement("i");
    mark.style.background = color;
    return mark;
  }
  for (const [name, text] of Object.entries(LAYERS)) {
    if (!group(name).some((g) => g.children.length)) continue;
    const on = !OFF_AT_FIRST.includes(name);
    const words = name === "ground" ? `${text}, ${view.step} ${unit}` : text;
    addBox(name, words, on, null, (checked) => toggle(name, checked));
    toggle(name, on);
  }
  if (runs.length > 1) {
    const title = document.createElement("strong");
    title.textContent = "Runs";
    element("layers").append(title);
    runs.forEach((run, i) => {
      const text = (run.data.label ?? run.data.name) + (run.ghost ? " (faint)" : "");
      const show = (on) => { run.root.visible = on; view.draw(); };
      addBox(`run-${i}`, text, !run.data.hidden, null, show);
      show(!run.data.hidden);
    });
  }
  element("panel").open = window.innerWidth >= ROOMY;

  const views = [["free", "free"], ["start", "whole scene"], ["side", "from the side"],
    ["above", "from above"], ["camera", "through the camera"]];
  for (const p of runs[0].people) {
    if (p.present.includes(1)) {
      views.push([`person-${p.person.number}`, `follow person ${p.person.number}`]);
    }
  }
  for (const [value, text] of views) element("view").add(new Option(text, value));
  element("view").addEventListener("change", (e) => look(e.target.value));
  function look(mode) {
    element("view").value = mode;
    view.look(mode);
    element("help").hidden = mode === "camera";
  }
  view.controls.addEventListener("start", () => {
    if (["start", "side", "above"].includes(view.mode)) look("free");
  });

  // ---- what was found, in words

  element("name").textContent = first.name;
  if (first.status) {
    const badge = document.createElement("span");
    badge.className = `badge ${first.status === "ok" ? "good" : "bad"}`;
    badge.textContent = first.status;
    element("name").append(badge);
  }
  // A line with the mark of whom it is about, and a second one in smaller letters.
  function fact(text, color, status = "", small = "", all = "") {
    const item = document.createElement("li");
    if (color) {
      const mark = dot(color);
      mark.className = status;
      item.append(mark);
    }
    item.append(text);
    if (small) {
      const more = document.createElement("small");
      more.textContent = small;
      more.title = all;
      item.append(more);
    }
    element("facts").append(item);
  }
  // What was measured of a person, and why it is in doubt.
  function personFact(person) {
    const sigma = person.stature_sigma;
    const tall = `${(100 * person.stature).toFixed(0)}`
      + (sigma ? ` ± ${(100 * sigma).toFixed(0)}` : "");
    const figures = person.status === "not_measurable" ? [] : [
      `${person.distance.toFixed(1)} m`, `${person.speed.toFixed(1)} m/s`, `${tall} cm tall`,
    ];
    if (person.words) figures.push(person.words);
    const reasons = person.reasons ?? [];
    const more = reasons.length > 1 ? ` (and ${reasons.length - 1} more)` : "";
    fact(`person ${person.number}: ${figures.join(", ")}`, person.color, person.status,
      reasons.length ? reasons[0] + more : "", reasons.join("\n"));
  }
  fact(`camera: ${first.camera.distance.toFixed(1)} ${unit}`, style.camera);
  const seen = runs[0].people.filter((p) => p.present.includes(1)).map((p) => p.person);
  seen.forEach(personFact);
  if (seen.some((person) => person.inferred)) {
    fact("pale limbs: hidden in the video, inferred");
  }
  if (first.scale_sigma !== null && first.metric) {
    fact(`sizes are known to ${Math.max(100 * first.scale_sigma, 1).toFixed(0)} %`);
  }
  // In small windows the list is closed: what must be known is in its title.
  const counts = [`${seen.length} ${seen.length === 1 ? "person" : "people"}`];
  for (const words of new Set(seen.map((person) => person.words).filter(Boolean))) {
    counts.push(`${seen.filter((person) => person.words === words).length} ${words}`);
  }
  element("found").querySelector("summary").textContent = first.metric
    ? counts.join(", ") : "no people: sizes are in the map's own unit, not metres";
  element("found").open = window.innerWidth >= ROOMY;

  // ---- begin

  look("start");
  const wanted = new URLSearchParams(location.hash.slice(1));
  if (wanted.has("view")) look(wanted.get("view"));
  const shown = show(Number(wanted.get("frame")) || 0);
  if (wanted.has("play")) play(true);
  if (wanted.has("embedded")) { // In a page that says the rest.
    document.body.classList.add("embedded");
    element("panel").open = false;
  }
  window.bodyslam = { state, show, play, look, toggle, runs, view };
  shown.then(() => { state.ready = true; });
}

try {
  start();
} catch (error) {
  const message = document.getElementById("message");
  message.hidden = false;
  message.textContent = /webgl/i.test(error)
    ? "This browser shows no 3D (WebGL): switch on its hardware acceleration, or open "
      + "this file in another browser."
    : `The scene could not be shown: ${error}`;
  console.error(error);
}
