// The compiled integrator, its settings, the address, and the states that plots and trails show.
const by = (id) => document.getElementById(id);
const about = JSON.parse(by("description").textContent);
const { m, family } = about, count = about.quantities.length;
/** Returns the WebAssembly in the page, which is compressed. */
async function inflated() {
  const bytes = Uint8Array.from(atob(by("wasm").textContent.trim()), (c) => c.charCodeAt(0));
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
}
let code, exported;
try {
  exported = (await WebAssembly.instantiate(await inflated(), {})).instance.exports;
} catch (error) {
  by("fault").hidden = false;
  by("fault").textContent = `WebAssembly could not be started (${error.message}). Use a current browser, and allow 'wasm-unsafe-eval' in the content security policy.`;
  return;
}
exported._initialize?.();
const capacity = exported.capacity();
let memory_parameters, memory_q, memory_p, memory_v, memory_rates, stored_t, stored_q, stored_p, stored_energy, stored_quantities;
/** Views the memory of the integrator, again whenever this grows. */
function viewMemory() {
  const block = (k, length) => new Float64Array(exported.memory.buffer, length ? exported.memory_of(k) : 0, length);
  [memory_parameters, memory_q, memory_p, memory_v] = [about.values, m, m, m].map((length, k) => block(k, length));
  [stored_t, stored_q, stored_p, stored_energy, stored_quantities] = [1, m, m, 1, count].map((length, k) => block(4 + k, capacity * length));
  memory_rates = about.from_momenta ? memory_p : memory_v; // given at the start
}
viewMemory();
code = Object.fromEntries(Object.entries(exported).filter(([, each]) => typeof each === "function").map(([name, call]) => [name, (...given) => {
  const result = call(...given);
  if (memory_q.buffer !== exported.memory.buffer) viewMemory();
  return result;
}]));
const events = about.events.length > 0;

const clamped = (x, low, high) => Math.min(high, Math.max(low, x));
const STORED = 2000; // states of the history at most; then every second one is removed
const TRAIL = 900; // points of a trail
const WHOLE = about.whole; // coordinates up to which the history contains all of them

/** Returns an object by names of the model, which has no other properties, whatever the names. */
const byName = (pairs) => Object.assign(Object.create(null), Object.fromEntries(pairs));

// ---- settings: they determine the motion, and are in the address
const initial = {
  step: about.step.value, speed: about.speed.value, q: about.q, v: about.v,
  parameters: Object.fromEntries(about.parameters.map(({ name, value }) => [name, value])),
};
Object.assign(initial.parameters, family?.orbits[0].parameters);
let settings = structuredClone(initial), present = 0; // number of the orbit of a family
let legs = [0]; // numbers of steps, "r" where the direction of time is reversed, and new values of inputs
const value = (given) => (typeof given === "string" ? settings.parameters[given] : given);
const ranges = byName(about.parameters.map(({ name, low, high }) => [name, [low, high]]));
const inputs = byName(about.parameters.filter(({ input }) => input).map(({ name, place }) => [name, place]));
let held = byName(Object.keys(inputs).map((name) => [name, initial.parameters[name]])); // present values of inputs

