// Steps of a job: those of each estimator that is tried, then those of the version.

import { html } from "../../preact.js";

const STEPS = [["geometry", "geometry"], ["hyperparameters", "fit"], ["posterior", "posterior"], ["evaluating", "evaluating"]];
const LAST = [["learning_curve", "learning curve"], ["all_rows", "training on all rows"], ["saving", "saving"]];
const STATES = { done: ["✓", "done"], current: ["◌", "now"], open: ["·", ""] };

/** The steps of one estimator. course: of `observe`; active: whether the job runs. */
export function Steps({ estimator, course, active }) {
  const { stages } = course.rows.get(estimator);
  const here = active && course.current.estimator === estimator;
  const order = STEPS.filter(([stage]) => stage !== "geometry" || stages.has(stage) || estimator === "rigid-body");
  // `auto` evaluates an estimator before it tries the next one
  const next = [...course.rows.keys()].at(-1) !== estimator || LAST.some(([stage]) => stage === course.current.stage);
  const past = (stage) => stages.has(stage) || (stage === "evaluating" && next && stages.has("posterior"));
  const state = (stage) => (here && course.current.stage === stage ? "current" : past(stage) ? "done" : "open");
  return html`<${List} label=${`Steps of ${estimator}`} steps=${order.map(([stage, label]) => [label, state(stage)])} />`;
}

/** The steps after all estimators. */
export function LastSteps({ course }) {
  const passed = LAST.findIndex(([stage]) => stage === course.current.stage);
  return html`<${List} label="Steps of the version" steps=${LAST.map(([, label], index) => [label, index === passed ? "current" : index < passed ? "done" : "open"])} />`;
}

function List({ label, steps }) {
  return html`<ol class="stepper" aria-label=${label}>${steps.map(([text, state]) => html`<li key=${text} class=${state} aria-current=${state === "current" ? "step" : undefined}>
    <span aria-hidden="true">${STATES[state][0]}</span> ${text}${STATES[state][1] && html`<span class="unseen">, ${STATES[state][1]}</span>`}
  </li>`)}</ol>`;
}
