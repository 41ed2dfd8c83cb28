// Choice of the estimator, with an explanation of each.

import { html } from "../../preact.js";

/** [name, description, whether it can start from a robot]. */
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

/** Return whether an estimator can start from a robot's URDF. */
export function usesRobot(name) {
  return ESTIMATORS.find(([each]) => each === name)[2];
}

/** Radio buttons of the estimators. */
export function Estimators({ chosen, onchoose }) {
  const choice = ([name, description], index) => html`<div class="field check estimator" key=${name}>
    <input type="radio" name="estimator" id=${`estimator-${index}`} value=${name} checked=${name === chosen} onChange=${() => onchoose(name)} />
    <label for=${`estimator-${index}`}><strong>${name}</strong>${index === 0 && " (default)"} <span class="hint">${description}</span></label>
  </div>`;
  return html`<fieldset>
    <legend>Estimator</legend>
    <p class="hint">The physics that the model assumes. All estimators also learn friction.</p>
    ${ESTIMATORS.map(choice)}
  </fieldset>`;
}
