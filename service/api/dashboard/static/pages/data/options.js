// Form with the options for reading and preparing a file; its values are the query of the upload.

import { h } from "../../dom.js";
import { field } from "../../ui.js";
import { EFFORTS, robotSelect } from "./robots.js";

const QUANTITIES = [
  ["t", "time", ["s", "ms", "us", "ns", "min"]],
  ["q", "position", ["rad", "deg", "mrad", "rev", "m", "mm"]],
  ["dq", "velocity", ["rad/s", "deg/s", "rev/s", "rpm", "m/s", "mm/s"]],
  ["ddq", "acceleration", ["rad/s^2", "deg/s^2", "rev/s^2", "m/s^2", "mm/s^2"]],
  ["tau", "torque", ["N*m", "mN*m", "N*cm", "N*mm", "kgf*cm", "A", "mA"]],
  ["episode", "episode", []],
];

/** Create the form. Returns {element, fill(query), values(), fillRobots(robots)}; values(): query of the upload. */
export function uploadOptions() {
  const inputs = {
    effort: select("effort", [["", "default of the robot or the file"], ...pairs(EFFORTS, ["measured", "commanded", "current"])]),
    torque_constants: textInput("torque_constants", "0.11, 0.11, 0.08"),
    torque_factors: textInput("torque_factors", "1, 1, -1"),
    torque_convention: select("torque_convention", [
      ["", "derived from the effort"],
      ["gravity_included", "gravity included"],
      ["gravity_compensated", "gravity compensated"],
    ]),
    joint_names: textInput("joint_names", "shoulder, elbow, wrist"),
    joints: textInput("joints", "all"),
    drop_joints: textInput("drop_joints", "gripper"),
    topic: textInput("topic", "/joint_states"),
    column_names: textInput("column_names", "t,q1..q7,tau1..tau7"),
    dt: numberInput("dt", "from the file", "0.000001", "100"),
    poses: select("poses", [["", "motion"], ["true", "held poses, one a row"]]),
    delimiter: select("delimiter", [["", "auto-detect"], [",", "comma"], [";", "semicolon"], ["\t", "tab"], [" ", "space"]]),
    filtering: select("filtering", [
      ["", "only if signals are derived (default)"],
      ["always", "always"],
      ["never", "never"],
    ]),
    cutoff: numberInput("cutoff", "4", "0.01", "1000"),
    form: select("form", [["", "zero-phase (default)"], ["causal", "causal, as in a live stream"]]),
    rate: numberInput("rate", "as recorded", "0.01", "1000000"),
    gap: numberInput("gap", "1.5", "1.01", "1000000"),
    trim: numberInput("trim", "edges affected by the filter", "0", "1000000"),
  };
  let expected; // effort of the chosen robot
  const robot = robotSelect({
    none: "unspecified",
    onchange: (profile) => {
      expected = profile?.effort;
      showConstants();
    },
  });
  const columns = {}, units = {};
  const rows = QUANTITIES.map(([name, label, known]) => {
    columns[name] = textInput(`columns-${name}`, name === "q" ? "{joint}/position" : "auto-detect", `Columns of ${label}`);
    const list = `units-of-${name}`;
    units[name] = textInput(`units-${name}`, known[0] ?? "", `Unit of ${label}`);
    if (known.length) units[name].setAttribute("list", list);
    return h(
      "tr",
      {},
      h("th", { scope: "row" }, h("code", {}, name), ` ${label}`),
      h("td", {}, columns[name]),
      h("td", {}, known.length ? units[name] : "–", known.length ? h("datalist", { id: list }, ...known.map(option)) : ""),
    );
  });

  const constants = field("Torque constants, N·m/A", inputs.torque_constants, "One for each joint, separated by commas.");
  const showConstants = () => {
    const current = (inputs.effort.value || expected) === "current";
    constants.hidden = !current && !inputs.torque_constants.value;
  };
  inputs.effort.addEventListener("change", showConstants);
  showConstants();

  const element = h(
    "details",
    { class: "options" },
    h("summary", {}, "Import options: robot, units, columns, joints, effort, preparation"),
    h("p", { class: "hint" }, "Leave fields empty to auto-detect them. If that is ambiguous, the upload is rejected with a message that names the missing option."),
    h("div", { class: "grid" },
      field("Robot", robot.select, "Provides limits, joint order and the meaning of the effort."),
      field("Meaning of the torque column", inputs.effort, "With a wrong choice, the model learns a wrong torque."),
      constants,
      field("Torque factors", inputs.torque_factors, "One for each joint; they multiply the torque. Use −1 to reverse the sign."),
    ),
    robot.note,
    robot.add,
    h("h3", {}, "Columns and units"),
    h("div", { class: "scroll" }, h("table", {},
      h("caption", {}, "Column names of the file: a name, a pattern with {joint}, or names separated by commas"),
      h("thead", {}, h("tr", {}, ...["Quantity", "Columns", "Unit"].map((label) => h("th", { scope: "col" }, label)))),
      h("tbody", {}, ...rows),
    )),
    h("h3", {}, "Joints"),
    h("div", { class: "grid" },
      field("Joint names", inputs.joint_names, "Required if the file numbers its joints. Separate them with commas."),
      field("Joints to keep, in this order", inputs.joints, "Separate them with commas. Default: all."),
      field("Joints to drop", inputs.drop_joints, "For example grippers and locked joints."),
    ),
    h("h3", {}, "Preparation"),
    h("p", { class: "hint" }, "Missing velocity and acceleration are derived with a low-pass filter and central differences. The report lists every step."),
    h("div", { class: "grid" },
      field("Low-pass filter", inputs.filtering),
      field("Cutoff frequency, Hz", inputs.cutoff),
      field("Filter type", inputs.form),
      field("Resampling rate, Hz", inputs.rate),
      field("Min gap, in median time steps", inputs.gap),
      field("Trim at both ends, s", inputs.trim),
      field("Torque convention", inputs.torque_convention),
      field("Topic", inputs.topic, "Required if several topics of a bag can be read. Topics separated by commas are merged by time."),
      field("Time from row to row, s", inputs.dt, "For files without times."),
      field("Rows", inputs.poses, "Held poses need no times and velocities."),
      field("Column names", inputs.column_names, "For text without a header."),
      field("Delimiter", inputs.delimiter, "For CSV files."),
    ),
  );

  return {
    element,
    fillRobots: robot.fill,
    fill: (given) => {
      robot.choose(given.robot ?? "");
      for (const [name, input] of Object.entries(inputs)) input.value = given[name] ?? "";
      for (const [json, of] of [[given.columns, columns], [given.units, units]])
        for (const [name, what] of Object.entries(JSON.parse(json ?? "{}"))) of[name].value = [what].flat().join(", ");
      showConstants();
    },
    values: () => {
      const given = { robot: robot.select.value };
      for (const [name, input] of Object.entries(inputs)) given[name] = name === "delimiter" ? input.value : input.value.trim();
      given.columns = json(columns, names);
      given.units = json(units, (value) => value);
      return Object.fromEntries(Object.entries(given).filter(([, value]) => value !== ""));
    },
  };
}

