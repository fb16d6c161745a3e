// Plots of the history: two variables over one another, the energy, and every conserved quantity.
const GREEK = { __proto__: null, alpha: "α", beta: "β", gamma: "γ", delta: "δ", epsilon: "ε", zeta: "ζ", eta: "η", theta: "θ", kappa: "κ", lambda: "λ", mu: "μ", nu: "ν", xi: "ξ", rho: "ρ", sigma: "σ", tau: "τ", phi: "φ", chi: "χ", psi: "ψ", omega: "ω", Gamma: "Γ", Delta: "Δ", Theta: "Θ", Lambda: "Λ", Phi: "Φ", Psi: "Ψ", Omega: "Ω" };
const LOW_DIGITS = "₀₁₂₃₄₅₆₇₈₉";
/** Returns a name in parts: a letter or word, and what is below it. */
function parted(name) {
  const [, stem, under] = name.match(/^([A-Za-z]+?)_?(\d+|(?<=_).+)?$/) || [0, name];
  return [GREEK[stem] || stem, under];
}
/** Returns a span with a name set as in a formula. */
function set(name, dotted = false) {
  const [stem, under] = parted(name), span = document.createElement("span"), letter = span.appendChild(document.createElement("i"));
  letter.textContent = stem;
  if (dotted) letter.className = "dot";
  if (stem.length > 2) letter.style.fontStyle = "normal";
  if (under !== undefined) span.appendChild(document.createElement("sub")).append(/[A-Za-z]{2,}|_/.test(under) ? set(under) : under);
  return span;
}
/** Returns a name as text, for where there is no markup. */
const spelled = (name) => { const [stem, under] = parted(name); return under === undefined ? stem : /^\d+$/.test(under) ? stem + under.replace(/\d/g, (d) => LOW_DIGITS[d]) : `${stem} ${spelled(under)}`; };
const wrapped = (angle) => angle - TAU * Math.round(angle / TAU);

// ---- variables
const variables = [{ name: "t", label: "t", of: (row) => row[0] }];
if (m <= WHOLE && about.coordinates.length) {
  const turning = new Set(shape.angles);
  about.coordinates.forEach((name, k) => variables.push({ name, label: spelled(name), of: turning.has(k) ? (row) => wrapped(row[ROW.q + k]) : (row) => row[ROW.q + k], period: turning.has(k) ? TAU : 0 }));
  about.momenta.forEach((name, k) => variables.push({ name, label: spelled(name), of: (row) => row[ROW.p + k] }));
  const points = (row) => pointsOf(row.subarray(ROW.q, ROW.q + m), row.subarray(ROW.p, ROW.p + m), row[0]);
  for (const { name, tip, centre } of shape.solids) "xyz".split("").forEach((letter, axis) => {
    variables.push({ name: `${name}.${letter}`, label: `${name} axis ${letter}`, of: (row) => { const at = points(row); return at[tip][axis] - at[centre][axis]; } });
  });
} else probes.forEach((at, k) => {
  const name = shape.mesh?.fields.find(({ columns: [begin, end] }) => at >= begin && at < end)?.name || "q";
  variables.push({ name: `q.${at}`, label: `${name}, node ${at}`, of: (row) => row[ROW.q + k] }, { name: `p.${at}`, label: `p, node ${at}`, of: (row) => row[ROW.p + k] });
});
if (about.energy) variables.push({ name: "energy", label: "energy", of: (row) => row[1] });
about.quantities.forEach((name, k) => variables.push({ name, label: name, of: (row) => row[2 + k] }));
const named = (name, other) => { const at = variables.findIndex((each) => each.name === name); return at < 0 ? Math.min(other, variables.length - 1) : at; };

