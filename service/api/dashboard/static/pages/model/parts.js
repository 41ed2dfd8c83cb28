// Components of the torque, friction parameters and masses. No sensor measures the components.

import { post } from "../../api.js";
import { h, replace } from "../../dom.js";
import { number, shortNames } from "../../format.js";
import { card, loading, table } from "../../ui.js";
import { noData } from "./choice.js";
import { intervalArea, lineWithGaps, column } from "./curves.js";
import { trainingDataNotes } from "./training_data.js";
import { jointPlots } from "./joints.js";

const POINTS = 500;
const LABELS = { gravity: "gravity", inertial: "inertial, M(q) ddq", coriolis: "Coriolis and centrifugal", friction: "friction" };

/** Draw the tab: components along the selected recording, and parameters. */
export async function parts(view, state, { signal }) {
  const cards = [frictionCard(state.version), bodiesCard(state.version)];
  if (state.dataset === null) {
    replace(view, noData(state), cards);
    return;
  }
  const request = { dataset: state.dataset, version: state.version.version, part: state.part };
  replace(view, loading("Computing the components"));
  const { offered } = await post(`${state.where}/trace`, { ...request, points: 1 }, signal);
  const fetch = async (start, stop) => {
    const range = stop === null ? {} : { start, stop };
    const trace = await post(`${state.where}/trace`, { ...request, ...range, points: POINTS, components: offered }, signal);
    return { ...trace, joint_types: state.version.joint_types };
  };
  const trace = await fetch(0, null);
  const along = h("div", {});
  const only = offered.length > 1 ? null : h("p", { class: "hint" }, `The estimator ${state.version.estimator} only separates friction from the rest. For gravity, inertial and Coriolis torques, train rigid-body or lip-chain.`);
  replace(view, trainingDataNotes(trace), card("Torque components", only, along), cards);
  const names = Object.keys(LABELS).filter((name) => offered.includes(name));
  const views = names.length > 1 ? { "all components": (...given) => names.flatMap((name, index) => component(name, index, ...given)) } : {};
  for (const [index, name] of names.entries()) views[LABELS[name]] = (...given) => component(name, index, ...given);
  const note = "No sensor measures these components. Their 95 % intervals are those of the model and cannot be verified.";
  const sum = names.length > 1 ? " Their sum is the predicted torque." : "";
  await jointPlots(along, { first: trace, fetch, views, about: Object.fromEntries(Object.keys(views).map((view_) => [view_, note + sum])), signal });
}

function component(name, index, trace, joint, x) {
  const values = trace.components[name];
  const mean = column(values.mean, joint);
  return [
    intervalArea(x, mean, column(values.std, joint), trace.breaks, `${LABELS[name]}, 95 % interval`, `version-${index + 1}`, { showlegend: false }),
    lineWithGaps(x, mean, trace.breaks, LABELS[name], `version-${index + 1}`), // joint colours are reserved for joints
  ];
}

function frictionCard({ joint_names: names, joint_types: types, parameters }) {
  const { friction } = parameters;
  const value = (term) => (joint) => {
    const { mean, std } = friction[term];
    const vague = Math.abs(mean[joint]) < 2 * std[joint];
    return [`${number(mean[joint])} ± ${number(std[joint], 2)}`, vague ? h("span", { class: "muted", title: "within two standard deviations of zero" }, " ≈ 0") : null];
  };
  const sliding = types.includes("prismatic") ? " (prismatic joints: N·s/m and N)" : "";
  const short = shortNames(names);
  const columns = [
    { label: "Joint", cell: (joint) => short[joint] },
    { label: "Viscous, N·m·s/rad", numeric: true, cell: value("viscous") },
    { label: "Coulomb, N·m", numeric: true, cell: value("coulomb") },
    { label: "Offset, N·m", numeric: true, cell: value("offset") },
    ...(friction.stribeck ? [{ label: "Stribeck, N·m", numeric: true, cell: value("stribeck") }] : []),
    ...(friction.position ? [{ label: "Varying over a turn, N·m", numeric: true, cell: value("position") }] : []),
    ...(friction.load ? [{ label: "Share of the load", numeric: true, cell: value("load") }] : []),
    ...(friction.gain ? [{ label: "Gain error", numeric: true, cell: value("gain") }] : []),
    ...(friction.breakaway ? [{ label: "Breakaway, N·m", numeric: true, cell: value("breakaway") }] : []),
    ...(friction.stiffness ? [{ label: "Presliding, N·m/rad", numeric: true, cell: value("stiffness") }] : []),
  ];
  return card(
    "Friction parameters",
    table(columns, names.map((_name, joint) => joint), { caption: `Mean ± one standard deviation${sliding}, as trained` }),
    h("p", { class: "hint" }, "Friction is viscous · dq + Coulomb · sign(dq) + offset; the offset includes every other constant torque. ≈ 0: less than two standard deviations from zero, so not significant. The share of the load is friction per torque that the bodies need. A gain error of 0.05 means that torque reads 5 % too high for the masses. Breakaway is the friction of a joint that begins to slip, presliding its stiffness before that. Values as trained, without online learning."),
  );
}

function bodiesCard({ joint_names: names, parameters }) {
  const short = shortNames(names);
  const { inertia } = parameters;
  if (!inertia) return null;
  const columns = [
    { label: "Joint that moves the body", cell: (body) => short[names.indexOf(body.joint)] },
    { label: "Mass, kg", numeric: true, cell: (body) => `${number(body.mean.mass)} ± ${number(body.std.mass, 2)}` },
    { label: "Nearest consistent mass, kg", numeric: true, cell: (body) => number(body.plausible.mass) },
  ];
  return card(
    "Masses",
    table(columns, inertia.bodies, { caption: "Mean ± one standard deviation, as trained" }),
    h("p", { class: "hint" },
      inertia.mean_is_plausible ? "These masses are physically consistent. " : "The means are not physically consistent together; the nearest consistent masses are. ",
      "Torque depends on sums of masses, rarely on a single one. Unidentifiable masses come from the prior, so a small ± does not prove that the recording determines the mass. For moments and inertias see ", h("code", {}, "parameters"), " of the version in the API."),
  );
}
