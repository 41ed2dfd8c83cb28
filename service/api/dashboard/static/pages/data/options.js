// Form with the options for reading and preparing a file; `queryOf` makes the query of the upload.

import { Field } from "../../components.js";
import { html } from "../../preact.js";
import { LABELS } from "../../prose.js";
import { EFFORTS, RobotChoice } from "./robot_choice.js";

const QUANTITIES = [
  ["t", "time", ["s", "ms", "us", "ns", "min"]],
  ["q", "position", ["rad", "deg", "mrad", "rev", "m", "mm"]],
  ["dq", "velocity", ["rad/s", "deg/s", "rev/s", "rpm", "m/s", "mm/s"]],
  ["ddq", "acceleration", ["rad/s^2", "deg/s^2", "rev/s^2", "m/s^2", "mm/s^2"]],
  ["tau", "torque", ["N*m", "mN*m", "N*cm", "N*mm", "kgf*cm", "A", "mA"]],
  ["episode", "episode", []],
];
const EFFORT = [["", "of robot or file (default)"], ...["measured", "commanded", "current"].map((each) => [each, EFFORTS[each]])];
const SELECTS = {
  effort: EFFORT,
  torque_convention: [["", "derived from the effort"], ["gravity_included", "gravity included"], ["gravity_compensated", "gravity compensated"]],
  poses: [["", "motion"], ["true", "held poses, one a row"]],
  delimiter: [["", "auto-detect"], [",", "comma"], [";", "semicolon"], ["\t", "tab"], [" ", "space"]],
  filtering: [["", "if derived (default)"], ["always", "always"], ["never", "never"]],
  form: [["", "zero-phase (default)"], ["causal", "causal, as in a live stream"]],
};
const NUMBERS = { dt: [0.000001, 100], cutoff: [0.01, 1000], rate: [0.01, 1000000], gap: [1.01, 1000000], trim: [0, 1000000] };
const UNITS = { torque_constants: "N·m/A", cutoff: "Hz", rate: "Hz", gap: "in median time steps", trim: "s", dt: "s" };
const EXAMPLES = {
  torque_constants: "0.11, 0.11, 0.08", torque_factors: "1, 1, -1", joint_names: "shoulder, elbow, wrist", joints: "all", drop_joints: "gripper", topic: "/joint_states",
  column_names: "t,q1..q7,tau1..tau7", dt: "from the file", cutoff: "4", rate: "as recorded", gap: "1.5", trim: "edges affected by the filter",
};
const HINTS = {
  effort: "With a wrong choice, the model learns a wrong torque.",
  torque_constants: "One for each joint, separated by commas.",
  torque_factors: "One for each joint; they multiply the torque. Use −1 to reverse the sign.",
  joint_names: "Required if the file numbers its joints. Separate them with commas.",
  joints: "In this order. Separate them with commas.",
  drop_joints: "For example grippers and locked joints.",
  topic: "Required if several topics of a bag can be read. Topics separated by commas are merged by time.",
  dt: "For files without times.",
  poses: "Held poses need no times and velocities.",
  column_names: "For text without a header.",
  delimiter: "For CSV files.",
};
const JOINTS = ["joint_names", "joints", "drop_joints"];
const PREPARATION = ["filtering", "cutoff", "form", "rate", "gap", "trim", "torque_convention", "topic", "dt", "poses", "column_names", "delimiter"];

/** The form. value: {option: text, columns: {quantity: text}, units: {quantity: text}}; robots: of `readRobots` by `useRead`. */
export function ImportOptions({ value, onchange, robots }) {
  const set = (name, text) => onchange({ ...value, [name]: text });
  const field = (name) => html`<${Option} key=${name} name=${name} value=${value[name] ?? ""} onchange=${(text) => set(name, text)} />`;
  const profile = robots.value?.profiles.find((each) => each.name === value.robot);
  const current = (value.effort || profile?.effort) === "current" || value.torque_constants;
  return html`<div class="options">
    <p class="hint">Leave fields empty to auto-detect them. If that is ambiguous, the upload is rejected with a message that names the missing option.</p>
    <${RobotChoice} reading=${robots} value=${value.robot ?? ""} onchange=${(robot) => set("robot", robot)} none="unspecified" hint="Provides limits, joint order and the meaning of the effort." />
    <div class="grid">${["effort", ...(current ? ["torque_constants"] : []), "torque_factors"].map(field)}</div>
    <h3>Columns and units</h3>
    <${Columns} value=${value} onchange=${onchange} />
    <h3>Joints</h3>
    <div class="grid">${JOINTS.map(field)}</div>
    <h3>Preparation</h3>
    <p class="hint">Missing velocity and acceleration are derived with a low-pass filter and central differences. The report lists every step.</p>
    <div class="grid">${PREPARATION.map(field)}</div>
  </div>`;
}

