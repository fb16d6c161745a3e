// Sliders, buttons, keys, dragging, and the loop over frames.
const scheduled = scheduler(() => performance.now());
const CAUSES = about.causes;
let running = true, pending = [], dragged, last, target = 0, frames = 0, dirty = true, notice = "", noticeEnds = 0;
const motion = by("motion"), calm = matchMedia("(prefers-reduced-motion: reduce)");

function tell(text) { notice = text; noticeEnds = performance.now() + 7000; dirty = true; }
let writing;
function writeAddress() {
  clearTimeout(writing);
  writing = setTimeout(() => { try { history.replaceState(null, "", address(false)); } catch { /* a frame without an address */ } }, 300);
}

/** Starts the motion again, and finds the frame of the drawing by running ahead for a moment, or along an orbit. */
function restart() {
  start();
  if (!fault && !shape.mesh && m <= 400) {
    const states = [pointsOf(memory_q, memory_p, code.time())], span = family ? family.orbits[present].period : 10 * settings.speed;
    const orbit = trails.map(() => []); // all of it: trails forget
    scheduled.begin(family ? Infinity : frames ? 4 : 40); // an orbit to its end; longer when the page begins, and its code is compiled
    scheduled.perform(() => (fault || Math.abs(code.time() - about.t) >= span || states.length >= 4000 ? 0 : family ? 1 : 64), (now) => {
      if (family) { single(); trails.forEach((points, k) => orbit[k].push(...points.splice(0, points.length - 1))); } else fault = code.advance(now, 4);
      for (let k = 0; k < code.stored() && !fault; k++) states.push(pointsOf(stored_q.subarray(k * m, (k + 1) * m), stored_p.subarray(k * m, (k + 1) * m), stored_t[k]));
    });
    if (family) { picture.curves = orbit.map((points, k) => [...points, ...trails[k]]); states.push(...family.orbits.map(({ q, p }) => pointsOf(q, p, about.t))); } // one frame for all
    const shown = states.filter((points) => points.flat().every(Number.isFinite));
    start();
    picture.ahead(shown);
  } else picture.ahead([pointsOf(memory_q, memory_p, code.time())]);
  target = code.time();
  by("reverse").setAttribute("aria-pressed", "false");
  dirty = true;
}

// ---- sliders
const sliders = [];
const groups = {};
function group(title) {
  if (groups[title]) return groups[title];
  const box = document.createElement("details"), heading = box.appendChild(document.createElement("summary"));
  heading.textContent = title; box.open = true;
  by("controls").append(box);
  return (groups[title] = box);
}
function addSlider(title, label, name, { low, high, step = 0.001, log = false, hard = true, whole = false, get, set: put }) {
  const row = document.createElement("div"), id = "c" + sliders.length, text = document.createElement("label"), range = document.createElement("input"), number = document.createElement("input");
  row.className = "row"; text.htmlFor = range.id = id; text.append(label); text.title = name;
  const length = whole ? high - low : 1; // of the range, in steps of 1 if values are whole
  Object.assign(range, { type: "range", min: 0, max: length, step: whole ? 1 : step }); range.setAttribute("aria-label", name);
  Object.assign(number, { type: "number", step: "any" }); number.setAttribute("aria-label", `${name}, value`);
  row.append(text, range, number);
  const share = (x) => clamped(log ? Math.log(x / low) / Math.log(high / low) : (x - low) / (high - low), 0, 1);
  const show = () => {
    const x = get(), at = share(x);
    if (document.activeElement !== range) range.value = length * at;
    range.style.setProperty("--at", `${100 * at}%`);
    range.setAttribute("aria-valuetext", short(x));
    if (document.activeElement !== number) number.value = Math.abs(x) < 1e-15 * Math.max(Math.abs(low), Math.abs(high)) ? 0 : [4, 3].map((digits) => compact(x, digits)).find((shown, k) => k || shown.length <= 8);
  };
  const changed = (x) => { put(x); showSliders(); writeAddress(); };
  range.addEventListener("input", () => { const s = +range.value; changed(whole ? low + s : clamped(+(log ? low * (high / low) ** s : low + (high - low) * s).toPrecision(4), low, high)); });
  number.addEventListener("change", () => {
    const x = number.valueAsNumber;
    if (!Number.isFinite(x)) tell(`${name} must be a number.`);
    else if (hard && (x < low || x > high)) { tell(`${name} must be between ${short(low)} and ${short(high)}; ${short(x, 6)} was replaced.`); changed(clamped(x, low, high)); number.value = +get().toPrecision(4); }
    else changed(x);
  });
  number.addEventListener("blur", show);
  group(title).append(row);
  sliders.push(show);
}
const showSliders = () => sliders.forEach((show) => show());
const moveTo = ({ q, v, parameters }) => { Object.assign(settings, { q, v }); Object.assign(settings.parameters, parameters); restart(); };
if (family) addSlider("Family", "Orbit", "Orbit", { low: 0, high: family.orbits.length - 1, whole: true, get: () => present, set: (k) => moveTo(family.orbits[Math.round(k)]) });
addSlider("Time", "Speed", "Speed", { ...about.speed, log: true, get: () => settings.speed, set: (x) => { settings.speed = x; } });
const { adaptive } = about.step; // of unknown durations
addSlider("Time", about.step.label.replace(" in tau", ""), about.step.label, { ...about.step, log: true, get: () => settings.step, set: (x) => { settings.step = x; restart(); } });
for (const { name, low, high, input } of about.parameters) {
  if (input) addSlider("Inputs", set(name), name, { low, high, get: () => held[name], set: (x) => { hold(name, x); dirty = true; } });
  else addSlider("Parameters", set(name), name, { low, high, get: () => settings.parameters[name], set: (x) => { settings.parameters[name] = x; restart(); } });
}
if (!about.initial && about.ranges) {
  for (const kind of ["q", "v"]) about.coordinates.forEach((name, k) => {
    if (about.rotations.some(({ columns }) => columns.includes(k))) return;
    const [low, high] = about.ranges[kind][k];
    const momentum = kind === "v" && about.from_momenta ? about.momenta[k] : "";
    addSlider("Initial values", set(momentum || name, kind === "v" && !momentum), momentum || (kind === "q" ? name : `Velocity of ${name}`), { low, high, hard: false, get: () => settings[kind][k], set: (x) => { settings[kind] = settings[kind].with(k, x); restart(); } });
  });
}
const turned = about.rotations.filter(({ rates }) => rates.length); // spins have no sliders
turned.forEach(addRotation);
for (const [title, box] of Object.entries(groups)) if (sliders.length > 24 && /^(Initial|Rotation) /.test(title)) box.open = false;