// ---- panels
const panels = [];
function addPanel(title, draw) {
  const box = document.createElement("div"), heading = box.appendChild(document.createElement("h2"));
  box.className = "plot";
  const span = heading.appendChild(document.createElement("span")), output = heading.appendChild(document.createElement("output")), canvas = box.appendChild(document.createElement("canvas"));
  span.textContent = span.title = title;
  canvas.setAttribute("role", "img"); canvas.setAttribute("aria-label", title); output.setAttribute("aria-live", "off");
  by("plots").append(box);
  const panel = { span, output, canvas, draw: () => draw(panel) };
  panels.push(panel);
  return panel;
}
// Signed numbers on an axis that is linear between -1 and 1, where orbits are stable, and logarithmic beyond.
const SIGNED = { values: [-1, 1], to: (x) => (Math.abs(x) <= 1 ? x : Math.sign(x) * (1 + Math.log10(Math.abs(x)))), from: (u) => (Math.abs(u) <= 1 ? u : Math.sign(u) * 10 ** (Math.abs(u) - 1)) };
// Curves over a family, with its bifurcations and the present orbit.
const over = (title, heights, told, axis) => addPanel(`${title} over ${spelled(family.value)}`, ({ canvas, output }) => {
  const { orbits } = family, columns = heights(orbits[0]).map((_, k) => [...orbits.map((orbit) => heights(orbit)[k]), NaN]);
  const { px, py, pen } = plot(canvas, columns.flatMap(() => [...orbits.map((orbit) => orbit.value), NaN]), columns.flat(), colors.c0, { axis });
  orbits.forEach((orbit, k) => { if (orbit.bifurcation || k === present) heights(orbit).forEach((y) => { pen.beginPath(); pen.arc(px(orbit.value), py(y), 3.5, 0, TAU); pen.fillStyle = k === present ? colors.c1 : colors.muted; pen.fill(); }); });
  output.textContent = told(orbits[present]);
});
if (family) over("Period", ({ period }) => [period], ({ period, value }) => `${short(period, 6)} at ${short(value, 6)}`);
if (family && family.value !== "energy") over("Energy", ({ energy }) => [energy], ({ energy }) => short(energy, 6));
if (family) over(family.indices, ({ indices }) => indices.map(SIGNED.to), ({ bifurcation, stability, indices }) => [...indices.slice(0, 3).map((x) => short(x, 4)), bifurcation || stability].join(", "), SIGNED);
const [solid] = shape.solids;
const defaults = about.plots.length ? about.plots : [solid && m <= WHOLE && about.coordinates.length ? [`${solid.name}.y`, `${solid.name}.x`] : m <= WHOLE && about.coordinates.length ? ((k) => (k < 0 ? [about.coordinates[0], "t"] : [about.momenta[k] || "t", about.coordinates[k]]))(about.coordinates.findIndex((_, k) => !about.rotations.some(({ columns }) => columns.includes(k)))) : [`q.${probes[0]}`, "t"]];
for (const [y, x] of defaults) {
  const shown = { y: named(y, 2), x: named(x, 0) };
  const panel = addPanel("Plot of two variables", ({ canvas }) => {
    const [across, up] = [variables[shown.x], variables[shown.y]], xs = rows.map(across.of), ys = rows.map(up.of);
    const { px, py, pen } = plot(canvas, xs, ys, colors.c0, { periods: [across.period, up.period] });
    pen.beginPath(); pen.arc(px(xs.at(-1)), py(ys.at(-1)), 3.5, 0, TAU); pen.fillStyle = colors.c1; pen.fill();
  });
  panel.span.textContent = ""; panel.span.className = "choices";
  for (const which of ["y", "x"]) {
    const choice = document.createElement("select");
    choice.setAttribute("aria-label", which === "y" ? "Vertical axis" : "Horizontal axis");
    variables.forEach(({ label }, k) => choice.add(new Option(label, k, false, k === shown[which])));
    choice.addEventListener("change", () => { shown[which] = +choice.value; panel.draw(); });
    if (which === "x") panel.span.append("over");
    panel.span.append(choice);
  }
}
if (about.energy) addPanel(about.energy.conserved ? "Relative energy error" : about.energy.label, ({ canvas, output }) => {
  const scale = about.energy.conserved ? Math.abs(energy0) || 1 : 1, ys = rows.map((row) => (row[1] - (about.energy.conserved ? energy0 : 0)) / scale);
  plot(canvas, rows.map((row) => row[0]), ys, colors.c2, { symmetric: about.energy.conserved });
  output.textContent = short(ys.at(-1), 2);
});
about.quantities.forEach((name, k) => addPanel(`Change of ${name.replace(/\w+_\w+/g, spelled)}`, ({ canvas, output }) => {
  const ys = rows.map((row) => row[2 + k] - quantities0[k]);
  plot(canvas, rows.map((row) => row[0]), ys, colors.c3, { symmetric: true });
  output.textContent = short(ys.at(-1), 2);
}));

