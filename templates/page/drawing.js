// Drawing of a state: points from the description of the shape, a view in the plane or in space, and marks at the points.
const TAU = 2 * Math.PI;
const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
let colors = {}, rgb = {}, palette;
function readColors() {
  for (const name of ["paper", "ink", "muted", "rule", "edge", "tint", "link", "c0", "c1", "c2", "c3", "c4", "c5", "sans"]) colors[name] = css("--" + name);
  for (const name of ["tint", "ink", "paper", "c0", "c1", "c2", "c3", "c4", "c5", "muted"]) rgb[name] = [1, 3, 5].map((k) => parseInt(colors[name].slice(k, k + 2), 16));
  rgb.white = [255, 255, 255]; rgb.black = [0, 0, 0];
  palette = undefined;
}
/** Returns a colour between two, after the first was mixed with white. */
const mixed = (from, to, share, white = 0) => `rgb(${rgb[from].map((x, k) => { const u = x + (255 - x) * white; return Math.round(u + (rgb[to][k] - u) * share); }).join()})`;
const hue = (k) => "c" + (k % 6);

// ---- points of a shape: registers of a straight-line program (scvi_codegen/extras/pictures/shape.py)
const { shape } = about, flat = shape.dimension === 2, START = 1 + 2 * m + about.values;
const unit = (list) => { const norm = Math.hypot(...list) || 1; return list.map((x) => x / norm); };
const registers = new Float64Array(START + shape.program.length);
shape.program.forEach((entry, k) => { if (!entry.length) registers[START + k] = entry; });
const operations = shape.program.flatMap((entry, k) => (entry.length ? [[START + k, ...entry]] : []));
/** Returns x rounded to an integer, halves to the even one. */
const rint = (x) => { const low = Math.floor(x); return x - low === 0.5 ? low + Math.abs(low % 2) : Math.round(x); };
const FUNCTIONS = { pow: Math.pow, rint, unit_step: (x) => (x >= 0 ? 1 : 0), ...Object.fromEntries(["sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh", "exp", "log"].map((name) => [name, Math[name]])) };

/** Returns the points of a state, [x, y] or [x, y, z] each. */
function pointsOf(q, p, t) {
  if (!shape.points.length) return [];
  registers[0] = t; registers.set(q, 1); registers.set(p, 1 + m); registers.set(memory_parameters, 1 + 2 * m);
  for (const entry of operations) {
    let x = registers[entry[2]];
    if (entry[1] === "add") for (let k = 3; k < entry.length; k++) x += registers[entry[k]];
    else if (entry[1] === "mul") for (let k = 3; k < entry.length; k++) x *= registers[entry[k]];
    else x = FUNCTIONS[entry[1]](x, registers[entry[3]]);
    registers[entry[0]] = x;
  }
  const periods = shape.box.map((k) => registers[k]);
  return shape.points.map((point) => point.map((k, axis) => (periods.length ? registers[k] - periods[axis] * Math.floor(registers[k] / periods[axis]) : registers[k])));
}
const constant = (k) => shape.points[k].every((each) => each >= START && !shape.program[each - START].length || each > 2 * m && each < START);