/** Adds sliders of a rotation: the angles of R = Rz Ry Rx, which keep the velocity in the body, and the angular velocity there. */
function addRotation({ name, columns, rates }) {
  const product = ([a, b, c, d], [w, x, y, z]) => [a * w - b * x - c * y - d * z, a * x + b * w + c * z - d * y, a * y - b * z + c * w + d * x, a * z + b * y - c * x + d * w];
  const inverse = (q) => { const square = q.reduce((sum, u) => sum + u * u, 0); return q.map((u, k) => (k ? -u : u) / square); };
  const attitude = () => columns.map((c) => settings.q[c]), motionOf = () => columns.map((c) => settings.v[c]);
  const omega = () => product(inverse(attitude()), motionOf()).slice(1).map((u) => 2 * u);
  const put = (q, v) => { columns.forEach((c, k) => { settings.q = settings.q.with(c, q[k]); settings.v = settings.v.with(c, v[k]); }); restart(); };
  const quaternionOf = (angles) => angles.map((u, axis) => [Math.cos(u / 2), ...[0, 1, 2].map((k) => (k === axis ? Math.sin(u / 2) : 0))]).reduce((q, factor) => product(factor, q));
  let chosen = [0, 0, 0]; // at a pitch of pi/2 the attitude does not determine the angles
  const angles = () => {
    const [w, x, y, z] = unit(attitude()), [a, b, c, d] = quaternionOf(chosen);
    if (Math.abs(w * a + x * b + y * c + z * d) < 1 - 1e-12) chosen = [Math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)), Math.asin(clamped(2 * (w * y - z * x), -1, 1)), Math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))];
    return chosen;
  };
  const title = turned.length > 1 ? `Rotation ${spelled(name)}` : "Initial values";
  ["x", "y", "z"].forEach((letter, axis) => addSlider(title, `angle ${letter}`, `Angle of ${name} about ${letter}`, {
    low: axis === 1 ? -Math.PI / 2 : -Math.PI, high: axis === 1 ? Math.PI / 2 : Math.PI, get: () => angles()[axis],
    set: (x) => {
      const next = angles().with(axis, x), size = Math.hypot(...attitude()), q = quaternionOf(next).map((u) => u * size);
      chosen = next; put(q, product(product(q, inverse(attitude())), motionOf()));
    },
  }));
  if (about.from_momenta) return;
  const largest = Math.max(4, ...omega().map((u) => 2 * Math.abs(u)));
  [0, 1, 2].forEach((axis) => addSlider(title, set(rates[axis]), rates[axis], { low: -largest, high: largest, hard: false, get: () => omega()[axis], set: (x) => put(attitude(), product(attitude(), [0, ...omega().with(axis, x)]).map((u) => u / 2)) }));
}