/** Returns the context of a canvas, cleared, in CSS pixels. */
function fitted(canvas) {
  const ratio = devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight, [w, h] = [width, height].map((x) => Math.round(x * ratio));
  if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0); pen.clearRect(0, 0, width, height); pen.lineJoin = pen.lineCap = "round";
  return [pen, width, height];
}

/** Draws ys over xs; where a periodic variable jumps, points are not joined. An axis: values that it has, and what its marks mean. */
function plot(canvas, xs, ys, color, { symmetric = false, periods = [0, 0], axis = { values: [], from: (y) => y } } = {}) {
  const [pen, width, height] = fitted(canvas), bottom = 17, top = 6, right = 8;
  const range = (list) => {
    let low = Infinity, high = -Infinity;
    for (const x of list) { if (x < low) low = x; if (x > high) high = x; }
    if (!(low <= high)) return [-1, 1];
    const least = (high > low ? 1e-9 : 0.1) * Math.max(Math.abs(low), Math.abs(high)) || 1e-15; // of one value a tenth, of others rounding
    return high - low > least ? [low, high] : [low - least, low + least];
  };
  let [x0, x1] = range(xs), [y0, y1] = range([...ys, ...axis.values]);
  if (symmetric) { y1 = Math.max(...ys.reduce(([a, b], y) => [Math.max(a, y), Math.max(b, -y)], [0, 0]), 2.3e-16); y0 = -y1; }
  const pad = 0.08 * (y1 - y0); y0 -= pad; y1 += pad;
  let left = 52;
  const px = (x) => left + ((width - left - right) * (x - x0)) / (x1 - x0), py = (y) => height - bottom - ((height - bottom - top) * (y - y0)) / (y1 - y0);
  const marked = (low, high, wanted, meaning = (x) => x) => { // with digits in which they differ
    const marks = ticks(low, high, wanted), digits = clamped(Math.ceil(Math.log10(Math.max(Math.abs(low), Math.abs(high)) / (marks[1] - marks[0]))) + 1 || 3, 3, 7);
    return marks.map((mark) => [mark, short(meaning(mark), digits)]);
  };
  pen.font = `11px ${colors.sans}`; pen.fillStyle = colors.muted; pen.textBaseline = "middle"; pen.textAlign = "right";
  const levels = marked(y0, y1, 3, axis.from);
  left = Math.max(left, ...levels.map(([, text]) => pen.measureText(text).width + 8));
  for (const [mark, text] of levels) { line(pen, [[left, py(mark)], [width - right, py(mark)]], colors.rule, 1); pen.fillText(text, left - 6, py(mark)); }
  pen.textBaseline = "top"; pen.textAlign = "center";
  for (const [mark, text] of marked(x0, x1, clamped(width / 75, 2, 5))) { const half = pen.measureText(text).width / 2; if (px(mark) + half < width) pen.fillText(text, px(mark), height - bottom + 4); }
  pen.beginPath();
  for (let k = 0; k < xs.length; k++) {
    const jump = k && (Number.isNaN(ys[k - 1]) || periods.some((period, axis) => period && Math.abs((axis ? ys : xs)[k] - (axis ? ys : xs)[k - 1]) > period / 2));
    if (!k || jump) pen.moveTo(px(xs[k]), py(ys[k])); else pen.lineTo(px(xs[k]), py(ys[k]));
  }
  pen.strokeStyle = color; pen.lineWidth = 1.2; pen.stroke();
  return { px, py, pen };
}
