// Findings about a recording, in the words of this dashboard: the worst first, with names of fields instead of command line flags.

import { Badge } from "../../components.js";
import { html } from "../../preact.js";

/** Labels of import options, by their names in the API. */
export const LABELS = {
  robot: "Robot", effort: "Meaning of the torque column", torque_constants: "Torque constants", torque_factors: "Torque factors",
  torque_convention: "Torque convention", columns: "Columns", units: "Units", joint_names: "Joint names", joints: "Joints to keep",
  drop_joints: "Joints to drop", topic: "Topic", column_names: "Column names", dt: "Time from row to row", poses: "Rows", delimiter: "Delimiter",
  filtering: "Low-pass filter", cutoff: "Cutoff frequency", form: "Filter type", rate: "Resampling rate", gap: "Min gap", trim: "Trim at both ends",
};
const SHORT = 40; // characters; after a shorter sentence, the next one is shown too
const FLAGS = { unit: "units", column: "columns", drop: "drop_joints" }; // names on the command line that differ

/** Describe options: Robot: ur5; Units: q deg. */
export function describeOptions(values) {
  return Object.entries(values)
    .map(([name, value]) => `${LABELS[name] ?? name}: ${value.replace(/[{}"[\]]/g, "").replaceAll(":", " ")}`)
    .join("; ");
}

/** A text of the service with its code in backticks; an option is shown as the field that sets it. */
export function Prose({ text }) {
  const shown = text.replaceAll("If it is one of `lipserve robots list`", "If it is in the list of the field `Robot`");
  return shown.split("`").map((part, index) => (index % 2 ? fieldNames(part) : part));
}

/** Return what a piece of code is called in a form: `--robot` and `robot=ur5` name the field “Robot”. */
function fieldNames(code) {
  const words = code.split(" ").map((word) => {
    const [, flag, value] = /^(?:--)?([a-z][a-z_-]*)(?:=(.+))?$/.exec(word) ?? [];
    const name = flag?.replaceAll("-", "_"), label = LABELS[name] ?? LABELS[FLAGS[name]];
    return label && (value ? `${label}: ${value}` : label);
  });
  if (words.every(Boolean)) return html`<strong>${words.join(", ")}</strong>`;
  return code === "Robot" ? html`<strong>Robot</strong>` : html`<code>${code}</code>`;
}

/** A list of texts of the service. */
export function Sentences({ texts }) {
  return html`<ul>${texts.map((text) => html`<li key=${text}><${Prose} text=${text} /></li>`)}</ul>`;
}

/** A banner with warnings, if there are any. */
export function Warnings({ texts }) {
  return texts.length > 0 && html`<section class="banner" aria-label="Warnings"><strong>Warnings</strong><${Sentences} texts=${texts} /></section>`;
}

/** The worst finding of a report in a sentence or two, with the number of others: a fault, then a warning, then advice. */
export function WorstFinding({ report }) {
  const all = [...new Set([...report.remedies.map((each) => each.text), ...report.warnings, ...report.advice])];
  if (!all.length) return html`<${Badge} state="no issues" kind="good" />`;
  // a remedy that only names the robot corrects no fault
  const fault = report.warnings.includes(all[0]) || report.remedies.some((each) => each.text === all[0] && each.cause !== "robot");
  const [first] = new RegExp(`^.{${SHORT},}?[.!?](?=\\s|$)`, "s").exec(all[0]) ?? [all[0]];
  return html`<div class="finding"><${Badge} state=${fault ? "warning" : "advice"} kind=${fault ? "warn" : "plain"} /> <${Prose} text=${first} />${all.length > 1 && html` <span class="muted">${all.length - 1} more</span>`}</div>`;
}
