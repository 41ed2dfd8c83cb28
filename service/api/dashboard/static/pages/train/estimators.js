// The estimators a user chooses from, with a line of explanation each: two at first, all others behind “More”.

import { h } from "../../dom.js";

/** [name, what it knows and when to use it, whether it can use a robot's URDF]. */
export const ESTIMATORS = [
  ["auto", "Compares rigid-body and lip-chain on held-out motion. Keeps the simplest unless another one is surely better. Up to three minutes.", true],
  ["rigid-body", "An arm of rigid bodies: learns its joint axes, masses and friction. For stiff arms.", true],
  ["rigid-body+local", "The same, corrected near the recorded motion. For robots that repeat it.", true],
  ["lip-chain", "Lagrange's equations of a serial chain. For arms with springs, belts or links that bend.", false],
  ["rigid-body+lip-chain", "Both: the chain learns what rigid bodies miss. For much data.", true],
  ["lip", "The kernel of the paper, to get the paper's results.", false],
  ["se", "The paper's baseline: a squared exponential for each joint. To compare with.", false],
  ["gip", "The paper's baseline: a geometrically inspired polynomial. To compare with.", false],
  ["lse", "The paper's baseline: one squared exponential Lagrangian. To compare with.", false],
];
const FIRST = 2;

/** Radio buttons of the estimators; onchange(name, takesRobot). Returns {element, robot(name)}: which robot rigid-body would begin with, "" for none. */
export function estimatorChoice(onchange) {
  const begins = h("span", {});
  const made = ESTIMATORS.map(([name, said, robot], index) =>
    h(
      "div",
      { class: "field check estimator" },
      h("input", { type: "radio", name: "estimator", id: `estimator-${index}`, value: name, checked: index === 0, onchange: () => onchange(name, robot) }),
      h("label", { for: `estimator-${index}` }, h("strong", {}, name), name === "rigid-body" ? begins : null, index ? "" : " (default)", h("span", { class: "hint" }, ` ${said}`)),
    ),
  );
  const element = h(
    "fieldset",
    {},
    h("legend", {}, "Estimator"),
    h("p", { class: "hint" }, "What the model knows of physics before it sees data. All learn friction too."),
    made.slice(0, FIRST),
    h("details", {}, h("summary", {}, "More estimators"), made.slice(FIRST)),
  );
  return {
    element,
    robot(name) {
      begins.textContent = name ? ` with ${name}` : "";
    },
  };
}