// ---- buttons and keys
function play(on = !running) {
  running = on && !fault;
  document.body.classList.toggle("playing", running);
  by("play").querySelector("span").textContent = running ? "Pause" : "Play";
  last = undefined; target = code.time(); dirty = true;
}
/** Makes the present state the initial state; returns whether it can. */
function takeState() {
  if (fault || (!about.from_momenta && code.velocities(-1))) { tell("The velocities of the present state are undefined; restart first."); return false; }
  settings.q = Array.from(memory_q); settings.v = Array.from(memory_rates);
  for (const k of shape.angles) settings.q[k] = wrapped(settings.q[k]);
  return true;
}
const actions = {
  play: () => play(),
  step: () => { play(false); single(); target = code.time(); dirty = true; },
  reverse: () => { if (fault) return; turn(); by("reverse").setAttribute("aria-pressed", String(backward())); play(true); },
  restart: () => { pending = []; restart(); writeAddress(); play(true); },
  here: () => { if (takeState()) { restart(); showSliders(); writeAddress(); } },
  share: async () => {
    const here = location.protocol === "about:" ? "" : location.href.split("#")[0], link = here + address();
    try {
      await navigator.clipboard.writeText(link);
      by("share").textContent = "Copied"; by("link").hidden = true;
    } catch { // no clipboard: a text to select
      by("link").hidden = false; by("link_text").value = link; by("link_text").focus(); by("link_text").select();
    }
    setTimeout(() => { by("share").textContent = "Copy link"; }, 1600);
  },
};
for (const [id, act] of Object.entries(actions)) by(id).addEventListener("click", act);
if (about.initial) by("here").remove();
const keys = { " ": "play", ArrowRight: "step", b: "reverse", r: "restart", h: "here", c: "share" };
document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches("input[type=number], select, #link_text, summary")) return;
  if (event.target === motion && !flat && !shape.mesh) {
    const turned = { ArrowLeft: [-12, 0], ArrowRight: [12, 0], ArrowUp: [0, 12], ArrowDown: [0, -12] }[event.key];
    if (turned) { view.orbit(...turned); event.preventDefault(); dirty = true; return; }
  }
  if (event.target === motion && !shape.mesh && "+-0".includes(event.key)) { if (event.key === "0") view.reset(); else view.enlarge(event.key === "+" ? 1.15 : 1 / 1.15); dirty = true; return; }
  if (event.key === "ArrowRight" && event.target.matches("input")) return;
  if (event.key === " " && event.target.matches("button:not(#play)")) return;
  const id = keys[event.key.toLowerCase?.() ?? event.key] || keys[event.key];
  if (!id || !by(id)) return;
  event.preventDefault(); actions[id]();
});

// ---- dragging: a body, or the camera
const place = ({ clientX, clientY }) => { const box = motion.getBoundingClientRect(); return [clientX - box.left, clientY - box.top]; };
const reachOf = (event) => (event.pointerType === "touch" || event.touches ? 44 : 26);
motion.addEventListener("touchstart", (event) => { if (event.touches.length === 1 && picture.near(place(event.touches[0]), 44) !== undefined) event.preventDefault(); }, { passive: false });
motion.addEventListener("pointerdown", (event) => {
  if (shape.mesh || pending.length) return;
  by("hint").classList.add("gone");
  const which = picture.near(place(event), reachOf(event));
  if (which === undefined) { if (flat) return; dragged = { orbit: true, at: place(event) }; }
  else {
    const was = running;
    play(false);
    if (!takeState()) return;
    if (shape.points[which].some((k) => k < 1 || k > (about.from_momenta ? 2 * m : m))) settings.v = settings.v.map(() => 0); // no coordinates: released at rest
    dragged = { which, was, depth: picture.at[which][2] };
  }
  motion.classList.add("dragging");
  motion.setPointerCapture(event.pointerId);
});
motion.addEventListener("pointermove", (event) => {
  const at = place(event);
  if (!dragged) { if (!shape.mesh && picture.at) motion.classList.toggle("near", !flat || picture.near(at, reachOf(event)) !== undefined); return; }
  if (dragged.orbit) { view.orbit(at[0] - dragged.at[0], at[1] - dragged.at[1]); dragged.at = at; dirty = true; return; }
  const there = moved(dragged.which, view.from(at, dragged.depth), about.t);
  settings.q = there.slice(0, m);
  if (there.length > m) settings.v = there.slice(m);
  start(); target = code.time(); showSliders(); writeAddress(); dirty = true;
});
for (const name of ["pointerup", "pointercancel"]) motion.addEventListener(name, () => {
  motion.classList.remove("dragging");
  if (dragged && !dragged.orbit) { restart(); if (dragged.was) play(true); }
  dragged = undefined;
});
motion.addEventListener("dblclick", () => { view.reset(); dirty = true; });