// ---- views
/** Returns a view of the plane, or of space from a camera that orbits: to(point) gives pixels and the depth. */
const view = {
  turn: 0.7, tilt: 0.32, zoom: 1, centre: [0, 0, 0], middle: [0, 0, 0], reach: 1, fresh: true,
  /** Moves towards the box of what is drawn about an origin, at once when a motion begins. */
  follow([low, high], width, height, origin = [0, 0, 0]) {
    const margin = flat ? 0.86 : 0.8, middle = low.map((x, k) => (x + high[k]) / 2), half = high.map((x, k) => (x - low[k]) / 2);
    this.fitting = [width, height].map((size, k) => (0.43 * size) / (half[k] || 1));
    const wanted = flat ? Math.max(half[0] * Math.min(1, height / width), half[1] * Math.min(1, width / height)) : Math.hypot(...half) * 0.85;
    const target = (wanted || 1) / margin, share = this.fresh ? 1 : 0.12;
    this.reach += (target - this.reach) * share;
    this.middle = middle.map((x, k) => (this.middle[k] ?? 0) + (x - (this.middle[k] ?? 0)) * (shape.equal ? share : 1));
    this.centre = this.middle.map((x, k) => x + origin[k]);
    this.fresh = false;
    this.width = width; this.height = height;
    this.scale = (Math.min(width, height) / 2 / this.reach) * this.zoom;
    this.scales = shape.equal ? [this.scale, this.scale] : this.fitting.map((x) => x * this.zoom);
    [this.cos, this.sin, this.up, this.sine] = [Math.cos(this.turn), Math.sin(this.turn), Math.cos(this.tilt), Math.sin(this.tilt)];
  },
  to(point) {
    const [x, y, z] = point.map((u, k) => u - this.centre[k]);
    if (flat) return [this.width / 2 + this.scales[0] * x, this.height / 2 - this.scales[1] * y, 0, 1];
    const across = this.cos * x + this.sin * y, away = this.cos * y - this.sin * x, depth = this.sine * z - this.up * away;
    const near = 1 / (1 - clamped(depth / (5 * this.reach), -4, 0.8));
    return [this.width / 2 + this.scale * near * across, this.height / 2 - this.scale * near * (this.up * z + this.sine * away), depth, near];
  },
  /** Returns the point at pixels, in the plane, or in space at a depth. */
  from([a, b], depth = 0) {
    if (flat) return [this.centre[0] + (a - this.width / 2) / this.scales[0], this.centre[1] + (this.height / 2 - b) / this.scales[1]];
    const near = 1 / (1 - depth / (5 * this.reach)), u = (a - this.width / 2) / this.scale / near, w = (this.height / 2 - b) / this.scale / near;
    const z = this.up * w + this.sine * depth, away = this.sine * w - this.up * depth;
    return [this.cos * u - this.sin * away, this.sin * u + this.cos * away, z].map((x, k) => x + this.centre[k]);
  },
  orbit(dx, dy) { this.turn -= dx * 0.008; this.tilt = clamped(this.tilt + dy * 0.008, -1.5, 1.5); },
  enlarge(factor) { this.zoom = clamped(this.zoom * factor, 0.2, 8); },
  reset() { this.turn = 0.7; this.tilt = 0.32; this.zoom = 1; },
};

// ---- elements
function line(pen, points, color, width, alpha = 1) {
  pen.beginPath();
  points.forEach(([x, y], k) => (k ? pen.lineTo(x, y) : pen.moveTo(x, y)));
  pen.strokeStyle = color; pen.lineWidth = width; pen.globalAlpha = alpha; pen.stroke(); pen.globalAlpha = 1;
}
function disc(pen, [x, y], radius, name) {
  if (!Number.isFinite(x + y)) return;
  pen.beginPath(); pen.arc(x, y, radius, 0, TAU);
  if (flat) pen.fillStyle = colors[name];
  else {
    const shade = pen.createRadialGradient(x - radius / 3, y - radius / 3, radius / 8, x, y, radius);
    shade.addColorStop(0, mixed(name, "white", 0.4)); shade.addColorStop(1, mixed(name, "black", 0.25));
    pen.fillStyle = shade;
  }
  pen.fill();
  pen.strokeStyle = colors.tint; pen.lineWidth = 1.5; pen.stroke();
}
/** Draws a trail that fades towards its beginning; gaps where a periodic coordinate jumps. */
function trail(pen, points, color) {
  const parts = 28, n = points.length;
  pen.lineCap = "butt";
  for (let k = 0; k < parts; k++) {
    const part = points.slice(Math.floor((k * n) / parts), Math.floor(((k + 1) * n) / parts) + 1);
    if (part.length > 1) line(pen, part, color, 1.5, 0.75 * ((k + 1) / parts) ** 1.4);
  }
  pen.lineCap = "round";
}
function arrow(pen, from, to, color) {
  const angle = Math.atan2(to[1] - from[1], to[0] - from[0]), head = (turn) => [to[0] - 10 * Math.cos(angle + turn), to[1] - 10 * Math.sin(angle + turn)];
  line(pen, [from, to], color, 3);
  pen.beginPath(); pen.moveTo(...head(0.42)); pen.lineTo(to[0], to[1]); pen.lineTo(...head(-0.42)); pen.closePath(); pen.fillStyle = color; pen.fill();
}
function spring(pen, [x0, y0], [x1, y1], color) {
  const length = Math.hypot(x1 - x0, y1 - y0) || 1, [u, v] = [(x1 - x0) / length, (y1 - y0) / length], coils = 10, points = [[x0, y0]];
  for (let k = 0; k <= 2 * coils; k++) {
    const along = 0.12 + (0.76 * k) / (2 * coils), side = k === 0 || k === 2 * coils ? 0 : k % 2 ? 6 : -6;
    points.push([x0 + along * length * u - side * v, y0 + along * length * v + side * u]);
  }
  line(pen, [...points, [x1, y1]], color, 1.5);
}
function wall(pen, corners) {
  corners.slice(1).forEach((to, k) => {
    const from = corners[k], length = Math.hypot(to[0] - from[0], to[1] - from[1]), [u, v] = [(to[0] - from[0]) / length, (to[1] - from[1]) / length];
    for (let at = 4; at < length; at += 9) line(pen, [[from[0] + at * u, from[1] + at * v], [from[0] + at * u - 6 * u - 7 * v, from[1] + at * v - 6 * v + 7 * u]], colors.muted, 1, 0.6);
  });
  line(pen, corners, colors.muted, 2);
}

