// Choice of the estimator, with an explanation of each: two are visible, the others under “More estimators”.

import { h } from "../../dom.js";

/** [name, description, whether it can use a robot's URDF]. */
export const ESTIMATORS = [
  ["auto", "Compares rigid-body and lip-chain on held-out motion. Chooses the simplest unless another one is significantly better. Takes up to three minutes.", true],
  ["rigid-body", "Rigid bodies: learns joint axes, masses and friction. For stiff arms.", true],
  ["rigid-body+local", "rigid-body with a local correction near the recorded motion. For robots with repetitive motion.", true],
  ["lip-chain", "Lagrange's equations of a serial chain. For arms with springs, belts or links that bend.", false],
  ["rigid-body+lip-chain", "rigid-body, with lip-chain for its residuals. For large data sets.", true],
  ["lip", "The kernel of the paper, to reproduce its results.", false],
  ["se", "Baseline of the paper: a squared exponential for each joint.", false],
  ["gip", "Baseline of the paper: a geometrically inspired polynomial.", false],
  ["lse", "Baseline of the paper: one squared exponential Lagrangian.", false],
];
const VISIBLE_COUNT = 2;

/** Create radio buttons; onchange(name, usesRobot). Returns {element, robot(name)}, which shows the robot that rigid-body starts from, "" for none. */
export function estimatorChoice(onchange) {
  const startRobot = h("span", {});
  const made = ESTIMATORS.map(([name, description, robot], index) =>
    h(
      "div",
      { class: "field check estimator" },
      h("input", { type: "radio", name: "estimator", id: `estimator-${index}`, value: name, checked: index === 0, onchange: () => onchange(name, robot) }),
      h("label", { for: `estimator-${index}` }, h("strong", {}, name), name === "rigid-body" ? startRobot : null, index ? "" : " (default)", h("span", { class: "hint" }, ` ${description}`)),
    ),
  );
  const element = h(
    "fieldset",
    {},
    h("legend", {}, "Estimator"),
    h("p", { class: "hint" }, "The physics that the model assumes. All estimators also learn friction."),
    made.slice(0, VISIBLE_COUNT),
    h("details", {}, h("summary", {}, "More estimators"), made.slice(VISIBLE_COUNT)),
  );
  return {
    element,
    robot(name) {
      startRobot.textContent = name ? ` with ${name}` : "";
    },
  };
}
