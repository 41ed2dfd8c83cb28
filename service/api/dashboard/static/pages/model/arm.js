// The tab of the arm that a version has learnt: drawn at a posture that can be changed, and in numbers.

import { h, replace } from "../../dom.js";
import { number } from "../../format.js";
import { button, card, empty } from "../../ui.js";
import { CANNOT, drawable, drawing, LEGEND } from "../arm/drawing.js";
import { middle } from "../arm/kinematics.js";
import { jointTable, massTable } from "../arm/tables.js";
import { saveC, saveUrdf } from "./export.js";

const STEPS = 200;
const DEGREES = 180 / Math.PI;

/** The tab. */
export async function arm(view, { name, version }, { signal }) {
  const { parameters } = version;
  if (!parameters.inertia) {
    replace(view, empty("This version has no arm to draw. Its estimator has no rigid bodies: train one with the estimator rigid-body."));
    return;
  }
  const place = h("div", {}), start = middle(version.training_range);
  const figure = drawable() ? place : h("p", { class: "hint" }, "This browser cannot draw in 3-D (WebGL is off). The tables hold the same numbers.");
  const posture = h("div", {});
  replace(
    view,
    card(
      "The arm",
      figure,
      h("p", { class: "hint" }, `${CANNOT} ${LEGEND}${upturned(parameters.geometry.gravity)}`),
      posture,
      h(
        "div",
        { class: "actions" },
        button("Save as URDF", () => saveUrdf(name, version.version)),
        version.estimator === "rigid-body" ? button("Save as C", () => saveC(name, version.version)) : null,
      ),
    ),
    card("In numbers", jointTable(version), massTable(version), h("p", { class: "hint" }, `Masses are the physically possible ones nearest to what was learnt${off(parameters.inertia)}. All as trained, without what was learnt online.`)),
  );
  if (figure !== place) return;
  const { draw } = await drawing(place, version, start, { signal });
  replace(posture, sliders(version, start, latest(draw)));
}

/** A slider a joint, within the training range. move(q) is called with all positions. */
function sliders({ joint_names: names, joint_types: types, training_range: { q: range } }, start, move) {
  const q = [...start];
  const text = (joint) => (types[joint] === "prismatic" ? `${q[joint].toFixed(3)} m` : `${(q[joint] * DEGREES).toFixed(1)}°`);
  const made = names.map((name, joint) => {
    const [low, high] = [range.min[joint], range.max[joint]];
    const shown = h("output", { class: "muted" }, text(joint));
    const input = h("input", { type: "range", min: low, max: high, step: (high - low) / STEPS || "any", value: q[joint], "aria-label": `Position of ${name}` });
    const tell = () => {
      input.setAttribute("aria-valuetext", text(joint));
      shown.textContent = text(joint);
    };
    input.addEventListener("input", () => {
      q[joint] = Number(input.value);
      tell();
      move([...q]);
    });
    tell();
    const back = () => {
      q[joint] = start[joint];
      input.value = String(start[joint]);
      tell();
    };
    return { back, element: h("div", { class: "field" }, h("span", { "aria-hidden": "true" }, `${name} `, shown), input) };
  });
  const back = button("Back to the middle", () => {
    made.forEach((each) => each.back());
    move([...q]);
  });
  return h("details", {}, h("summary", {}, "Posture: the middle of the training range"), h("div", { class: "grid" }, made.map((each) => each.element)), back);
}

/** The same function, called again only once it is done, with what was asked for last. */
function latest(work) {
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

function off({ plausible_deviation: deviation }) {
  return deviation?.some(Boolean) ? `; their torque differs by at most ${number(Math.max(...deviation), 2)} N·m (root mean square, worst joint)` : "";
}

function upturned(gravity) {
  if (!Math.hypot(...gravity)) return " Its torque is without gravity, so how the base stands is unknown.";
  return Math.hypot(gravity[0], gravity[1]) > 1e-6 || gravity[2] > 0 ? " It is turned so that gravity points downwards." : "";
}