/** Returns the faces of a body of revolution about the third axis, or of a box; `size` is its largest extent. */
function faces(kind, size, color) {
  const list = [];
  if (kind === "top") {
    const n = 24, ring = (u, r, z) => [size * r * Math.cos(u), size * r * Math.sin(u), size * z];
    const profile = [[0, 0], [0.05, 0.14], [0.42, 0.6], [0.42, 0.66], [0.05, 0.72], [0.03, 0.98]];
    for (let k = 0; k < n; k++) {
      const [a, b] = [(k * TAU) / n, ((k + 1) * TAU) / n], bright = k % 6 < 3;
      for (let j = 1; j < profile.length; j++) {
        const [[r, z], [s, w]] = [profile[j - 1], profile[j]], handle = j === 1 || j === 5;
        list.push({ points: [ring(a, r, z), ring(b, r, z), ring(b, s, w), ring(a, s, w)], color: handle ? "muted" : color, light: handle || bright ? 0 : 0.45 });
      }
    }
    return list;
  }
  const half = [0.55, 0.36, 0.14].map((x) => x * size);
  for (let axis = 0; axis < 3; axis++) for (const sign of [-1, 1]) {
    const [u, v] = [(axis + 1) % 3, (axis + 2) % 3];
    const points = [[1, 1], [-1, 1], [-1, -1], [1, -1]].map(([s, t]) => { const p = [0, 0, 0]; p[axis] = sign * half[axis]; p[u] = s * half[u]; p[v] = t * half[v]; return p; });
    list.push({ points: sign > 0 ? points : points.reverse(), color: hue(axis), light: sign > 0 ? 0 : 0.25 });
  }
  return list;
}

/** Returns how much brighter (positive) or darker a face is than its colour, by a lamp at the upper left of the eye. */
function lighting([a, b, c, d]) {
  const [u, v] = [0, 1].map((k) => [0, 1, 2].map((j) => (k ? d || c : c)[j] - (k ? b : a)[j]));
  const normal = unit([u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]);
  const [x, y, z] = normal, across = view.cos * x + view.sin * y, away = view.cos * y - view.sin * x;
  const facing = view.sine * z - view.up * away, up = view.up * z + view.sine * away, light = Math.sign(facing || 1) * (-0.45 * across + 0.6 * up + 0.66 * facing);
  return clamped(0.75 * light - 0.45, -0.5, 0.35);
}

