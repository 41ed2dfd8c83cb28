// The estimators a user chooses from, with a line of explanation each.

import { h } from "../../dom.js";

/** [name, what it knows and when to use it, whether it can use a robot's URDF]. */
export const ESTIMATORS = [
  ["auto", "Trains the next three and takes the one that best predicts a held-out part. Two or three minutes.", true],
  ["rigid-body", "An arm of rigid bodies: learns its joint axes, masses and friction. For stiff arms.", true],
  ["lip-chain", "Lagrange's equations of a serial chain. For arms with springs, belts or links that bend.", false],
  ["rigid-body+lip-chain", "Both: the chain learns what rigid bodies miss. For much data.", true],
  ["lip", "The kernel of the paper, to get the paper's results.", false],
  ["se", "The paper's baseline: a squared exponential for each joint. To compare with.", false],
  ["gip", "The paper's baseline: a geometrically inspired polynomial. To compare with.", false],
  ["lse", "The paper's baseline: one squared exponential Lagrangian. To compare with.", false],
];

/** Radio buttons of the estimators. onchange(name, takesRobot). */
export function estimatorChoice(onchange) {
  return h(
    "fieldset",
    {},
    h("legend", {}, "Estimator"),
    h("p", { class: "hint" }, "What the model knows of physics before it sees data. All learn friction: viscous, Coulomb and an offset."),
    ESTIMATORS.map(([name, said, robot], index) =>
      h(
        "div",
        { class: "field check", style: "flex-wrap: nowrap" },
        h("input", { type: "radio", name: "estimator", id: `estimator-${index}`, value: name, checked: index === 0, onchange: () => onchange(name, robot) }),
        h("label", { for: `estimator-${index}` }, h("strong", {}, name), index ? "" : " (default)", h("span", { class: "hint" }, ` ${said}`)),
      ),
    ),
  );
}
