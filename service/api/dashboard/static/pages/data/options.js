// How an uploaded file is to be read and prepared: a form that turns into the query of the upload.

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

/** The form. Returns {element, values(), fillRobots(robots)}; values: query of the upload. */
export function uploadOptions() {
  const inputs = {
    effort: select("effort", [["", "as the robot or the file says"], ...pairs(EFFORTS, ["measured", "commanded", "current"])]),
    torque_constants: text("torque_constants", "0.11, 0.11, 0.08"),
    torque_factors: text("torque_factors", "1, 1, -1"),
    torque_convention: select("torque_convention", [
      ["", "as the effort implies"],
      ["gravity_included", "gravity included"],
      ["gravity_compensated", "gravity compensated"],
    ]),
    joint_names: text("joint_names", "shoulder, elbow, wrist"),
    joints: text("joints", "all"),
    drop_joints: text("drop_joints", "gripper"),
    topic: text("topic", "/joint_states"),
    delimiter: select("delimiter", [["", "found out"], [",", "comma"], [";", "semicolon"], ["\t", "tab"], [" ", "space"]]),
    filtering: select("filtering", [
      ["", "if something is derived (default)"],
      ["always", "always"],
      ["never", "never"],
    ]),
    cutoff: amount("cutoff", "4", "0.01", "1000"),
    form: select("form", [["", "without delay (default)"], ["causal", "causal, as a live stream could be"]]),
    rate: amount("rate", "as recorded", "0.01", "1000000"),
    gap: amount("gap", "1.5", "1.01", "1000000"),
    trim: amount("trim", "the filter’s edges", "0", "1000000"),
  };
  let expected; // effort of the robot that was chosen
  const robot = robotSelect({
    none: "not said",
    onchange: (profile) => {
      expected = profile?.effort;
      showConstants();
    },
  });
  const columns = {}, units = {};
  const rows = QUANTITIES.map(([name, said, known]) => {
    columns[name] = text(`columns-${name}`, name === "q" ? "{joint}/position" : "found out", `Columns of ${said}`);
    const list = `units-of-${name}`;
    units[name] = text(`units-${name}`, known[0] ?? "", `Unit of ${said}`);
    if (known.length) units[name].setAttribute("list", list);
    return h(
      "tr",
      {},
      h("th", { scope: "row" }, h("code", {}, name), ` ${said}`),
      h("td", {}, columns[name]),
      h("td", {}, known.length ? units[name] : "–", known.length ? h("datalist", { id: list }, ...known.map(option)) : ""),
    );
  });

  const constants = field("Torque constants, N·m/A", inputs.torque_constants, "Of joints 1 to n, separated by commas.");
  const showConstants = () => {
    const current = (inputs.effort.value || expected) === "current";
    constants.hidden = !current && !inputs.torque_constants.value;
  };
  inputs.effort.addEventListener("change", showConstants);
  showConstants();

  const element = h(
    "details",
    { class: "options" },
    h("summary", {}, "How to read it: robot, units, columns, joints, effort, preparation"),
    h("p", { class: "hint" }, "Leave these empty to let the service find out. If it cannot be sure, it refuses the file and says what to add."),
    h("div", { class: "grid" },
      field("Robot", robot.select, "Its limits, joint order and the meaning of its effort."),
      field("What the torque column holds", inputs.effort, "A wrong answer here teaches a wrong torque."),
      constants,
      field("Torque factors", inputs.torque_factors, "By which the torques of joints 1 to n are multiplied: −1 where the sign is opposite."),
    ),
    robot.note,
    robot.add,
    h("h3", {}, "Columns and units"),
    h("div", { class: "scroll" }, h("table", {},
      h("caption", {}, "What the file calls its columns: a name, a pattern with {joint}, or names separated by commas"),
      h("thead", {}, h("tr", {}, ...["Quantity", "Columns", "Unit"].map((label) => h("th", { scope: "col" }, label)))),
      h("tbody", {}, ...rows),
    )),
    h("h3", {}, "Joints"),
    h("div", { class: "grid" },
      field("Names of joints 1 to n", inputs.joint_names, "Separated by commas, where the file has only numbers."),
      field("Joints to keep, in this order", inputs.joints, "Separated by commas; all by default."),
      field("Joints to leave out", inputs.drop_joints, "Grippers, and joints that are locked."),
    ),
    h("h3", {}, "Preparation"),
    h("p", { class: "hint" }, "Missing velocity and acceleration are derived with a low-pass and central differences. The report lists every step."),
    h("div", { class: "grid" },
      field("Low-pass the signals", inputs.filtering),
      field("Cut-off, Hz", inputs.cutoff),
      field("Form of the filter", inputs.form),
      field("Rate of the samples, Hz", inputs.rate),
      field("Steps longer than so many usual ones are gaps", inputs.gap),
      field("Cut off at both ends, s", inputs.trim),
      field("Torque convention", inputs.torque_convention),
      field("Topic", inputs.topic, "Of a bag, where several could be read."),
      field("Delimiter", inputs.delimiter, "Of a CSV."),
    ),
  );

  return {
    element,
    fillRobots: robot.fill,
    values: () => {
      const given = { robot: robot.select.value };
      for (const [name, input] of Object.entries(inputs)) given[name] = name === "delimiter" ? input.value : input.value.trim();
      given.columns = json(columns, names);
      given.units = json(units, (value) => value);
      return Object.fromEntries(Object.entries(given).filter(([, value]) => value !== ""));
    },
  };
}

/** Options with one more that the service proposed. */
export function withOption(values, option, value) {
  if (option === "drop_joints") return { ...values, drop_joints: [values.drop_joints, value].filter(Boolean).join(",") };
  return { ...values, [option]: JSON.stringify({ ...JSON.parse(values[option] ?? "{}"), ...value }) };
}

/** Options as a reader sees them: robot: ur5, units: q deg. */
export function inWords(values) {
  return Object.entries(values)
    .map(([name, value]) => `${name.replaceAll("_", " ")}: ${value.replace(/[{}"[\]]/g, "").replaceAll(":", " ")}`)
    .join("; ");
}

/** What was typed, as JSON by quantity; nothing where nothing was typed. */
function json(inputs, meaning) {
  const given = Object.entries(inputs).map(([name, input]) => [name, input.value.trim()]).filter(([, value]) => value);
  return given.length ? JSON.stringify(Object.fromEntries(given.map(([name, value]) => [name, meaning(value)]))) : "";
}

function names(value) {
  const parts = value.split(",").map((part) => part.trim()).filter(Boolean);
  return parts.length > 1 ? parts : parts[0];
}

function text(name, placeholder, label) {
  const input = h("input", { type: "text", name, placeholder, autocomplete: "off", spellcheck: "false" });
  if (!label) return input;
  input.setAttribute("aria-label", label);
  input.style.minWidth = "8rem"; // in a table, which scrolls where there is no room
  return input;
}

function amount(name, placeholder, min, max) {
  return h("input", { type: "number", name, placeholder, min, max, step: "any" });
}

function select(name, options) {
  return h("select", { name }, ...options.map(([value, said]) => h("option", { value }, said)));
}

function pairs(known, names) {
  return names.map((name) => [name, known[name]]);
}

function option(value) {
  return h("option", { value });
}