// ---- the drawing of points, lines and bodies
const marked = () => {
  let low, high, first; // the box of all points seen, from the one that the view follows
  const origin = (points) => (shape.followed === undefined ? [0, 0, 0] : points[shape.followed]);
  const grown = (points) => {
    const from = origin(points);
    for (const point of points) point.forEach((there, k) => {
      const x = there - from[k];
      if (!Number.isFinite(x)) return;
      const limit = first ? 3 * (first[1][k] - first[0][k] || 1) : Infinity; // an escaping body leaves the drawing
      low[k] = Math.min(low[k], Math.max(x, first ? first[0][k] - limit : x)); high[k] = Math.max(high[k], Math.min(x, first ? first[1][k] + limit : x));
    });
  };
  const bodies = Object.fromEntries(["box", "top"].map((kind) => [kind, faces(kind, 1, hue(0))]));
  const centred = shape.solids.length && shape.solids.every(({ centre }) => constant(centre) && String(shape.points[centre]) === String(shape.points[shape.solids[0].centre]));
  const bonded = shape.marks.some(({ kind }) => kind === "bonds");
  const heaviest = () => Math.max(...shape.marks.map(({ mass }) => (mass === undefined ? 0 : Math.abs(value(mass))))) || 1;
  return {
    forget() { low = shape.dimension === 3 ? [Infinity, Infinity, Infinity] : [Infinity, Infinity]; high = low.map((x) => -x); first = undefined; this.begun = false; },
    /** Sets the frame to what the first seconds of the motion need. */
    ahead(states) {
      states.forEach(grown);
      for (const { kind, points } of shape.marks) if (kind === "rod" && constant(points[0]) && states.length) { // all that the rods reach
        const at = points.map((k) => states[0][k]), reach = at.reduce((sum, x, k) => sum + (k ? Math.hypot(...x.map((u, j) => u - at[k - 1][j])) : 0), 0);
        grown([at[0].map((x) => x - reach), at[0].map((x) => x + reach)]);
      }
      if (centred) { low = [-0.65, -0.65, -0.65]; high = [0.65, 0.65, 0.65]; }
      if (shape.box.length) { low = shape.box.map(() => 0); high = shape.box.map((k) => registers[k]); }
      first = [[...low], [...high]];
      view.fresh = true;
    },
    draw(pen, q, p, t, width, height) {
      const points = pointsOf(q, p, t);
      grown(points);
      view.follow([low, high], width, height, origin(points));
      const at = points.map((point) => view.to(point)), parts = [], add = (depth, paint) => parts.push([depth, paint]);
      if (!flat) this.ground(pen, ...[low, high].map((corner) => corner.map((x, k) => x + origin(points)[k])));
      if (shape.labels.length) this.axes(pen, width, height);
      const sign = backward() ? -1 : 1;
      shape.trails.forEach((which, k) => {
        const past = [];
        for (const point of trails[k]) if (!((point.t - t) * sign > 0)) past.push(view.to(point.at));
        line(pen, (this.curves?.[k] ?? []).map((point) => view.to(point.at)), colors.muted, 1, 0.8);
        trail(pen, [...past, at[which]], colors[trailColor(k)]);
      });
      const largest = heaviest();
      let number = 0;
      for (const mark of shape.marks) {
        const [a, b] = mark.points.map((k) => at[k]), middle = mark.points.reduce((sum, k) => sum + at[k][2], 0) / mark.points.length;
        if (bodies[mark.kind]) this.solid(pen, mark.points.map((k) => points[k]), bodies[mark.kind], hue(mark.color), add);
        else if (mark.kind === "link") {
          const name = mark.color < 0 ? "muted" : hue(mark.color);
          add(middle, () => { line(pen, [a, b], mixed(name, "ink", 0.15), 7 * a[3]); [a, b].forEach((end) => disc(pen, end, 5 * end[3], name)); });
        } else if (mark.kind === "rod") add(middle, () => line(pen, mark.points.map((k) => at[k]), colors.ink, 2.5 * a[3]));
        else if (mark.kind === "bonds") for (let k = 0; k < mark.points.length; k += 2) { const [from, to] = [at[mark.points[k]], at[mark.points[k + 1]]]; add((from[2] + to[2]) / 2, () => line(pen, [from, to], colors.muted, 1.2)); }
        else if (mark.kind === "spring") add(middle, () => spring(pen, a, b, colors.muted));
        else if (mark.kind === "wall") add(-1e9, () => wall(pen, mark.points.map((k) => at[k])));
        else if (mark.kind === "arrow") { const color = colors[hue(number++)]; add(middle, () => arrow(pen, a, b, color)); }
        else if (mark.kind === "pivot") add(middle, () => disc(pen, a, 3.5, "muted"));
        else if (mark.kind === "particles") mark.points.forEach((k) => add(at[k][2], () => disc(pen, at[k], (bonded ? 2.5 : clamped(Math.min(width, height) / 10 / mark.points.length ** (1 / shape.dimension), 2, 16)) * at[k][3], hue(0))));
        else if (mark.kind === "body" || mark.kind === "bob") {
          const name = hue(mark.color ?? number++), share = mark.mass === undefined ? 1 : Math.cbrt(Math.abs(value(mark.mass)) / largest);
          add(middle + 0.1 * view.reach, () => disc(pen, a, clamped(10 * share, 3.5, 10) * a[3], name));
          if (mark.name && shape.marks.length < 12) add(1e9, () => { pen.font = `12px ${colors.sans}`; pen.fillStyle = colors.muted; pen.textBaseline = "middle"; pen.textAlign = "left"; pen.fillText(mark.name, a[0] + 14, a[1]); });
        }
      }
      parts.sort((x, y) => x[0] - y[0]).forEach(([, paint]) => paint());
      this.at = at;
    },
    /** Adds the faces of a body whose points are its centre and the ends of its axes. */
    solid(pen, [centre, ...ends], parts, hueOfBody, add) {
      for (const { points: corners, color, light } of parts) {
        const placed = corners.map((p) => centre.map((x, j) => x + p.reduce((sum, u, k) => sum + u * (ends[k][j] - x), 0))), turned = placed.map((p) => view.to(p));
        const shade = lighting(placed), name = color === "c0" ? hueOfBody : color;
        add(turned.reduce((sum, p) => sum + p[2], 0) / turned.length, () => {
          pen.beginPath(); turned.forEach(([x, y], j) => (j ? pen.lineTo(x, y) : pen.moveTo(x, y))); pen.closePath();
          pen.fillStyle = pen.strokeStyle = shade > 0 ? mixed(name, "white", shade + light * (1 - shade)) : mixed(name, "black", -shade, light); pen.fill(); pen.lineWidth = 0.7; pen.stroke();
        });
      }
    },
    /** Draws axes with numbers, of points that are no positions in space. */
    axes(pen, width, height) {
      pen.font = `12px ${colors.sans}`;
      const [low, high] = [view.from([0, height]), view.from([width, 0])];
      const text = (string, x, y, align, baseline) => { pen.fillStyle = colors.muted; pen.textAlign = align; pen.textBaseline = baseline; pen.fillText(string, x, y); };
      for (const mark of ticks(low[0], high[0], clamped(width / 110, 3, 8))) { const [x] = view.to([mark, 0]); line(pen, [[x, 0], [x, height]], colors.rule, 1); if (x > 40 && x < width - 60) text(short(mark), x, height - 6, "center", "bottom"); }
      for (const mark of ticks(low[1], high[1], clamped(height / 80, 3, 8))) { const [, y] = view.to([0, mark]); line(pen, [[0, y], [width, y]], colors.rule, 1); if (y > 54 && y < height - 30) text(short(mark), 8, y, "left", "middle"); }
      text(spelled(shape.labels[0]), width - 12, height - 6, "right", "bottom"); text(spelled(shape.labels[1]), 12, 32, "left", "top");
    },
    /** Draws what shows the directions of space: a sphere about one solid, or else a floor. */
    ground(pen, low, high) {
      if (shape.box.length === 3) {
        const corner = (k) => view.to(shape.box.map((register, axis) => ((k >> axis) & 1) * registers[register]));
        for (let k = 0; k < 8; k++) for (let axis = 0; axis < 3; axis++) if (!((k >> axis) & 1)) line(pen, [corner(k), corner(k | (1 << axis))], colors.edge, 1);
        return;
      }
      const circle = (f) => Array.from({ length: 73 }, (_, k) => view.to(f((k * TAU) / 72)));
      if (centred) {
        for (const z of [-0.6, 0, 0.6]) { const r = Math.sqrt(1 - z * z); this.halves(pen, circle((u) => [r * Math.cos(u), r * Math.sin(u), z])); }
        for (let k = 0; k < 4; k++) { const [c, s] = [Math.cos((k * TAU) / 8), Math.sin((k * TAU) / 8)]; this.halves(pen, circle((u) => [Math.cos(u) * c, Math.cos(u) * s, Math.sin(u)])); }
        return;
      }
      const size = Math.max(...high.map((x, k) => x - low[k])) || 1, step = ticks(0, size, 5)[1] || 1, z = low[2];
      const [x0, x1, y0, y1] = [Math.floor(low[0] / step - 0.5), Math.ceil(high[0] / step + 0.5), Math.floor(low[1] / step - 0.5), Math.ceil(high[1] / step + 0.5)];
      for (let k = x0; k <= x1; k++) line(pen, [view.to([k * step, y0 * step, z]), view.to([k * step, y1 * step, z])], colors.rule, 1);
      for (let k = y0; k <= y1; k++) line(pen, [view.to([x0 * step, k * step, z]), view.to([x1 * step, k * step, z])], colors.rule, 1);
    },
    halves(pen, points) { // the rear half of a circle on a sphere is fainter
      for (let k = 1; k < points.length; k++) line(pen, [points[k - 1], points[k]], colors.muted, 0.8, points[k][2] >= 0 ? 0.4 : 0.14);
    },
    /** Returns the number of the movable point near pixels, or undefined. */
    near([x, y], distance) {
      let best, found;
      for (const k of shape.movable) {
        const d = Math.hypot(this.at[k][0] - x, this.at[k][1] - y);
        if (d < distance && !(d >= best)) { best = d; found = k; }
      }
      return found;
    },
  };
};
/** Returns the colour of a trail: that of the body or bob at its point. */
const trailColor = (k) => {
  const at = shape.marks.filter(({ kind }) => kind === "body" || kind === "bob").findIndex(({ points }) => points[0] === shape.trails[k]);
  return hue(shape.marks.find(({ points, color }) => color !== undefined && points[0] === shape.trails[k])?.color ?? (at < 0 ? k : at));
};

