// Tables of a learnt arm: masses and friction, joint axes, and unidentifiable parameters.

import { Table } from "../../components.js";
import { number, shortNames } from "../../format.js";
import { Joint } from "../../jointbars.js";
import { html } from "../../preact.js";
import { frames, massCentres } from "./kinematics.js";

const DEGREES = 180 / Math.PI;
/** Parameters of the drive in `parameters.friction`, and their columns. Those after the third are shown if a joint has them. */
const DRIVE = [
  ["viscous", "Viscous, N·m·s"], ["coulomb", "Coulomb, N·m"], ["offset", "Offset, N·m"],
  ["stribeck", "Stribeck, N·m"], ["position", "Varying over a turn, N·m"], ["load", "Share of the load"], ["gain", "Gain error"],
  ["breakaway", "Breakaway, N·m"], ["stiffness", "Presliding, N·m/rad"],
];
const ALWAYS = 3;

/** A table with the mass and the friction of each joint, from base to tip. */
export function ParameterTable({ version: { joint_names: names, joint_types: types, parameters } }) {
  const { geometry, inertia, rotor, friction } = parameters;
  const short = shortNames(names);
  const pair = (label, { mean, std }) => ({ label, numeric: true, cell: (joint) => html`<${Pair} mean=${mean[joint]} std=${std[joint]} />` });
  const known = DRIVE.filter(([name]) => friction[name]);
  const shown = known.filter(([name], index) => index < ALWAYS || friction[name].mean.some((mean, joint) => isClear(mean, friction[name].std[joint])));
  const unclear = known.filter((each) => !shown.includes(each)).map(([, label]) => label.replace(/,.*/, "").toLowerCase());
  const columns = [
    { label: "Joint", cell: (joint) => html`<${Joint} index=${joint} name=${short[joint]} />` },
    ...(inertia ? [pair("Mass, kg", { mean: inertia.bodies.map((each) => each.plausible.mass), std: inertia.bodies.map((each) => each.std.mass) })] : []),
    ...(rotor ? [pair("Rotor, kg·m²", rotor)] : []),
    ...shown.map(([name, label]) => pair(label, friction[name])),
  ];
  const sliding = types.includes("prismatic") ? "; prismatic joints: kg, N·s/m and N" : "";
  return html`<div class="dense">
    <${Table} columns=${columns} rows=${geometry?.order ?? names.map((_name, joint) => joint)} caption=${`From base to tip; ±: one standard deviation${sliding}`} />
    ${unclear.length > 0 && html`<p class="hint">Within two standard deviations of zero for all joints: ${unclear.join(", ")}.</p>`}
  </div>`;
}

/** A table of the joint axes and centres of mass, from base to tip, and of what the recording does not determine. */
export function AxisTable({ version: { joint_names: names, parameters: { geometry, inertia } } }) {
  const short = shortNames(names), zero = frames(geometry, names.map(() => 0)), centre = massCentres(inertia);
  const stds = (values, factor) => values.map((each) => number(each * factor, 2)).join(", ") || "–";
  const { order, joints } = geometry, numeric = (label, cell) => ({ label, numeric: true, cell });
  const unknown = (place) => [...joints[place].undetermined, ...(inertia.bodies[order[place]].undetermined ?? [])].map((each) => each.replace("_", " ")).join(", ");
  const columns = [
    { label: "Joint", cell: (place) => html`<${Joint} index=${order[place]} name=${short[order[place]]} />` },
    { label: "Type", cell: (place) => joints[place].type },
    numeric("Axis", (place) => vector(zero[place].axis)),
    numeric("Position, m", (place) => vector(zero[place].origin)),
    numeric("± turn, °", (place) => stds(joints[place].turn_std, DEGREES)),
    numeric("± shift, mm", (place) => stds(joints[place].shift_std, 1000)),
    numeric("Centre of mass, m", (place) => vector(centre[order[place]])),
    numeric("±, mm", (place) => spread(inertia.bodies[order[place]], centre[order[place]]).map((each) => number(1000 * each, 2)).join(", ")),
    { label: "Unidentifiable", term: "identifiability", cell: (place) => unknown(place) || "–" },
  ];
  return html`<div class="dense"><${Table} columns=${columns} rows=${joints.map((_joint, place) => place)} caption="Axes in the base frame, with all positions at zero; centres of mass in the frames of their joints; ±: one standard deviation" /></div>`;
}

/** A value with its standard deviation, grey if it is not significant. A value far below its deviation is shown as zero. */
function Pair({ mean, std }) {
  const shown = `${number(Math.abs(mean) < std / 100 ? 0 : mean)} ± ${number(std, 2)}`;
  return isClear(mean, std) ? shown : html`<span class="muted">${shown}</span>`;
}

/** Return whether a value is more than two standard deviations from zero. */
function isClear(mean, std) {
  return Math.abs(mean) >= 2 * std;
}

// of first moment over mass, to first order
function spread({ plausible: { mass }, std }, centre) {
  return centre.map((each, k) => Math.hypot(std.first_moment[k], each * std.mass) / mass);
}

function vector(values) {
  return values.map((each) => (Math.abs(each) < 5e-4 ? 0 : each).toFixed(3)).join(" ");
}
