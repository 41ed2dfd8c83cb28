// Sentences of the service, in the words of this dashboard: names of fields instead of command line flags.

import { html } from "./preact.js";

/** Labels of import options, by their names in the API. */
export const LABELS = {
  robot: "Robot", effort: "Meaning of the torque column", torque_constants: "Torque constants", torque_factors: "Torque factors",
  torque_convention: "Torque convention", columns: "Columns", units: "Units", joint_names: "Joint names", joints: "Joints to keep",
  drop_joints: "Joints to drop", topic: "Topic", column_names: "Column names", dt: "Time from row to row", poses: "Rows", delimiter: "Delimiter",
  filtering: "Low-pass filter", cutoff: "Cutoff frequency", form: "Filter type", rate: "Resampling rate", gap: "Min gap", trim: "Trim at both ends",
};
const FLAGS = { unit: "units", column: "columns", drop: "drop_joints" }; // names on the command line that differ

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