/** Returns coordinates with which a point of the shape is at a place: damped Gauss-Newton (Levenberg-Marquardt). */
function moved(which, place, t) {
  const free = about.from_momenta && shape.points[which].some((k) => k > m && k <= 2 * m) ? [...settings.q, ...settings.v] : settings.q; // with momenta that are positions
  const q = Float64Array.from(free), p = Float64Array.from(memory_p), error = (x) => pointsOf(x.subarray(0, m), x.length > m ? x.subarray(m) : p, t)[which].map((u, k) => u - place[k]), d = 1e-6;
  const size = (e) => e.reduce((sum, u) => sum + u * u, 0);
  let damping = 1e-3;
  for (let round = 0; round < 30; round++) {
    const e = error(q), columns = Array.from(q, (x, k) => { q[k] = x + d; const there = error(q); q[k] = x; return there.map((u, i) => (u - e[i]) / d); });
    // dq = -J^T (J J^T + damping)^-1 e, with at most three rows
    const scale = columns.reduce((sum, c) => sum + size(c), 0) || 1, rows = e.map((u, i) => [...e.map((_, j) => columns.reduce((sum, c) => sum + c[i] * c[j], i === j ? damping * scale : 0)), u]);
    for (let i = 0; i < rows.length; i++) for (let j = i + 1; j < rows.length; j++) { const f = rows[j][i] / rows[i][i]; rows[j] = rows[j].map((u, k) => u - f * rows[i][k]); }
    const w = e.map(() => 0);
    for (let i = rows.length - 1; i >= 0; i--) w[i] = (rows[i][e.length] - w.reduce((sum, u, j) => sum + (j > i ? rows[i][j] * u : 0), 0)) / rows[i][i];
    const next = q.map((x, k) => x - columns[k].reduce((sum, u, i) => sum + u * w[i], 0));
    if (size(error(next)) < size(e)) { q.set(next); damping = Math.max(damping / 4, 1e-9); } else damping *= 8;
    if (size(e) < 1e-20 || damping > 1e4) break;
  }
  return Array.from(q);
}

