// Tables of a learnt arm: joint axes, masses, friction, and unidentifiable parameters.

import { h } from "../../dom.js";
import { number, shortNames } from "../../format.js";
import { table } from "../../ui.js";
import { frames, massCentres } from "./kinematics.js";

const DEGREES = 180 / Math.PI;

/** Return a table of the joints from base to tip, in the base frame, with all positions at zero. */
export function jointTable({ joint_names: names, parameters: { geometry } }) {
  const short = shortNames(names);
  const zero = frames(geometry, names.map(() => 0));
  const stds = (values, factor) => values.map((each) => number(each * factor, 2)).join(", ") || "–";
  const columns = [
    { label: "Joint", cell: (place) => short[geometry.order[place]] },
    { label: "Type", cell: (place) => geometry.joints[place].type },
    { label: "Axis", numeric: true, cell: (place) => vector(zero[place].axis) },
    { label: "Position, m", numeric: true, cell: (place) => vector(zero[place].origin) },
    { label: "± turn, °", numeric: true, cell: (place) => stds(geometry.joints[place].turn_std, DEGREES) },
    { label: "± shift, mm", numeric: true, cell: (place) => stds(geometry.joints[place].shift_std, 1000) },
    { label: "Unidentifiable", cell: (place) => geometry.joints[place].undetermined.join(", ") || "–" },
  ];
  return table(columns, geometry.joints.map((_joint, place) => place), { caption: "Joint axes from base to tip, in the base frame, with all positions at zero; ±: one standard deviation in two directions across the axis" });
}

/** Return a table of masses, centres of mass, rotors and friction, from base to tip. */
export function massTable({ joint_names: names, joint_types: types, parameters }) {
  const { geometry, inertia, rotor, friction } = parameters;
  const centre = massCentres(inertia);
  const short = shortNames(names);
  const pair = ({ mean, std }, joint) => `${number(mean[joint])} ± ${number(std[joint], 2)}`;
  const sliding = types.includes("prismatic") ? "; prismatic joints: kg, N·s/m and N" : "";
  const columns = [
    { label: "Joint", cell: (joint) => short[joint] },
    { label: "Mass, kg", numeric: true, cell: (joint) => `${number(inertia.bodies[joint].plausible.mass)} ± ${number(inertia.bodies[joint].std.mass, 2)}` },
    { label: "Centre of mass, m", numeric: true, cell: (joint) => vector(centre[joint]) },
    { label: "±, mm", numeric: true, cell: (joint) => spread(inertia.bodies[joint], centre[joint]).map((each) => number(1000 * each, 2)).join(", ") },
    ...(rotor ? [{ label: "Rotor, kg·m²", numeric: true, cell: (joint) => pair(rotor, joint) }] : []),
    { label: "Viscous, N·m·s", numeric: true, cell: (joint) => pair(friction.viscous, joint) },
    { label: "Coulomb, N·m", numeric: true, cell: (joint) => pair(friction.coulomb, joint) },
    ...(friction.stribeck ? [{ label: "Stribeck, N·m", numeric: true, cell: (joint) => pair(friction.stribeck, joint) }] : []),
    ...(friction.position ? [{ label: "Varying over a turn, N·m", numeric: true, cell: (joint) => pair(friction.position, joint) }] : []),
    ...(friction.load ? [{ label: "Share of the load", numeric: true, cell: (joint) => pair(friction.load, joint) }] : []),
    ...(friction.gain ? [{ label: "Gain error", numeric: true, cell: (joint) => pair(friction.gain, joint) }] : []),
    ...(friction.breakaway ? [{ label: "Breakaway, N·m", numeric: true, cell: (joint) => pair(friction.breakaway, joint) }] : []),
    ...(friction.stiffness ? [{ label: "Presliding, N·m/rad", numeric: true, cell: (joint) => pair(friction.stiffness, joint) }] : []),
    { label: "Unidentifiable", cell: (joint) => (inertia.bodies[joint].undetermined ?? []).map((each) => each.replace("_", " ")).join(", ") || "–" },
  ];
  return h("div", { class: "dense" }, table(columns, geometry.order, { caption: `Bodies in their joint frames, and friction; ±: one standard deviation${sliding}` }));
}

// of first moment over mass, to first order
function spread({ plausible: { mass }, std }, centre) {
  return centre.map((each, k) => Math.hypot(std.first_moment[k], each * std.mass) / mass);
}

function vector(values) {
  return values.map((each) => (Math.abs(each) < 5e-4 ? 0 : each).toFixed(3)).join(" ");
}