/** Add an option that the service proposed. */
export function withOption(values, option, value) {
  if (option === "drop_joints") return { ...values, drop_joints: [values.drop_joints, value].filter(Boolean).join(",") };
  return { ...values, [option]: JSON.stringify({ ...JSON.parse(values[option] ?? "{}"), ...value }) };
}

/** Describe options: robot: ur5, units: q deg. */
export function describeOptions(values) {
  return Object.entries(values)
    .map(([name, value]) => `${name.replaceAll("_", " ")}: ${value.replace(/[{}"[\]]/g, "").replaceAll(":", " ")}`)
    .join("; ");
}

/** Return the entered values as JSON by quantity; an empty text if there are none. */
function json(inputs, meaning) {
  const given = Object.entries(inputs).map(([name, input]) => [name, input.value.trim()]).filter(([, value]) => value);
  return given.length ? JSON.stringify(Object.fromEntries(given.map(([name, value]) => [name, meaning(value)]))) : "";
}

function names(value) {
  const parts = value.split(",").map((part) => part.trim()).filter(Boolean);
  return parts.length > 1 ? parts : parts[0];
}

function textInput(name, placeholder, label) {
  const input = h("input", { type: "text", name, placeholder, autocomplete: "off", spellcheck: "false" });
  if (!label) return input;
  input.setAttribute("aria-label", label);
  input.style.minWidth = "8rem"; // the table scrolls if it is too narrow
  return input;
}

function numberInput(name, placeholder, min, max) {
  return h("input", { type: "number", name, placeholder, min, max, step: "any" });
}

function select(name, options) {
  return h("select", { name }, ...options.map(([value, label]) => h("option", { value }, label)));
}

function pairs(known, names) {
  return names.map((name) => [name, known[name]]);
}

function option(value) {
  return h("option", { value });
}
