// Learnt arm of a version: a 3-D drawing with an adjustable posture, and tables.

import { h, replace } from "../../dom.js";
import { number } from "../../format.js";
import { button, card, empty } from "../../ui.js";
import { AMBIGUITY_NOTE, drawable, drawing, LEGEND } from "../arm/drawing.js";
import { midRange } from "../arm/kinematics.js";
import { jointTable, massTable } from "../arm/tables.js";
import { saveC, saveUrdf } from "./export.js";

const STEPS = 200;
const DEGREES = 180 / Math.PI;

/** Draw the tab. */
export async function arm(view, { name, version }, { signal }) {
  const { parameters } = version;
  if (!parameters.inertia) {
    replace(view, empty("This version has no arm: its estimator does not learn rigid bodies. Train a version with the estimator rigid-body."));
    return;
  }
  const place = h("div", {}), start = midRange(version.training_range);
  const figure = drawable() ? place : h("p", { class: "hint" }, "3-D drawing is not available: WebGL is off in this browser. The tables contain the same values.");
  const posture = h("div", {});
  replace(
    view,
    card(
      "Learnt arm",
      figure,
      h("p", { class: "hint" }, `${AMBIGUITY_NOTE} ${LEGEND}${orientationNote(parameters.geometry.gravity)}`),
      posture,
      h(
        "div",
        { class: "actions" },
        button("Save as URDF", () => saveUrdf(name, version.version)),
        version.estimator === "rigid-body" ? button("Save as C", () => saveC(name, version.version)) : null,
      ),
    ),
    card("Parameters", jointTable(version), massTable(version), h("p", { class: "hint" }, `Masses are the physically consistent ones nearest to the estimate${deviationNote(parameters.inertia)}. Values as trained, without online learning.`)),
  );
  if (figure !== place) return;
  const { draw } = await drawing(place, version, start, { signal });
  replace(posture, sliders(version, start, skipStale(draw)));
}

/** Create a slider for each joint within its training range. move(q) is called with all positions. */
function sliders({ joint_names: names, joint_types: types, training_range: { q: range } }, start, move) {
  const q = [...start];
  const text = (joint) => (types[joint] === "prismatic" ? `${q[joint].toFixed(3)} m` : `${(q[joint] * DEGREES).toFixed(1)}°`);
  const made = names.map((name, joint) => {
    const [low, high] = [range.min[joint], range.max[joint]];
    const shown = h("output", { class: "muted" }, text(joint));
    const input = h("input", { type: "range", min: low, max: high, step: (high - low) / STEPS || "any", value: q[joint], "aria-label": `Position of ${name}` });
    const update = () => {
      input.setAttribute("aria-valuetext", text(joint));
      shown.textContent = text(joint);
    };
    input.addEventListener("input", () => {
      q[joint] = Number(input.value);
      update();
      move([...q]);
    });
    update();
    const back = () => {
      q[joint] = start[joint];
      input.value = String(start[joint]);
      update();
    };
    return { back, element: h("div", { class: "field" }, h("span", { "aria-hidden": "true" }, `${name} `, shown), input) };
  });
  const back = button("Reset posture", () => {
    made.forEach((each) => each.back());
    move([...q]);
  });
  return h("details", {}, h("summary", {}, "Change posture"), h("div", { class: "grid" }, made.map((each) => each.element)), back);
}

/** Return a function that runs `work` one call at a time and skips all waiting calls but the last. */
function skipStale(work) {
  let [busy, next] = [false, null];
  return async (value) => {
    next = value;
    if (busy) return;
    busy = true;
    try {
      while (next !== null) {
        const now = next;
        next = null;
        await work(now);
      }
    } finally {
      busy = false;
    }
  };
}

function deviationNote({ plausible_deviation: deviation }) {
  return deviation?.some(Boolean) ? `; their torque differs by up to ${number(Math.max(...deviation), 2)} N·m (RMS, worst joint)` : "";
}

function orientationNote(gravity) {
  if (!Math.hypot(...gravity)) return " The torque does not include gravity, so the orientation of the base is unknown.";
  return Math.hypot(gravity[0], gravity[1]) > 1e-6 || gravity[2] > 0 ? " It is rotated so that gravity points downwards." : "";
}