/** Sets the settings from the address; returns the legs to perform, or an error. */
function readAddress(text) {
  const given = new URLSearchParams(text.replace(/^#/, "")), next = structuredClone(initial);
  const numbers = (list) => list.split(",").map(Number), finite = (list) => list.every(Number.isFinite);
  const outside = (name, x) => { const [low, high] = ranges[name]; return x >= low && x <= high ? "" : `${name} must be between ${low} and ${high}; the address has ${x}.`; };
  let steps = [0];
  for (const [key, entry] of given) {
    if (key === ".n") {
      steps = entry.split(",").map((leg) => {
        const [, name, x] = leg.match(/^(\w+):(.+)$/) || [];
        return leg === "r" ? leg : name in inputs ? [name, Number(x)] : clamped(Math.floor(Math.abs(leg || NaN)), 0, 1e7);
      });
      for (const leg of steps) {
        if (Number.isNaN(leg)) return { error: `The address has ".n=${entry}", which is no list of numbers of steps, r, and inputs as F:1. Correct or remove it.` };
        if (Array.isArray(leg) && outside(...leg)) return { error: outside(...leg) };
      }
      continue;
    }
    const listed = numbers(entry);
    if (!finite(listed) || entry === "") return { error: `The address has "${key}=${entry}", which is not a number. Correct or remove it.` };
    if (key === ".q" || key === ".v") {
      if (listed.length !== m) return { error: `The address has ${listed.length} numbers for "${key}"; this system needs ${m}.` };
      next[key[1]] = listed;
    } else if (key === ".step" || key === ".speed") {
      if (!(listed[0] > 0)) return { error: `"${key}" must be positive; the address has ${entry}.` };
      next[key.slice(1)] = listed[0];
    } else if (key in ranges) {
      if (outside(key, listed[0])) return { error: outside(key, listed[0]) };
      next.parameters[key] = listed[0];
    }
  }
  settings = next;
  held = byName(Object.keys(inputs).map((name) => [name, settings.parameters[name]]));
  return { paused: given.has(".n"), steps };
}

/** Returns the part of the address that reproduces the state bit for bit. */
function address(withSteps = true) {
  const parts = [];
  for (const [name, x] of Object.entries(settings.parameters)) if (x !== initial.parameters[name]) parts.push(`${encodeURIComponent(name)}=${x}`);
  for (const name of ["step", "speed"]) if (settings[name] !== initial[name]) parts.push(`.${name}=${settings[name]}`);
  if (!about.initial) for (const name of ["q", "v"]) if (String(settings[name]) !== String(initial[name])) parts.push(`.${name}=${settings[name].join(",")}`);
  if (withSteps && (legs.length > 1 || legs[0])) parts.push(`.n=${legs.map((leg) => (Array.isArray(leg) ? leg.join(":") : leg)).join(",")}`);
  return "#" + parts.join("&");
}

// ---- the run
let fault = 0, energy0 = 0, quantities0 = [], rows = [], trails = [], stride = 1, counted = 0, before;
const backward = () => legs.filter((leg) => leg === "r").length % 2 === 1;
const signed = () => (backward() ? -settings.step : settings.step);
const probes = m <= WHOLE ? Array.from({ length: m }, (_, k) => k) : [Math.floor(m / 4), Math.floor(m / 2)];
const ROW = { t: 0, energy: 1, quantities: 2, q: 2 + count, p: 2 + count + probes.length };

/** Starts from the initial values. */
function start() {
  Object.assign(settings.parameters, held);
  const own = family ? family.orbits.findIndex(({ q, v, parameters }) => String([q, v]) === String([settings.q, settings.v]) && Object.entries(parameters).every(([name, x]) => settings.parameters[name] === x)) : -1;
  if (own >= 0) present = own;
  about.parameters.forEach(({ name, place }) => (memory_parameters[place] = settings.parameters[name]));
  if (about.initial) {
    code.initial();
    settings.q = Array.from(memory_q); settings.v = Array.from(memory_v);
  } else { memory_q.set(settings.q); memory_rates.set(settings.v); }
  legs = [0];
  fault = code.start(about.t, settings.step);
  forget();
}

/** Reverses the direction of time at the present state. */
function turn() {
  legs.push("r", 0);
  fault = code.turn(signed());
  for (const points of trails) for (const point of points) point.t = NaN; // all are past
  before = undefined;
}

/** Sets an input for the steps to come. */
function hold(name, x) {
  held[name] = memory_parameters[inputs[name]] = x;
  const last = legs.length - 2;
  if (legs[last + 1] === 0 && legs[last]?.[0] === name && legs[last] !== "r") legs[last][1] = x;
  else legs.push([name, x], 0);
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
  picture.see?.(q, p);
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

/** Returns q and p between the states of the last step: a cubic with their positions and velocities, after an event the
 * parabola of both positions and the first velocity; p on a line. */
function between(time) {
  const now = [memory_q, memory_p], way = backward() ? -1 : 1;
  if (!before || (!before[1] && code.velocities(-1))) return now;
  const ends = [...before, { t: code.time(), q: memory_q, p: memory_p }], k = Math.max(1, ends.findIndex(({ t }) => (t - time) * way > 0)), [from, to] = ends.slice(k - 1, k + 1);
  const h = to.t - from.t, s = (time - from.t) / h;
  if (!(s >= 0 && s < 1)) return now;
  const p = Float64Array.from(to.p, (x, i) => from.p[i] + s * (x - from.p[i]));
  if (before[1]) return [Float64Array.from(to.q, (x, i) => from.q[i] + from.v[i] * s * h + (x - from.q[i] - from.v[i] * h) * s * s), p];
  const [a, b, c, d] = [(1 + 2 * s) * (1 - s) ** 2, s * (1 - s) ** 2 * h, s * s * (3 - 2 * s), s * s * (s - 1) * h];
  return [Float64Array.from(to.q, (x, i) => a * from.q[i] + b * from.v[i] + c * x + d * memory_v[i]), p];
}

/** Performs one step, and adds points of a smooth trail if it takes several frames. */
function single() {
  before = m <= WHOLE && !code.velocities(-1) ? [{ t: code.time(), q: memory_q.slice(), p: memory_p.slice(), v: memory_v.slice() }] : undefined;
  advance(1);
  if (before && events) {
    for (let k = 0; k < code.stored() - 1; k++) if (!code.velocities(k)) before.push({ t: stored_t[k], q: stored_q.slice(k * m, (k + 1) * m), p: stored_p.slice(k * m, (k + 1) * m), v: memory_v.slice() });
  }
  if (fault || !before || !shape.trails.length) return;
  const t0 = before[0].t, h = code.time() - t0, parts = clamped(Math.ceil((60 * Math.abs(h)) / settings.speed), 1, 8);
  for (let j = 1; j < parts; j++) {
    const t = t0 + (h * j) / parts, points = pointsOf(...between(t), t);
    shape.trails.forEach((which, k) => {
      let at = trails[k].length;
      while (at > 1 && (trails[k][at - 1].t - t) * h > 0) at--;
      trails[k].splice(at, 0, { t, at: points[which] });
    });
  }
}

/** Performs steps; every `every`-th state is stored. */
function advance(steps, every = 1) {
  while (steps > 0 && !fault) {
    const now = Math.min(steps, every * capacity), first = code.steps();
    fault = code.advance(now, every);
    const done = code.steps() - first, stored = code.stored();
    for (let k = 0; k < stored; k++) {
      keep(stored_t[k], stored_q.subarray(k * m, (k + 1) * m), stored_p.subarray(k * m, (k + 1) * m), stored_energy[k], stored_quantities.subarray(k * count, (k + 1) * count));
    }
    legs[legs.length - 1] += done;
    if (!fault && about.energy && stored && !Number.isFinite(stored_energy[stored - 1])) fault = 3;
    steps -= now;
  }
}