// ---- frames
/** Performs the steps of a frame; what it has no time for is left out. */
function go(elapsed) {
  const sign = backward() ? -1 : 1;
  target += elapsed * settings.speed * sign;
  const needed = () => {
    const ahead = fault ? 0 : (target - code.time()) * sign;
    return ahead > 0 ? (adaptive ? 1 : Math.ceil(ahead / settings.step - 1e-9)) : 0;
  };
  const performed = scheduled.perform(needed, (now, size) => {
    if (now > 1) advance(now - 1, Math.min(Math.max(1, Math.ceil(size / 48)), now - 1));
    if (!fault) single();
  });
  if (needed()) target = code.time();
  return performed;
}

/** Performs the steps of an address, as many as a frame allows. */
function replay() {
  const needed = () => {
    while (!fault && pending.length && !(pending[0] > 0)) {
      const leg = pending.shift();
      if (leg === "r") turn(); else if (Array.isArray(leg)) hold(...leg);
    }
    return fault || !pending.length ? 0 : pending[0];
  };
  scheduled.perform(needed, (now, leg) => { advance(now, Math.ceil(leg / 2000)); pending[0] -= now; });
  if (fault || !needed()) pending = [];
  if (!pending.length) { by("reverse").setAttribute("aria-pressed", String(backward())); target = code.time(); }
  dirty = true;
}

function frame(now) {
  scheduled.begin();
  let performed = 0;
  if (pending.length) replay();
  else if (running && !fault) {
    performed = go(Math.min(now - (last ?? now), 100) / 1000);
    last = now; dirty = true;
  }
  if (fault && running) play(false);
  const drawing = performance.now();
  if (dirty || frames % 60 === 0) draw(performed);
  if (dirty) scheduled.drawn(performance.now() - drawing);
  dirty = dirty && panels.length > 1 && !running && stale-- > 0;
  frames++;
  requestAnimationFrame(frame);
}
let stale = 0;
/** Returns the text of a status of the generated C: from 100 on of the event that ends the motion, from 200 on of impacts. */
function causeOf(status) {
  if (status >= 200) return `The impacts at ${about.events[status - 200]} = 0 accumulate: the motion ends.`;
  if (status >= 100) return `The motion ends at the event ${about.events[status - 100]} = 0.`;
  return CAUSES[status] || `The step failed (status ${status}).`;
}
function draw(performed) {
  const [pen, width, height] = fitted(motion), time = running && !pending.length ? target : code.time();
  picture.draw(pen, ...(running ? between(time) : [memory_q, memory_p]), time, width, height);
  if (running) { panels[frames % panels.length].draw(); stale = panels.length; } else panels.forEach((panel) => panel.draw());
  by("clock").textContent = pending.length ? `computing the state of the link: ${pending.reduce((sum, leg) => sum + (leg > 0 && +leg), 0).toLocaleString("en")} steps to go` : `t = ${code.time().toFixed(2)}`;
  const told = fault ? causeOf(fault) : performance.now() < noticeEnds ? notice : "";
  by("fault").hidden = !told;
  if (by("fault").textContent !== told) by("fault").textContent = told;
  if (frames % 20 === 0 || !running) by("status").textContent = `${code.steps().toLocaleString("en")} step${code.steps() === 1 ? "" : "s"}${performed ? `, ${performed} a frame` : ""}${code.steps() > 0 ? `; ${short(code.iterations(), 2)} iterations a step${code.error() > 0 ? `; largest error of a step about ${short(code.error(), 1)}` : ""}` : ""}`;
}

function open() {
  const { error, paused, steps } = readAddress(location.hash);
  if (error) tell(error);
  restart(); showSliders();
  pending = steps && steps.some((leg) => leg) ? steps : [];
  play(!error && !paused && !calm.matches);
}
/** For scripts and the console: the present state, its address, and steps at once. */
globalThis.page = {
  address,
  state: () => ({ t: code.time(), steps: code.steps(), q: Array.from(memory_q), p: Array.from(memory_p), energy: code.energy(), fault, settings: structuredClone(settings) }),
  advance: (steps) => { play(false); advance(steps, Math.max(1, Math.ceil(steps / 2000))); target = code.time(); dirty = true; },
};
if (window !== parent) document.body.classList.add("embedded");
by("hint").textContent = shape.mesh ? "" : shape.movable.length ? (flat ? "drag a body" : "drag a body, or turn the view") : flat ? "" : "drag to turn the view";
readColors();
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { readColors(); dirty = true; });
addEventListener("message", ({ data }) => { // the colours of a site around this page
  if (!["light", "dark", "auto"].includes(data)) return;
  document.documentElement.dataset.theme = data;
  readColors(); dirty = true;
});
addEventListener("resize", () => { dirty = true; });
addEventListener("hashchange", open);
open();
requestAnimationFrame(frame);
