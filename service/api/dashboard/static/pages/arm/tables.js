// The arm that a version has learnt in numbers: where its joints lie, what they carry, and what torque does not tell.

import { h } from "../../dom.js";
import { number, shortNames } from "../../format.js";
import { table } from "../../ui.js";
import { centres, frames } from "./kinematics.js";

const DEGREES = 180 / Math.PI;

/** Joints from base to tip, with all positions at zero, in the base's frame. */
export function jointTable({ joint_names: names, parameters: { geometry } }) {
  const short = shortNames(names);
  const zero = frames(geometry, names.map(() => 0));
  const stds = (values, factor) => values.map((each) => number(each * factor, 2)).join(", ") || "–";
  const columns = [
    { label: "Joint", cell: (place) => short[geometry.order[place]] },
    { label: "Type", cell: (place) => geometry.joints[place].type },
    { label: "Axis", numeric: true, cell: (place) => vector(zero[place].axis) },
    { label: "Place, m", numeric: true, cell: (place) => vector(zero[place].origin) },
    { label: "± turn, °", numeric: true, cell: (place) => stds(geometry.joints[place].turn_std, DEGREES) },
    { label: "± shift, mm", numeric: true, cell: (place) => stds(geometry.joints[place].shift_std, 1000) },
    { label: "Torque does not tell", cell: (place) => geometry.joints[place].undetermined.join(", ") || "–" },
  ];
  return table(columns, geometry.joints.map((_joint, place) => place), { caption: "Joint axes from base to tip, in the base’s frame, all positions at zero; ±: one standard deviation in two directions across the axis" });
}

/** What the joints carry: masses with their centres, rotors and friction, base to tip. */
export function massTable({ joint_names: names, joint_types: types, parameters }) {
  const { geometry, inertia, rotor, friction } = parameters;
  const centre = centres(inertia);
  const short = shortNames(names);
  const pair = ({ mean, std }, joint) => `${number(mean[joint])} ± ${number(std[joint], 2)}`;
  const sliding = types.includes("prismatic") ? "; of sliding joints kg, N·s/m and N" : "";
  const columns = [
    { label: "Joint", cell: (joint) => short[joint] },
    { label: "Mass, kg", numeric: true, cell: (joint) => `${number(inertia.bodies[joint].plausible.mass)} ± ${number(inertia.bodies[joint].std.mass, 2)}` },
    { label: "Centre of mass, m", numeric: true, cell: (joint) => vector(centre[joint]) },
    { label: "±, mm", numeric: true, cell: (joint) => spread(inertia.bodies[joint], centre[joint]).map((each) => number(1000 * each, 2)).join(", ") },
    ...(rotor ? [{ label: "Rotor, kg·m²", numeric: true, cell: (joint) => pair(rotor, joint) }] : []),
    { label: "Viscous, N·m·s", numeric: true, cell: (joint) => pair(friction.viscous, joint) },
    { label: "Coulomb, N·m", numeric: true, cell: (joint) => pair(friction.coulomb, joint) },
    ...(friction.stribeck ? [{ label: "Slow, N·m", numeric: true, cell: (joint) => pair(friction.stribeck, joint) }] : []),
    { label: "Torque does not tell", cell: (joint) => (inertia.bodies[joint].undetermined ?? []).map((each) => each.replace("_", " ")).join(", ") || "–" },
  ];
  return h("div", { class: "dense" }, table(columns, geometry.order, { caption: `What the joints carry, in the joints’ own frames, and their friction; slow: what it is more at low speed; ±: one standard deviation${sliding}` }));
}

// of first moment over mass, to first order
function spread({ plausible: { mass }, std }, centre) {
  return centre.map((each, k) => Math.hypot(std.first_moment[k], each * std.mass) / mass);
}

function vector(values) {
  return values.map((each) => (Math.abs(each) < 5e-4 ? 0 : each).toFixed(3)).join(" ");
}
