// The colours of pages that move, and the model file of a Lagrangian that the visitor types: coordinates are the names with a velocity, the others parameters.
"use strict";
document.addEventListener("DOMContentLoaded", () => {
  const frames = document.querySelectorAll(".motion iframe"), theme = () => document.body.dataset.theme || "auto";
  for (const frame of frames) frame.addEventListener("load", () => frame.contentWindow.postMessage(theme(), "*"));
  const tell = () => { for (const frame of frames) frame.contentWindow?.postMessage(theme(), "*"); };
  new MutationObserver(tell).observe(document.body, { attributes: true, attributeFilter: ["data-theme"] });
  const box = document.getElementById("own");
  if (!box) return;
  const [lagrangian, values] = box.querySelectorAll("textarea, div"), model = box.querySelector("pre"), note = box.querySelector(".note"), copy = box.querySelector("button");
  const FUNCTIONS = new Set("sin cos tan asin acos atan atan2 sinh cosh tanh asinh acosh atanh exp log sqrt rint unit_step wrap positive_part abs sign min max where pi t sum".split(" "));
  const numbers = {}; // by key, as typed

  /** Returns what is wrong with a formula in one line, or nothing. */
  function mistake(text, coordinates) {
    if (text.includes("^")) return "Write powers with **, as in x**2.";
    if ((text.match(/\(/g) || []).length !== (text.match(/\)/g) || []).length) return "Parentheses are not balanced.";
    if (!coordinates.length) return "No velocity was found: write the velocity of x as x_dot, as in m*x_dot**2/2.";
    return "";
  }
  function show() {
    const text = lagrangian.value.trim().replace(/\s+/g, " "), names = [...new Set(text.match(/\b[A-Za-z_]\w*/g) || [])];
    const coordinates = names.filter((name) => /.+_dot$/.test(name)).map((name) => name.slice(0, -4)).sort();
    const parameters = names.filter((name) => !name.endsWith("_dot") && !coordinates.includes(name) && !FUNCTIONS.has(name)).sort();
    const wanted = [...parameters.map((name) => [name, 1]), ...coordinates.map((name) => [name, 0.5]), ...coordinates.map((name) => [name + "_dot", 0])];
    const wrong = mistake(text, coordinates);
    note.textContent = wrong; note.hidden = !wrong;
    const labels = [...values.querySelectorAll("label")];
    labels.filter((label) => !wanted.some(([name]) => name === label.dataset.name)).forEach((label) => label.remove());
    for (const [name, value] of wanted) {
      if (labels.some((label) => label.dataset.name === name)) continue;
      const label = document.createElement("label"), input = document.createElement("input");
      label.dataset.name = name; label.append(name, " = ", input);
      Object.assign(input, { type: "number", step: "any", value: numbers[name] ?? value });
      input.addEventListener("input", () => { numbers[name] = input.value; show(); });
      values.append(label);
    }
    const number = (name) => { const x = Number(values.querySelector(`[data-name="${name}"] input`)?.value); return Number.isInteger(x) ? x.toFixed(1) : String(x); };
    const quoted = (list) => `[${list.map((name) => `"${name}"`).join(", ")}]`;
    model.textContent = wrong ? "" : [
      "[system]", 'name = "my system"', `coordinates = ${quoted(coordinates)}`, `lagrangian = ${JSON.stringify(text)}`, "",
      ...(parameters.length ? ["[parameters]", ...parameters.map((name) => `${name} = ${number(name)}`), ""] : []),
      "[initial]", `q = [${coordinates.map(number).join(", ")}]`, `q_dot = [${coordinates.map((name) => number(name + "_dot")).join(", ")}]`, "",
      "[run]", "step = 0.02", "span = 20.0", ""].join("\n");
    copy.disabled = Boolean(wrong);
  }
  lagrangian.addEventListener("input", show);
  copy.addEventListener("click", async () => {
    try { await navigator.clipboard.writeText(model.textContent); copy.textContent = "Copied"; }
    catch { const range = document.createRange(); range.selectNodeContents(model); getSelection().removeAllRanges(); getSelection().addRange(range); copy.textContent = "Selected"; }
    setTimeout(() => { copy.textContent = "Copy"; }, 1500);
  });
  show();
});
