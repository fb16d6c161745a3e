// The compiled integrator, its settings, the address, and the states that plots and trails show.
const by = (id) => document.getElementById(id);
const about = JSON.parse(by("description").textContent);
const { m } = about, count = about.quantities.length;
/** Returns the WebAssembly in the page, which is compressed. */
async function inflated() {
  const bytes = Uint8Array.from(atob(by("wasm").textContent.trim()), (c) => c.charCodeAt(0));
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
}
let code;
try {
  code = (await WebAssembly.instantiate(await inflated(), {})).instance.exports;
} catch (error) {
  by("fault").hidden = false;
  by("fault").textContent = `WebAssembly could not be started (${error.message}). Use a current browser, and allow 'wasm-unsafe-eval' in the content security policy.`;
  return;
}
code._initialize?.();
const capacity = code.capacity();
const block = (k, length) => new Float64Array(code.memory.buffer, length ? code.memory_of(k) : 0, length);
const memory_parameters = block(0, about.parameters.length), memory_q = block(1, m), memory_p = block(2, m), memory_v = block(3, m);
const stored_t = block(4, capacity), stored_q = block(5, capacity * m), stored_p = block(6, capacity * m), stored_energy = block(7, capacity);
const stored_quantities = block(8, capacity * count);

const clamped = (x, low, high) => Math.min(high, Math.max(low, x));
const STORED = 2000; // states of the history at most; then every second one is removed
const TRAIL = 900; // points of a trail
const WHOLE = about.whole; // coordinates up to which the history contains all of them

// ---- settings: they determine the motion, and are in the address
const initial = {
  step: about.step.value, speed: about.speed.value, q: about.q, v: about.v,
  parameters: Object.fromEntries(about.parameters.map(({ name, value }) => [name, value])),
};
let settings = structuredClone(initial);
let legs = [0]; // numbers of steps between reversals of the direction of time
const value = (given) => (typeof given === "string" ? settings.parameters[given] : given);
const ranges = Object.fromEntries(about.parameters.map(({ name, low, high }) => [name, [low, high]]));