// ---- the drawing of fields and chains: a graph over x above its past, or an image over x and y
const graph = () => {
  const { axes, fields, dots } = shape.mesh, names = Object.keys(axes), [xs, ys] = names.map((name) => axes[name]), PAST = 160, WIDE = 420;
  const image = document.createElement("canvas"), past = [];
  let low = Infinity, high = -Infinity;
  const bounds = () => { const top = Math.max(high, -low, 1e-300); return low < -1e-9 * top ? [-top, top] : [0, top]; };
  const color = () => (palette ??= Uint32Array.from({ length: 256 }, (_, k) => {
    const signedLevel = bounds()[0] < 0 ? k / 127.5 - 1 : k / 255, end = rgb[signedLevel < 0 ? "c0" : "c1"], s = Math.abs(signedLevel);
    const [r, g, b] = rgb.tint.map((x, i) => Math.round(x + (end[i] - x) * s));
    return (255 << 24) | (b << 16) | (g << 8) | r;
  }));
  const paint = (pen, values, width, height) => {
    const data = new ImageData(width, height), pixels = new Uint32Array(data.data.buffer), [first, last] = bounds(), scale = 255 / (last - first), p = color();
    for (let k = 0; k < values.length; k++) pixels[k] = p[clamped(Math.round((values[k] - first) * scale), 0, 255) || 0];
    pen.putImageData(data, 0, 0);
  };
  const grid = (list, n) => { // for each of n places: the node before it, and the share of the next
    const result = []; let j = 0;
    for (let k = 0; k < n; k++) {
      const at = list[0] + ((list[list.length - 1] - list[0]) * k) / (n - 1);
      while (j < list.length - 2 && list[j + 1] < at) j++;
      result.push([j, (at - list[j]) / (list[j + 1] - list[j])]);
    }
    return result;
  };
  /** Returns the values of a field or momentum at the nodes. */
  const nodes = ({ columns: [begin, end], weights }, q, p) => (begin < m ? q.subarray(begin, end) : Float64Array.from(p.subarray(begin - m, end - m), (u, k) => u / weights[k]));
  const across = grid(xs, ys ? 200 : WIDE), along = ys && grid(ys, 200);
  return {
    forget() { low = Infinity; high = -Infinity; past.length = 0; palette = undefined; },
    ahead() {},
    see(q, p) {
      const u0 = nodes(fields[0], q, p);
      for (const u of u0) { if (u < low) { low = u; palette = undefined; } if (u > high) { high = u; palette = undefined; } }
      if (ys) return;
      past.push(Float32Array.from(across, ([j, s]) => u0[j] + s * (u0[j + 1] - u0[j])));
      if (past.length > 2 * PAST) past.splice(0, past.length, ...past.filter((_, k) => k % 2 === 1));
    },
    draw(pen, q, p, t, width, height) {
      const left = 46, right = 16, top = 36, [first, last] = bounds(), x0 = xs[0], x1 = xs[xs.length - 1];
      pen.font = `12px ${colors.sans}`; pen.fillStyle = colors.muted;
      if (ys) return this.plane(pen, nodes(fields[0], q, p), width, height);
      const split = Math.round(height * 0.6), pad = 0.06 * (last - first), px = (x) => left + ((width - left - right) * (x - x0)) / (x1 - x0);
      const py = (u) => split - 14 - ((split - 14 - top) * (u - first + pad)) / (last - first + 2 * pad);
      pen.textAlign = "right"; pen.textBaseline = "middle";
      for (const mark of ticks(first, last, 5)) { line(pen, [[left, py(mark)], [width - right, py(mark)]], colors.rule, 1); pen.fillText(short(mark), left - 6, py(mark)); }
      fields.forEach((field, k) => {
        const points = Array.from(nodes(field, q, p), (u, j) => [px(xs[j]), py(u)]);
        line(pen, points, colors[hue(k)], dots ? 1.2 : 2.2, dots ? 0.5 : 1);
        if (dots) points.forEach((point) => disc(pen, point, clamped(width / xs.length / 4, 2, 6), hue(k)));
      });
      pen.fillStyle = colors.muted;
      image.width = WIDE; image.height = past.length;
      const values = new Float32Array(WIDE * past.length);
      past.forEach((row, k) => values.set(row, k * WIDE));
      paint(image.getContext("2d"), values, WIDE, past.length);
      pen.drawImage(image, left, split, width - left - right, height - split - 26);
      pen.textAlign = "center"; pen.textBaseline = "top";
      for (const mark of ticks(x0, x1, clamped(width / 110, 3, 8))) if (px(mark) < width - right - 18) pen.fillText(short(mark), px(mark), height - 20);
      pen.font = `italic 13px ${colors.sans}`;
      pen.fillText(names[0], width - right - 3, height - 20); pen.textAlign = "left";
      fields.forEach(({ name }, k) => { pen.fillStyle = colors[hue(k)]; pen.fillText(name, left + 6 + 22 * k, top - 4); });
      pen.fillStyle = colors.muted; pen.fillText("t", left - 16, split + 2);
    },
    plane(pen, u, width, height) {
      const n = xs.length, values = new Float32Array(200 * 200), [first, last] = bounds();
      // nodes are stored with the last axis contiguous
      along.forEach(([j, s], row) => across.forEach(([i, r], column) => {
        const at = i * ys.length + j, near = u[at] + s * (u[at + 1] - u[at]), far = u[at + ys.length] + s * (u[at + ys.length + 1] - u[at + ys.length]);
        values[(199 - row) * 200 + column] = near + r * (far - near);
      }));
      image.width = image.height = 200;
      paint(image.getContext("2d"), values, 200, 200);
      const [w, h] = [xs[n - 1] - xs[0], ys[ys.length - 1] - ys[0]], scale = Math.min((width - 150) / w, (height - 60) / h), [a, b] = [w * scale, h * scale], [x, y] = [(width - a) / 2 - 20, (height - b) / 2];
      pen.imageSmoothingEnabled = true; pen.drawImage(image, x, y, a, b);
      pen.strokeStyle = colors.edge; pen.lineWidth = 1; pen.strokeRect(x, y, a, b);
      pen.textAlign = "center"; pen.textBaseline = "top";
      for (const mark of ticks(xs[0], xs[n - 1], 4)) pen.fillText(short(mark), x + scale * (mark - xs[0]), y + b + 6);
      pen.textAlign = "right"; pen.textBaseline = "middle";
      for (const mark of ticks(ys[0], ys[ys.length - 1], 4)) pen.fillText(short(mark), x - 6, y + b - scale * (mark - ys[0]));
      const bar = [x + a + 18, y, 10, b];
      for (let k = 0; k < b; k++) { const c = color()[Math.round((255 * (b - k)) / b)]; pen.fillStyle = `rgb(${c & 255},${(c >> 8) & 255},${(c >> 16) & 255})`; pen.fillRect(bar[0], y + k, bar[2], 1.5); }
      pen.fillStyle = colors.muted; pen.textAlign = "left";
      for (const mark of ticks(first, last, 5)) pen.fillText(short(mark), bar[0] + 15, y + b - (b * (mark - first)) / (last - first));
      pen.textBaseline = "bottom"; pen.fillText(fields[0].name, bar[0], y - 5);
    },
    near() {},
  };
};
const picture = shape.mesh ? graph() : marked();

/** Returns round numbers between two bounds, about `wanted` of them. */
function ticks(low, high, wanted) {
  const rough = (high - low) / wanted, power = 10 ** Math.floor(Math.log10(rough)), part = rough / power;
  const step = (part < 1.5 ? 1 : part < 3.5 ? 2 : part < 7.5 ? 5 : 10) * power, result = [];
  for (let k = Math.ceil(low / step); k * step <= high && result.length < 20; k++) result.push(k * step);
  return result;
}
/** Returns a number as text of few characters, which can be read again. */
function compact(x, digits = 3) {
  const rounded = +x.toPrecision(digits);
  return x && (Math.abs(x) < 1e-3 || Math.abs(x) >= 1e6) ? rounded.toExponential().replace("e+", "e") : String(rounded);
}
/** Returns a number as text of few characters, to be read by people. */
const short = (x, digits = 3) => compact(x, digits).replace("-", "\u2212").replace("e-", "e\u2212").replace("e+", "e");