function Option({ name, value, onchange }) {
  const input = (attributes) => {
    const shared = { ...attributes, name, value };
    if (SELECTS[name]) return html`<select ...${shared} onChange=${(event) => onchange(event.target.value)}>${SELECTS[name].map(([each, label]) => html`<option value=${each} selected=${each === value}>${label}</option>`)}</select>`;
    const [min, max] = NUMBERS[name] ?? [];
    const kind = NUMBERS[name] ? { type: "number", min, max, step: "any" } : { type: "text", autocomplete: "off", spellcheck: false };
    return html`<input ...${shared} ...${kind} placeholder=${EXAMPLES[name]} onInput=${(event) => onchange(event.target.value)} />`;
  };
  return html`<${Field} label=${[LABELS[name], UNITS[name]].filter(Boolean).join(", ")} hint=${HINTS[name]} input=${input} />`;
}

/** Names of columns and units by quantity. */
function Columns({ value, onchange }) {
  const input = (kind, quantity, label, more) => html`<input type="text" name=${`${kind}-${quantity}`} aria-label=${label} autocomplete="off" spellcheck=${false} ...${more}
    value=${value[kind]?.[quantity] ?? ""} onInput=${(event) => onchange({ ...value, [kind]: { ...value[kind], [quantity]: event.target.value } })} />`;
  const row = ([quantity, label, known]) => html`<tr key=${quantity}>
    <th scope="row"><code>${quantity}</code> ${label}</th>
    <td>${input("columns", quantity, `Columns of ${label}`, { placeholder: quantity === "q" ? "{joint}/position" : "auto-detect" })}</td>
    <td>${known.length ? input("units", quantity, `Unit of ${label}`, { placeholder: known[0], list: `units-of-${quantity}` }) : "–"}
      ${known.length > 0 && html`<datalist id=${`units-of-${quantity}`}>${known.map((each) => html`<option key=${each} value=${each} />`)}</datalist>`}</td>
  </tr>`;
  return html`<div class="scroll" tabindex="0" role="region" aria-label="Columns and units"><table>
    <caption>Column names of the file: a name, a pattern with {joint}, or names separated by commas</caption>
    <thead><tr>${["Quantity", "Columns", "Unit"].map((label) => html`<th scope="col">${label}</th>`)}</tr></thead>
    <tbody>${QUANTITIES.map(row)}</tbody>
  </table></div>`;
}

/** Return the value of the form for a query of an upload. */
export function valueOf(query) {
  const texts = (json) => Object.fromEntries(Object.entries(JSON.parse(json ?? "{}")).map(([name, what]) => [name, [what].flat().join(", ")]));
  return { ...query, columns: texts(query.columns), units: texts(query.units) };
}

/** Return the query of an upload: only what was entered. */
export function queryOf({ columns, units, ...others }) {
  const trimmed = Object.entries(others).map(([name, text]) => [name, name === "delimiter" ? text : text.trim()]);
  const given = [...trimmed, ["columns", json(columns, names)], ["units", json(units, (text) => text)]];
  return Object.fromEntries(given.filter(([, text]) => text !== ""));
}

/** Add an option that the service proposed. */
export function withOption(query, option, value) {
  if (option === "drop_joints") return { ...query, drop_joints: [query.drop_joints, value].filter(Boolean).join(",") };
  return { ...query, [option]: JSON.stringify({ ...JSON.parse(query[option] ?? "{}"), ...value }) };
}

/** Return the entered texts as JSON by quantity; an empty text if there are none. */
function json(texts, meaning) {
  const given = Object.entries(texts ?? {}).map(([name, text]) => [name, text.trim()]).filter(([, text]) => text);
  return given.length ? JSON.stringify(Object.fromEntries(given.map(([name, text]) => [name, meaning(text)]))) : "";
}

function names(text) {
  const parts = text.split(",").map((part) => part.trim()).filter(Boolean);
  return parts.length > 1 ? parts : parts[0];
}