/** Sets the settings from the address; returns the numbers of steps to perform, or an error. */
function readAddress(text) {
  const given = new URLSearchParams(text.replace(/^#/, "")), next = structuredClone(initial);
  const numbers = (list) => list.split(",").map(Number), finite = (list) => list.every(Number.isFinite);
  let steps = [0];
  for (const [key, entry] of given) {
    const listed = numbers(entry);
    if (!finite(listed) || entry === "") return { error: `The address has "${key}=${entry}", which is not a number. Correct or remove it.` };
    if (key === ".q" || key === ".v") {
      if (listed.length !== m) return { error: `The address has ${listed.length} numbers for "${key}"; this system needs ${m}.` };
      next[key[1]] = listed;
    } else if (key === ".step" || key === ".speed") {
      if (!(listed[0] > 0)) return { error: `"${key}" must be positive; the address has ${entry}.` };
      next[key.slice(1)] = listed[0];
    } else if (key === ".n") steps = listed;
    else if (key in ranges) {
      const [low, high] = ranges[key];
      if (listed[0] < low || listed[0] > high) return { error: `${key} must be between ${low} and ${high}; the address has ${entry}.` };
      next.parameters[key] = listed[0];
    }
  }
  settings = next;
  return { paused: given.has(".n"), steps: steps.map((n) => clamped(Math.floor(Math.abs(n)), 0, 1e7)) };
}

/** Returns the part of the address that reproduces the state bit for bit. */
function address(withSteps = true) {
  const parts = [];
  for (const [name, x] of Object.entries(settings.parameters)) if (x !== initial.parameters[name]) parts.push(`${encodeURIComponent(name)}=${x}`);
  for (const name of ["step", "speed"]) if (settings[name] !== initial[name]) parts.push(`.${name}=${settings[name]}`);
  if (!about.initial) for (const name of ["q", "v"]) if (String(settings[name]) !== String(initial[name])) parts.push(`.${name}=${settings[name].join(",")}`);
  if (withSteps && legs.some((n) => n)) parts.push(`.n=${legs.join(",")}`);
  return "#" + parts.join("&");
}

// ---- the run
let fault = 0, energy0 = 0, quantities0 = [], rows = [], trails = [], stride = 1, counted = 0, before;
const backward = () => legs.length % 2 === 0;
const signed = () => (backward() ? -settings.step : settings.step);
const probes = m <= WHOLE ? Array.from({ length: m }, (_, k) => k) : [Math.floor(m / 4), Math.floor(m / 2)];
const ROW = { t: 0, energy: 1, quantities: 2, q: 2 + count, p: 2 + count + probes.length };

/** Starts from the initial values. */
function start() {
  about.parameters.forEach(({ name }, k) => (memory_parameters[k] = settings.parameters[name]));
  if (about.initial) {
    code.initial();
    settings.q = Array.from(memory_q); settings.v = Array.from(memory_v);
  } else { memory_q.set(settings.q); memory_v.set(settings.v); }
  legs = [0];
  fault = code.start(about.t, settings.step);
  forget();
}

/** Reverses the direction of time at the present state. */
function turn() {
  legs.push(0);
  fault = code.turn(signed());
  for (const points of trails) for (const point of points) point.t = NaN; // all are past
  before = undefined;
}

function forget() {
  energy0 = code.energy();
  if (!fault && about.energy && !Number.isFinite(energy0)) fault = 3;
  code.quantities?.();
  quantities0 = Array.from(stored_quantities.subarray(0, count));
  rows = []; trails = shape.trails.map(() => []); stride = 1; counted = 0; before = undefined;
  picture.forget?.();
  keep(code.time(), memory_q, memory_p, energy0, quantities0);
}

function keep(t, q, p, energy, quantities) {
  picture.see?.(q, t);
  if (shape.trails.length) {
    const points = pointsOf(q, p, t);
    shape.trails.forEach((which, k) => { trails[k].push({ t, at: points[which] }); if (trails[k].length > TRAIL) trails[k].shift(); });
  }
  if (counted++ % stride) return;
  const row = new Float64Array(2 + count + 2 * probes.length);
  row[0] = t; row[1] = energy; row.set(quantities, 2);
  probes.forEach((at, k) => { row[ROW.q + k] = q[at]; row[ROW.p + k] = p[at]; });
  rows.push(row);
  if (rows.length > STORED) { rows = rows.filter((_, k) => k % 2 === 0); stride *= 2; }
}

/** Returns q and p between the last two states: a cubic with their positions and velocities, and a line. */
function between(time) {
  if (!before || m > WHOLE || code.velocities()) return [memory_q, memory_p];
  const h = code.time() - before.t, s = (time - before.t) / h;
  if (!(s >= 0 && s < 1)) return [memory_q, memory_p];
  const [a, b, c, d] = [(1 + 2 * s) * (1 - s) ** 2, s * (1 - s) ** 2 * h, s * s * (3 - 2 * s), s * s * (s - 1) * h];
  const q = Float64Array.from(memory_q, (x, k) => a * before.q[k] + b * before.v[k] + c * x + d * memory_v[k]);
  return [q, Float64Array.from(memory_p, (x, k) => before.p[k] + s * (x - before.p[k]))];
}

/** Performs one step, and adds points of a smooth trail if it takes several frames. */
function single() {
  before = m <= WHOLE && !code.velocities() ? { t: code.time(), q: memory_q.slice(), v: memory_v.slice(), p: memory_p.slice() } : undefined;
  advance(1);
  if (fault || !before || !shape.trails.length) return;
  const h = code.time() - before.t, parts = clamped(Math.ceil((60 * Math.abs(h)) / settings.speed), 1, 8);
  for (let j = 1; j < parts; j++) {
    const t = before.t + (h * j) / parts, points = pointsOf(...between(t), t);
    shape.trails.forEach((which, k) => trails[k].splice(-1, 0, { t, at: points[which] }));
  }
}

/** Performs steps; every `every`-th state is stored. */
function advance(steps, every = 1) {
  while (steps > 0 && !fault) {
    const now = Math.min(steps, every * capacity), first = code.steps();
    fault = code.advance(now, every);
    const done = code.steps() - first, stored = Math.floor(code.steps() / every) - Math.floor(first / every);
    for (let k = 0; k < stored; k++) {
      keep(stored_t[k], stored_q.subarray(k * m, (k + 1) * m), stored_p.subarray(k * m, (k + 1) * m), stored_energy[k], stored_quantities.subarray(k * count, (k + 1) * count));
    }
    legs[legs.length - 1] += done;
    if (!fault && about.energy && stored && !Number.isFinite(stored_energy[stored - 1])) fault = 3;
    steps -= now;
  }
}
